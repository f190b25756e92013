"""Hexahedra of order p on a box: patch test, order of convergence, end loads, and what cannot be asked."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.bench.bricks import Bricks, graded, lagrange
from faceanim.ground.errors import UserError

AXES = (np.array([0.0, 0.7, 2.0]), np.array([0.0, 0.4, 1.0]), np.array([0.0, 0.5, 1.0]))


@pytest.mark.parametrize(("order", "average"), [(1, False), (1, True), (2, False), (3, False)])
def test_uniform_strain_is_exact(order: int, average: bool) -> None:
    """Prescribed on the whole boundary, a linear field comes back inside, with the reactions of its stress."""
    bricks = Bricks(AXES, 10.0, 0.45, order=order, average_dilatation=average)
    x = bricks.points
    matrix = 0.1 * np.random.default_rng(0).standard_normal((3, 3))
    outside = ((x < 1e-9) | (x > x.max(axis=0) - 1e-9)).any(axis=1)
    given = np.repeat(outside[:, None], 3, axis=1)
    u, reaction = bricks.solve(given, x @ matrix.T)
    np.testing.assert_allclose(u, x @ matrix.T, atol=1e-12)
    strain = 0.5 * (matrix + matrix.T)
    lame, shear = 10.0 * 0.45 / (1.45 * 0.1), 10.0 / 2.9
    stress = lame * np.trace(strain) * np.eye(3) + 2.0 * shear * strain
    np.testing.assert_allclose(x.T @ reaction, 2.0 * stress, atol=1e-10)  # virial: volume times stress
    y = np.random.default_rng(1).uniform(0.0, 1.0, (20, 3))
    np.testing.assert_allclose(bricks.at(y, u), y @ matrix.T, atol=1e-12)


def test_matrix_is_symmetric_and_knows_rigid_motion() -> None:
    """Six motions without energy, and no others."""
    for average in (False, True):
        k = Bricks(AXES, 10.0, 0.3, average_dilatation=average).matrix.toarray()
        np.testing.assert_allclose(k, k.T, atol=1e-12)
        assert (np.linalg.eigvalsh(k) < 1e-10).sum() == 6


def test_an_end_traction_pulls_with_its_resultant() -> None:
    """Consistent nodal forces add up, and a bar without Poisson's ratio lengthens by p L / E."""
    bricks = Bricks(AXES, 10.0, 0.0, order=2)
    given = np.repeat(bricks.points[:, :1] < 1e-9, 3, axis=1)
    u, reaction = bricks.solve(given, np.zeros_like(bricks.points), bricks.end_traction((0.5, 0.0, 0.0)))
    np.testing.assert_allclose(u[:, 0], 0.05 * bricks.points[:, 0], atol=1e-12)
    assert reaction[given[:, 0], 0].sum() == pytest.approx(-0.5)


def test_grading_and_shapes() -> None:
    """Graded corners grow by the ratio and end where asked; shape functions add to one."""
    axis = graded(5.0, 6, 2.0, both=True)
    np.testing.assert_allclose(np.diff(axis)[1:3] / np.diff(axis)[:2], 2.0)
    np.testing.assert_allclose(axis + axis[::-1], 5.0)
    value, slope = lagrange(3, np.linspace(0, 1, 7))
    np.testing.assert_allclose(value.sum(axis=1), 1.0)
    np.testing.assert_allclose(slope.sum(axis=1), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [{"order": 0}, {"poisson_ratio": 0.5}, {"young_modulus": 0.0}, {"order": 2, "average_dilatation": True},
     {"axes": (np.array([0.0, 0.0]),) * 3}, {"axes": AXES[:2]}],
    ids=str,
)  # fmt: skip
def test_wrong_bricks_are_refused(wrong: dict) -> None:
    """Order, constants and axes outside their range."""
    with pytest.raises(UserError):
        Bricks(**({"axes": AXES, "young_modulus": 10.0, "poisson_ratio": 0.3} | wrong))


def test_a_free_block_is_refused() -> None:
    """Nothing prescribed: the rigid motion is undetermined."""
    bricks = Bricks(AXES, 10.0, 0.3)
    with pytest.raises(UserError, match="rigid"):
        bricks.solve(np.zeros(bricks.points.shape, bool), np.zeros_like(bricks.points))
