"""Trial fields of the weighted residual method: exact solutions of Navier's equation, and the families they span."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from faceanim.backends.weighted_residual.fields import (
    Fields,
    JoinedFields,
    NavierPolynomials,
    PaperFields,
    harmonic_slopes,
    harmonics,
)
from faceanim.ground.errors import UserError

FINGERPRINTS = {
    (1, 1): (0.41624544, 0.10928894, -0.81022092, 24.1591724, 24.1591724, -48.3183448,
             -3.34835015, 6.5175568, 24.82321858),
    (1, 3): (2.20260989, 0.07650226, -1.47897353, 181.13069375, 70.20111856, -89.28762895,
             -10.0310095, 11.89711818, 102.30149809),
    (1, 12): (-0.43827949, 0.08661012, 0.04730357, 20.329375, -5.30593024, 5.96289047,
              19.00907773, 7.76145768, -18.26516792),
    (1, 27): (-1.47897353, 0.20497893, -0.54526837, 100.06662322, 100.06662322, -33.63506858,
              11.89711818, 12.07339718, -87.11253924),
    (2, 35): (0.47986369, -0.63408329, 1.63078499, 61.4920692, -76.61497578, 162.12301784,
              164.58636885, 150.65684236, -236.10842755),
}  # fmt: skip
"""(i, j) -> u, v, w; sxx, syy, szz; sxy, syz, sxz for L = 5, nu = 0.49, E = 100 at (1, 0.3, 0.7), from another program."""


@pytest.mark.parametrize("pair", sorted(FINGERPRINTS), ids=str)
def test_the_fields_of_the_paper_have_known_values(pair: tuple[int, int]) -> None:
    """Equations 5 and 7, column 36 (i - 1) + j, to the eight digits known."""
    sample = PaperFields(2, 0.49, 5.0).sample(np.array([[1.0, 0.3, 0.7]]))
    column = 36 * (pair[0] - 1) + pair[1] - 1
    stress = 100.0 / 2.98 * sample.stress()[0, :, :, column]
    got = [*sample.u[0, :, column], *np.diag(stress), stress[0, 1], stress[1, 2], stress[0, 2]]
    np.testing.assert_allclose(got, FINGERPRINTS[pair], rtol=1e-7, atol=2e-8)


FAMILIES: dict[str, Callable[[float], Fields]] = {
    "paper": lambda nu: PaperFields(3, nu, 2.0),
    "shifted": lambda nu: PaperFields(3, nu, 2.0, (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
    "polynomials": lambda nu: NavierPolynomials(5, nu),
    "joined": lambda nu: JoinedFields((PaperFields(1, nu, 2.0), NavierPolynomials(1, nu))),
}


def unbalance(fields: Fields, h: float = 1e-3) -> float:
    """Return the largest |div stress| over the largest second derivative, by central differences of fourth order."""
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (12, 3))
    total, size = 0.0, np.zeros(fields.count)
    for axis in range(3):
        step = h * np.eye(3)[axis]
        at = {k: fields.sample(x + k * step) for k in (-2, -1, 1, 2)}

        def slope(values: dict[int, np.ndarray]) -> np.ndarray:
            return (8.0 * (values[1] - values[-1]) - (values[2] - values[-2])) / (12.0 * h)

        total = total + slope({k: s.stress()[:, :, axis] for k, s in at.items()})
        size = np.maximum(size, np.abs(slope({k: s.gradient for k, s in at.items()})).max(axis=(0, 1, 2)))
    return float((np.abs(total).max(axis=(0, 1)) / np.maximum(size, 1e-6 * size.max())).max())


@pytest.mark.parametrize("family", sorted(FAMILIES))
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49])
def test_every_field_is_in_equilibrium(family: str, nu: float) -> None:
    """div stress = 0 whatever the coefficients (Eq. 1), to the accuracy of the differences."""
    assert unbalance(FAMILIES[family](nu)) < 1e-7


def analytic_unbalance(nu: float, h: float) -> float:
    """Return the largest (lam + G) / G grad div u + lap u of one paper potential by its own fourth derivatives."""
    rng, n, eta, worst = np.random.default_rng(1), 1.3, np.sqrt(2.0) * 1.3, 0.0
    for x, y, z in rng.uniform(-1.0, 1.0, (40, 3)):

        def d(a: int, b: int, c: int, x: float = x, y: float = y, z: float = z) -> float:
            sine = n**a * np.sin(n * x + 0.5 * a * np.pi)
            cosine = n**b * np.cos(n * y + 0.5 * b * np.pi)
            return float(sine * cosine * (eta**c * z + c * eta ** max(c - 1, 0)) * np.exp(eta * z))

        def order(*axes: int) -> float:
            return d(axes.count(0), axes.count(1), axes.count(2))

        for j in range(3):
            swell = (1.0 + h) * sum(order(j, a, a, 0) for a in range(3))
            first = sum(order(a, a, b, b) for a in range(3) for b in range(3)) if j == 0 else 0.0
            own = first + h * sum(order(0, j, a, a) for a in range(3))
            scale = sum(abs(order(0, j, a, a)) for a in range(3)) / (1.0 - 2.0 * nu)
            worst = max(worst, abs(swell / (1.0 - 2.0 * nu) + own) / max(scale, 1e-3))
    return worst


def test_only_the_minus_sign_solves_the_equation() -> None:
    """H = -1 / (2 (1 - nu)) balances to 1e-13 in closed form; with a plus sign nothing does."""
    assert analytic_unbalance(0.49, -1.0 / 1.02) < 1e-13
    assert analytic_unbalance(0.49, 1.0 / 1.02) > 0.1
    assert unbalance(PaperFields(2, 0.49, 2.0, galerkin=1.0 / 1.02)) > 0.1


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_gradients_are_those_of_the_displacements(family: str) -> None:
    """Central differences of u, and lambda div u in closed form against the trace."""
    fields = FAMILIES[family](0.4)
    x, h = np.random.default_rng(2).uniform(-0.5, 0.5, (10, 3)), 1e-5
    sample = fields.sample(x)
    for axis in range(3):
        step = h * np.eye(3)[axis]
        slope = (fields.sample(x + step).u - fields.sample(x - step).u) / (2.0 * h)
        np.testing.assert_allclose(slope, sample.gradient[:, :, axis], atol=1e-8 * np.abs(sample.gradient).max())
    trace = np.einsum("naam->nm", sample.gradient)
    np.testing.assert_allclose(sample.pressure, 2 * 0.4 / 0.2 * trace, atol=1e-12 * np.abs(sample.pressure).max())


def test_incompressible_fields_stay_finite() -> None:
    """At nu = 1/2 the paper's fields keep their volume and their pressure is finite."""
    sample = PaperFields(3, 0.5, 2.0).sample(np.random.default_rng(3).uniform(-1, 1, (10, 3)))
    assert np.isfinite(sample.pressure).all() and np.abs(sample.pressure).max() > 0.1
    assert np.abs(np.einsum("naam->nm", sample.gradient)).max() < 1e-12 * np.abs(sample.gradient).max()


@pytest.mark.parametrize(("degree", "count"), [(1, 12), (3, 48), (5, 108), (8, 243), (11, 432), (14, 675)])
def test_polynomials_are_as_many_as_there_are(degree: int, count: int) -> None:
    """3 (D + 1)^2, and up to degree 5 they are seen to be independent."""
    fields = NavierPolynomials(degree, 0.45)
    assert fields.count == count
    if degree <= 5:
        u = fields.sample(np.random.default_rng(4).uniform(-1, 1, (200, 3))).u.reshape(-1, count)
        assert np.linalg.matrix_rank(u / np.linalg.norm(u, axis=0)) == count


def test_polynomials_span_the_paper_s_fields() -> None:
    """The space is complete: it comes as near as one likes to a field of the paper."""
    x = np.random.default_rng(5).uniform(-0.5, 0.5, (500, 3))
    goal = PaperFields(1, 0.45, 2.0).sample(x).u.reshape(-1, 36)
    left = []
    for degree in (4, 10):
        u = NavierPolynomials(degree, 0.45).sample(x).u.reshape(len(goal), -1)
        left.append(np.linalg.norm(goal - u @ np.linalg.lstsq(u, goal, rcond=None)[0]) / np.linalg.norm(goal))
    assert left[1] < 1e-6 and left[1] < 1e-3 * left[0]


def test_harmonics_and_their_slopes() -> None:
    """Second derivatives add to zero and first ones are right."""
    degree, slopes = harmonic_slopes(6)
    assert np.abs(sum(s @ s for s in slopes)).max() < 1e-14
    x, h = np.random.default_rng(6).uniform(-1, 1, (20, 3)), 1e-5
    for axis in range(3):
        step = h * np.eye(3)[axis]
        difference = (harmonics(x + step, 6) - harmonics(x - step, 6)) / (2.0 * h)
        np.testing.assert_allclose(harmonics(x, 6) @ slopes[axis], difference, atol=1e-9)
    assert np.bincount(degree.astype(int)).tolist() == [1, 3, 5, 7, 9, 11, 13]


@pytest.mark.parametrize("nu", [0.5001, 0.7, -1.0, np.nan])
def test_a_wrong_poisson_ratio_is_refused(nu: float) -> None:
    """Beyond 1/2, at -1 and NaN there is no such material."""
    with pytest.raises(UserError, match="poisson_ratio"):
        PaperFields(2, nu)
    with pytest.raises(UserError, match="poisson_ratio"):
        NavierPolynomials(2, nu)


def test_empty_families_are_refused() -> None:
    """At least one term, a positive length, a degree that is not negative."""
    for make in (lambda: PaperFields(0, 0.3), lambda: PaperFields(1, 0.3, 0.0), lambda: NavierPolynomials(-1, 0.3)):
        with pytest.raises(UserError):
            make()
