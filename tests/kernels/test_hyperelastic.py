"""Elastic laws at one point: derivatives, objectivity, agreement at small strain, and matrices that are nearly singular."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from faceanim.kernels import hyperelastic as law_of

LAWS = {
    "linear": law_of.LINEAR,
    "neo_hookean": law_of.NEO_HOOKEAN,
    "corotational": law_of.COROTATIONAL,
    "stvk": law_of.STVK,
    "mooney_rivlin": law_of.MOONEY_RIVLIN,
    "tension": law_of.TENSION,
    "stvk_barrier": law_of.STVK_BARRIER,
}
BARRIER = ("neo_hookean", "mooney_rivlin", "tension", "stvk_barrier")
LAME, SHEAR = 7.0, 3.0
CONSTANT = np.array([LAME, SHEAR, 1.1, 0.4, LAME + 2.0 * SHEAR / 3.0])
STRETCHED = np.array([LAME, SHEAR, 9.5, -8.0, LAME + 2.0 * SHEAR / 3.0])
"""For the law "tension", which needs c01 <= 0."""
WORK = np.zeros((3, 3, 3))


def constant(law: int) -> np.ndarray:
    return STRETCHED if law == law_of.TENSION else CONSTANT


def psi(law: int, F: np.ndarray) -> float:
    return float(law_of.energy_density(law, np.ascontiguousarray(F), constant(law), WORK))


def stress(law: int, F: np.ndarray) -> np.ndarray:
    P = np.full((3, 3), np.nan)
    law_of.stress(law, np.ascontiguousarray(F), constant(law), WORK, P)
    return P


def tangent(law: int, F: np.ndarray) -> np.ndarray:
    A = np.full((9, 9), np.nan)
    law_of.tangent(law, np.ascontiguousarray(F), constant(law), WORK, A)
    return A


def stretched(seed: int, values: tuple[float, float, float]) -> np.ndarray:
    """Return a deformation with these singular values between two random rotations."""
    left, right = Rotation.random(2, random_state=seed).as_matrix()
    return left @ np.diag(values) @ right


SHAPES = {
    "moderate": (1.3, 0.9, 0.8),
    "equal": (1.2, 1.2, 1.2),
    "flat": (1.4, 1.0, 0.02),
    "needle": (2.5, 0.05, 0.04),
    "inverted": (1.5, 0.8, -0.3),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("law", LAWS)
def test_stress_and_tangent_are_derivatives(law: str, shape: str) -> None:
    """P is the slope of psi and A that of P by central differences, also nearly singular, and inverted where allowed."""
    number = LAWS[law]
    if shape == "inverted" and law in BARRIER:
        assert psi(number, stretched(1, SHAPES[shape])) == np.inf
        return
    F = stretched(5, SHAPES[shape])
    h = 1e-5 * abs(min(SHAPES[shape], key=abs))
    P, A = stress(number, F), tangent(number, F)
    slopes, bends = np.zeros((3, 3)), np.zeros((9, 9))
    for k in range(9):
        step = np.zeros(9)
        step[k] = h
        up, down = F + step.reshape(3, 3), F - step.reshape(3, 3)
        slopes.ravel()[k] = (psi(number, up) - psi(number, down)) / (2.0 * h)
        bends[:, k] = (stress(number, up) - stress(number, down)).ravel() / (2.0 * h)
    np.testing.assert_allclose(P, slopes, atol=1e-7 * np.abs(P).max() + 1e-8)
    # without shape change the law "tension" has a term |e|^3, so that differences of its stress are off by c01 h
    kink = 10.0 * h if (law, shape) == ("tension", "equal") else 0.0
    np.testing.assert_allclose(A, bends, atol=(1e-7 + kink) * np.abs(A).max())
    np.testing.assert_allclose(A, A.T, atol=1e-13 * np.abs(A).max())


@pytest.mark.parametrize("law", [name for name in LAWS if name != "linear"])
def test_turning_the_result_costs_nothing(law: str) -> None:
    """psi(Q F) = psi(F) and P(Q F) = Q P(F); turning the material first changes nothing either: the law is isotropic."""
    F, Q = stretched(2, (1.4, 1.1, 0.6)), Rotation.random(random_state=9).as_matrix()
    number = LAWS[law]
    assert psi(number, Q @ F) == pytest.approx(psi(number, F), rel=1e-12)
    assert psi(number, F @ Q) == pytest.approx(psi(number, F), rel=1e-12)
    np.testing.assert_allclose(stress(number, Q @ F), Q @ stress(number, F), atol=1e-11)
    np.testing.assert_allclose(stress(number, Q), 0.0, atol=1e-13)
    assert psi(number, Q) == pytest.approx(0.0, abs=1e-13)


@pytest.mark.parametrize("law", LAWS)
def test_all_laws_agree_at_small_strain(law: str) -> None:
    """The tangent at rest is that of linear elasticity with the same Lame constants."""
    np.testing.assert_allclose(tangent(LAWS[law], np.eye(3)), tangent(LAWS["linear"], np.eye(3)), atol=1e-12)


def test_known_energies() -> None:
    """A stretch by diag(2, 1, 1/2), by hand."""
    F = np.diag([2.0, 1.0, 0.5])
    assert psi(LAWS["neo_hookean"], F) == pytest.approx(0.5 * SHEAR * (5.25 - 3.0))
    assert psi(LAWS["linear"], F) == pytest.approx(SHEAR * 1.25 + 0.5 * LAME * 0.25)
    assert psi(LAWS["corotational"], F) == pytest.approx(SHEAR * 1.25 + 0.5 * LAME * 0.25)
    assert psi(LAWS["stvk"], F) == pytest.approx(SHEAR * (2.25 + 0.140625) + 0.5 * LAME * 1.125**2)
    assert psi(LAWS["mooney_rivlin"], F) == pytest.approx(1.1 * 2.25 + 0.4 * (4.0 + 1.0 + 0.25 - 3.0))
    assert psi(LAWS["stvk_barrier"], F) == pytest.approx(SHEAR * (2.25 + 0.140625))
    uniaxial = np.diag([4.0, 0.5, 0.5])
    assert psi(LAWS["tension"], uniaxial) == pytest.approx(9.5 * 13.5 - 8.0 * (8.0 + 1.0 / 16.0 - 3.0))


@pytest.mark.parametrize("J", [0.0, -0.5, np.nan])
@pytest.mark.parametrize("law", BARRIER)
def test_the_barrier_is_infinite(law: str, J: float) -> None:
    """A volume ratio that is not positive, or not a number, costs an infinite energy."""
    assert psi(LAWS[law], np.diag([1.0, 1.0, J])) == np.inf


@pytest.mark.parametrize(
    "values", [(1.0, 1.0, 1.0), (2.0, 1.0, 1e-9), (2.0, 1.0, 0.0), (3.0, 0.0, 0.0), (0.0, 0.0, 0.0), (2.0, 1.0, -0.7),
               (1e-100, 0.0, 0.0), (1e8, 1.0, 1e-8)],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("turned", [False, True])
def test_singular_values_of_every_rank(values: tuple[float, float, float], turned: bool) -> None:
    """F = U diag(s) V^T with two proper rotations, whatever the rank; the smallest value carries the sign of det F."""
    F = stretched(3, values) if turned else np.diag(values)
    U, V = np.zeros((3, 3)), np.zeros((3, 3))
    s = np.array(law_of.singular_values(F, U, V))
    np.testing.assert_allclose(np.sort(np.abs(s)), np.sort(np.abs(values)), atol=1e-14 * max(values))
    np.testing.assert_allclose(U @ np.diag(s) @ V.T, F, atol=1e-14 * max(values))
    for matrix in (U, V):
        np.testing.assert_allclose(matrix.T @ matrix, np.eye(3), atol=1e-13)
        assert np.linalg.det(matrix) == pytest.approx(1.0)
    assert (np.sort(s)[1:] >= 0.0).all()


def test_definite_tangents_keep_what_is_positive() -> None:
    """Negative eigenvalues become zero, the others and their vectors stay, as by a dense eigenvalue solver."""
    rng = np.random.default_rng(6)
    for spread in (1.0, 1e6):
        basis = np.linalg.qr(rng.standard_normal((9, 9)))[0]
        values = spread ** rng.uniform(0.0, 1.0, 9) * np.array([1, -1, 1, 1, -1, 1, 1, 0, 1])
        A = (basis * values) @ basis.T
        expected = (basis * np.maximum(values, 0.0)) @ basis.T
        law_of.make_definite(A, np.zeros((9, 9)), np.zeros((9, 9)), 0.0)
        np.testing.assert_allclose(A, expected, atol=1e-11 * np.abs(values).max())
