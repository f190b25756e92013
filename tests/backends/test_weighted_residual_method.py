"""The weighted residual method on bodies given by their boundary: exactness, units, loads, reactions and bad input."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from faceanim.backends.weighted_residual.boundary import TRIANGLE_RULES, Boundary
from faceanim.backends.weighted_residual.method import WeightedResidual
from faceanim.backends.weighted_residual.options import Options
from faceanim.backends.weighted_residual.solver import propagator
from faceanim.geometry.shapes import box_tets, sphere
from faceanim.geometry.surface import TriMesh
from faceanim.ground.errors import UserError

SMALL = Options(degree=4)


def box(sides: tuple[float, float, float] = (3.0, 1.0, 1.0), *, field: Any = None, order: int = 2) -> Boundary:
    """Return a box held at x = 0; `field` (n, 3) -> (n, 3) prescribes displacements there, traction is 0 elsewhere."""
    mesh = box_tets((6, 3, 3), sides).boundary
    held = np.abs(mesh.points[mesh.triangles][:, :, 0]).max(axis=1) < 1e-9
    made = Boundary.of_surface(mesh, np.repeat(held[:, None], 3, axis=1), order=order)
    return made if field is None else made.with_values(np.where(made.prescribed, field(made.points), 0.0))


def whole(mesh: TriMesh, field: Any) -> Boundary:
    """Return a boundary with `field` prescribed everywhere."""
    made = Boundary.of_surface(mesh, True, order=4)
    return made.with_values(field(made.points))


@pytest.mark.parametrize(
    ("basis", "method"), [("navier", "nitsche"), ("navier", "collocation"), ("paper_linear", "collocation")]
)
def test_linear_fields_are_reproduced(method: str, basis: str) -> None:
    """Rigid motion and uniform strain come back to 1e-10, inside and in stress.

    (Nitsche with the paper's exponentials needs their products integrated as exactly: see the blocks.)
    """
    matrix, shift = np.random.default_rng(0).standard_normal((2, 3, 3))
    mesh = box_tets((4, 2, 2), (2.0, 1.0, 1.0)).boundary

    def field(x: np.ndarray) -> np.ndarray:
        return 0.1 * x @ matrix.T + shift[0]

    options = Options(basis=basis, terms=2, degree=3, method=method)
    system = WeightedResidual(whole(mesh, field), 10.0, 0.45, options)
    c, x = system.solve(), np.random.default_rng(1).uniform(0.1, 0.9, (20, 3))
    np.testing.assert_allclose(system.displacement(x, c), field(x), rtol=0.0, atol=1e-10)
    strain = 0.05 * (matrix + matrix.T)
    np.testing.assert_allclose(system.strain(x, c), np.broadcast_to(strain, (20, 3, 3)), atol=1e-9)
    lame, shear = 10.0 * 0.45 / (1.45 * 0.1), 10.0 / 2.9
    stress = lame * np.trace(strain) * np.eye(3) + 2.0 * shear * strain
    np.testing.assert_allclose(system.stress(x, c), np.broadcast_to(stress, (20, 3, 3)), atol=1e-7)
    assert np.abs(system.residual(c)).max() < 1e-8


def test_the_unit_does_not_matter() -> None:
    """Metres or millimetres, pascals or kilopascals: the same body moves the same."""

    def bend(x: np.ndarray) -> np.ndarray:
        return np.stack([0.1 * x[:, 1], 0.0 * x[:, 0], 0.2 * x[:, 2] * x[:, 1]], axis=1)

    plain = box(field=bend)
    x = np.array([[1.5, 0.2, 0.7], [2.9, 0.9, 0.1]])
    for method in ("nitsche", "collocation"):
        options = replace(SMALL, method=method)
        u = WeightedResidual(plain, 15.0, 0.4, options)
        v = WeightedResidual(plain.scaled(1e-3), 15e3, 0.4, options)
        one, other = u.displacement(x, u.solve()), v.displacement(1e-3 * x, v.solve())
        np.testing.assert_allclose(1e3 * other, one, atol=1e-7 * np.abs(one).max())
        assert np.abs(one).max() > 0.05


def test_a_pulled_sphere_follows_the_closed_form() -> None:
    """A ball under uniform pressure shrinks by p (1 - 2 nu) / E; the surface mesh alone is off by its facets."""
    mesh = sphere(2.0, 2)
    made = Boundary.of_surface(mesh, False, order=2)
    given = made.prescribed.copy()
    given[np.argsort(made.points[:, 2])[:40]] = True  # held where it would go anyway
    x = made.points
    exact = -0.3 * 0.2 / 10.0 * x
    made = Boundary(x, made.normals, made.weights, given, np.where(given, exact, -0.3 * made.normals))
    system = WeightedResidual(made, 10.0, 0.4, SMALL)
    np.testing.assert_allclose(system.displacement(x, system.solve()), exact, atol=1e-9)


def test_new_loads_cost_one_product() -> None:
    """`resolve` is linear, and a block of the operator is the part that the changed values need."""
    made = box()
    system = WeightedResidual(made, 15.0, 0.4, SMALL)
    values = np.random.default_rng(2).standard_normal(made.points.shape)
    far = made.points[:, 0] > 3.0 - 1e-9
    rest = np.where(far[:, None], 0.0, values)
    parts = system.resolve(rest) + system.block(far) @ values[far].ravel()
    np.testing.assert_allclose(parts, system.resolve(values), atol=1e-9 * np.abs(parts).max())


def test_reactions_balance_what_pulls() -> None:
    """The supports take exactly the resultant of the tractions, and a point force too."""
    made = box()
    pull = np.where(made.points[:, :1] > 3.0 - 1e-9, [[0.2, 0.1, -0.3]], 0.0)
    made = made.with_values(pull)
    system = WeightedResidual(made, 15.0, 0.4, SMALL)
    force = (made.weights[:, None] * pull).sum(axis=0)
    held = made.prescribed.all(axis=1)
    np.testing.assert_allclose(system.reaction(system.solve(), held), -force, atol=1e-8)
    push = np.array([[0.0, 0.7, 0.1]])
    c = system.point_loads(np.array([[3.0, 0.5, 0.5]])) @ push.ravel()
    np.testing.assert_allclose(system.reaction(c, held, np.zeros_like(pull)), -push[0], atol=1e-8)
    assert system.displacement(np.array([[3.0, 0.5, 0.5]]), c)[0, 1] > 0.1


def test_compliance_is_symmetric() -> None:
    """Maxwell: what a force at a moves b by is what the same force at b moves a by."""
    system = WeightedResidual(box(), 15.0, 0.4, SMALL)
    x = np.random.default_rng(3).uniform(0.2, 0.8, (5, 3))
    u = np.stack([system.displacement(x, c).ravel() for c in system.point_loads(x).T], axis=1)
    np.testing.assert_allclose(u, u.T, atol=1e-12 * np.abs(u).max())
    assert np.linalg.eigvalsh(u).min() > 0.0


@pytest.mark.parametrize("solver", ["qr", "normal_equations", "svd"])
def test_the_solvers_of_least_squares_agree(solver: str) -> None:
    """With scaled columns, and on a tame body, Eq. 12 and the orthogonal factorisations give one answer."""
    made = box(field=lambda x: np.stack([0 * x[:, 0], 0.1 * x[:, 2], -0.1 * x[:, 1] + 0.02], axis=1))
    options = Options(basis="paper", terms=2, method="collocation", displacement_weight=3.0)
    x = np.array([[1.0, 0.4, 0.6]])
    results = []
    for name in ("qr", solver):
        system = WeightedResidual(made, 15.0, 0.4, replace(options, solver=name))
        results.append(system.displacement(x, system.solve()))
        assert system.condition < 1e6
    np.testing.assert_allclose(results[1], results[0], atol=1e-6 * np.abs(results[0]).max())


@pytest.mark.parametrize("order", sorted(TRIANGLE_RULES))
def test_surface_quadrature(order: int) -> None:
    """Areas, the closed volume and polynomials up to the order are integrated exactly."""
    mesh = box_tets((2, 1, 1), (2.0, 1.0, 1.0)).boundary
    made = Boundary.of_surface(mesh, order=order)
    assert made.weights.sum() == pytest.approx(10.0)
    volume = (made.weights * (made.points * made.normals).sum(axis=1)).sum() / 3.0
    assert volume == pytest.approx(2.0) and made.thickness == pytest.approx(0.8) and made.extent <= 2.0 + 1e-12
    top = made.normals[:, 2] > 0.5
    assert (made.weights * made.points[:, 1] ** order)[top].sum() == pytest.approx(2.0 / (order + 1))


def test_steps_of_vibrations_are_exact() -> None:
    """Two half steps are one, for weak, critical and strong damping; without damping it is a cosine."""
    squared, damping = np.array([4.0, 4.0, 4.0, 1e8]), np.array([0.0, 4.0, 50.0, 1e6])
    whole_step, half = (propagator(squared, damping, dt).reshape(-1, 2, 2) for dt in (0.2, 0.1))
    np.testing.assert_allclose(half @ half, whole_step, atol=1e-8)
    np.testing.assert_allclose(
        whole_step[0], [[np.cos(0.4), np.sin(0.4) / 2], [-2 * np.sin(0.4), np.cos(0.4)]], atol=1e-9
    )


# What cannot be asked.


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"points": np.zeros((0, 3))}, "no points"),
        ({"points": np.full((4, 3), np.nan)}, "not finite"),
        ({"points": np.zeros((4, 2))}, "shape"),
        ({"normals": np.zeros((4, 3))}, "length 1"),
        ({"weights": np.zeros(4)}, "positive"),
        ({"weights": np.ones(3)}, "shape"),
        ({"prescribed": np.ones((4, 2), bool)}, "prescribed"),
        ({"prescribed": np.ones(4, bool)}, "prescribed"),
        ({"values": np.full((4, 3), np.inf)}, "not finite"),
        ({"values": np.zeros(12)}, "shape"),
    ],
    ids=str,
)
def test_a_wrong_boundary_is_refused(change: dict[str, Any], match: str) -> None:
    """Shapes, finite numbers, unit normals and positive weights, each by name."""
    normal = np.tile([1.0, 0.0, 0.0], (4, 1))
    good = {"points": np.eye(4, 3), "normals": normal, "weights": np.ones(4), "prescribed": True, "values": None}
    with pytest.raises(UserError, match=match):
        Boundary(**(good | change))


def test_a_floating_body_is_refused() -> None:
    """Nothing prescribed, or too little to stop a rigid motion."""
    mesh = box_tets((2, 1, 1), (2.0, 1.0, 1.0)).boundary
    for prescribed in (False, np.array([True, False, False])):
        with pytest.raises(UserError, match="rigid motion"):
            WeightedResidual(Boundary.of_surface(mesh, prescribed), 10.0, 0.4, SMALL)


def test_wrong_materials_are_refused() -> None:
    """nu of 1/2 or more, and a modulus that is not positive."""
    for nu in (0.5, 0.6, np.nan):
        with pytest.raises(UserError, match="poisson_ratio"):
            WeightedResidual(box(), 10.0, nu, SMALL)
    for young in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(UserError, match="young_modulus"):
            WeightedResidual(box(), young, 0.4, SMALL)


def test_an_inside_out_body_is_refused() -> None:
    """Normals that point inward enclose no volume."""
    made = box()
    inward = Boundary(made.points, -made.normals, made.weights, made.prescribed)
    with pytest.raises(UserError, match="outward"):
        WeightedResidual(inward, 10.0, 0.4, SMALL)


def test_collocation_takes_no_point_loads() -> None:
    """Only the energy-consistent method knows what a force is."""
    system = WeightedResidual(box(), 10.0, 0.4, replace(SMALL, method="collocation"))
    with pytest.raises(UserError, match="nitsche"):
        system.point_loads(np.zeros((1, 3)))


@pytest.mark.parametrize(
    "change",
    [{"basis": "fourier"}, {"method": "galerkin"}, {"solver": "cg"}, {"degree": 0}, {"terms": 1.5}, {"terms": True},
     {"gamma": 0.0}, {"gamma": np.nan}, {"reach": -1.0}, {"limit": np.inf}, {"cut_off": 0.1}, {"patch_degree": 0},
     {"corrections": -1}, {"corrections": 1.5}, {"corrections": True}],
    ids=str,
)  # fmt: skip
def test_wrong_options_are_refused(change: dict[str, Any]) -> None:
    """Unknown names, numbers outside their range."""
    with pytest.raises(UserError):
        Options(**change)
