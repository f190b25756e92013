"""Quadratic wedges: they fill their columns, hold affine fields exactly and agree with quadratic tetrahedra."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.elements.factor import Cholesky, Factor
from faceanim.elements.newton import newton
from faceanim.elements.tetrahedra import Elements
from faceanim.elements.wedges import Wedges, wedge_shapes
from faceanim.geometry.shapes import box_tets
from faceanim.ground.errors import UserError
from faceanim.tissue.material import Material

SOFT = Material("soft", 1e-6, 20.0, 0.4)


def sheet(nx: int, ny: int, layers: int, *, bent: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Columns under a sheet of 4 x 3, 2 deep: levels (m, layers + 1, 3) and triangles."""
    x, y = np.meshgrid(np.linspace(0, 4, nx + 1), np.linspace(0, 3, ny + 1), indexing="ij")
    top = np.stack([x.ravel(), y.ravel(), bent * np.sin(x.ravel() + 0.7 * y.ravel())], axis=1)
    depth = np.linspace(0.0, 2.0, layers + 1)
    levels = top[:, None] - depth[None, :, None] * np.array([0.1 * bent, 0.0, 1.0])
    triangles = []
    for i in range(nx):
        for j in range(ny):
            a = i * (ny + 1) + j
            b, c, d = a + ny + 1, a + ny + 2, a + 1
            triangles += [(a, b, c), (a, c, d)]
    return levels, np.array(triangles, dtype=np.int32)


def test_shape_functions_are_one_at_their_node() -> None:
    """Eighteen functions, each 1 at its node and 0 at the others; they sum to 1 and their slopes to 0."""
    corners = np.eye(3)
    flat = np.concatenate([corners, 0.5 * (corners + corners[[1, 2, 0]])])
    at, depth = np.tile(flat, (3, 1)), np.repeat([0.0, 0.5, 1.0], 6)
    values, _ = wedge_shapes(at, depth)
    np.testing.assert_allclose(values, np.eye(18), atol=1e-14)
    values, slopes = wedge_shapes(np.array([[0.2, 0.5, 0.3]]), np.array([0.3]))
    assert values.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(slopes.sum(axis=1), 0.0, atol=1e-13)


def test_an_affine_field_is_exact_in_bent_columns() -> None:
    """The patch test: boundary nodes moved by F put all nodes there, and every point has that deformation gradient."""
    levels, triangles = sheet(3, 2, 3, bent=0.2)
    wedges = Wedges(levels, triangles, SOFT)
    F = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, 0.1], [0.05, 0.0, 1.05]])
    goal = wedges.points @ F.T
    inner = np.zeros(len(goal), dtype=bool)
    height = 2 * wedges.layers + 1
    middle = np.flatnonzero((np.abs(levels[:, 0, 0] - 2.0) < 1.0) & (levels[:, 0, 1] > 0) & (levels[:, 0, 1] < 3))
    for m in middle:
        inner[m * height + 1 : (m + 1) * height - 1] = True
    assert inner.any()
    found, report = newton(wedges, fixed=~inner, values=goal)
    assert report.converged
    np.testing.assert_allclose(found, goal, atol=1e-9)
    np.testing.assert_allclose(wedges.volume_ratio(found), np.linalg.det(F), rtol=1e-9)


def test_volume_and_forces() -> None:
    """The weights sum to the volume between the sheets, and forces are minus the energy's gradient."""
    levels, triangles = sheet(2, 2, 2)
    wedges = Wedges(levels, triangles, SOFT)
    assert wedges.cells.weight.sum() == pytest.approx(24.0, rel=1e-12)
    random = np.random.default_rng(0)
    x = wedges.points + 0.05 * random.normal(size=wedges.points.shape)
    way = random.normal(size=x.shape)
    h = 1e-5
    slope = (wedges.energy(x + h * way) - wedges.energy(x - h * way)) / (2 * h)
    assert -float((wedges.forces(x) * way).sum()) == pytest.approx(slope, rel=1e-7)
    change = (wedges.forces(x + h * way) - wedges.forces(x - h * way)) / (2 * h)
    np.testing.assert_allclose(
        -(wedges.tangent(x) @ way.ravel()), change.ravel(), rtol=1e-6, atol=1e-5 * np.abs(change).max()
    )


def test_a_bent_block_agrees_with_quadratic_tetrahedra() -> None:
    """Held on one side and moved on the other, wedges and tetrahedra store the same energy within 1 %."""
    levels, triangles = sheet(4, 3, 2)
    wedges = Wedges(levels, triangles, SOFT)
    tets = Elements(box_tets((4, 3, 2), (4.0, 3.0, 2.0)), SOFT, order=2)
    energies = []
    for body in (wedges, tets):
        p = body.points
        left, right = p[:, 0] < 1e-9, p[:, 0] > 4.0 - 1e-9
        goal = p + right[:, None] * np.array([0.3, 0.2, 0.8])
        found, report = newton(body, fixed=left | right, values=goal)
        assert report.converged
        energies.append(body.energy(found))
    assert energies[0] == pytest.approx(energies[1], rel=0.01)


def test_columns_that_cross_are_refused() -> None:
    """Levels in the wrong order give a wedge without volume."""
    levels, triangles = sheet(2, 2, 2)
    with pytest.raises(UserError, match="inverted or flat"):
        Wedges(levels[:, ::-1], triangles, SOFT)


def test_cholesky_solves_as_the_general_factor_does() -> None:
    """Both give the same answer; a matrix that is not definite is not factorised."""
    pytest.importorskip("cholespy")
    levels, triangles = sheet(2, 2, 2)
    wedges = Wedges(levels, triangles, SOFT)
    free = np.repeat((wedges.points[:, 0] > 1e-9)[:, None], 3, axis=1)
    values = wedges.tangent_values(wedges.points, np.empty(len(wedges.indices)))
    right = np.random.default_rng(0).normal(size=wedges.points.shape)
    one, other = Factor(wedges, free), Cholesky(wedges, free)
    assert one.factor(values) and other.factor(values) and other.definite()
    np.testing.assert_allclose(other.solve(right), one.solve(right), rtol=1e-9, atol=1e-9)
    assert not other.factor(-values) and not other.definite()
