"""Laws of coarsening: fewer vertices, all of them old ones, the same shape and the same border."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.geometry.coarsen import coarsened
from faceanim.geometry.shapes import sheet, sphere
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.topology import edges
from faceanim.ground.errors import UserError


def lengths(mesh: TriMesh) -> np.ndarray:
    a, b = mesh.points[edges(mesh.triangles)].transpose(1, 0, 2)
    return np.linalg.norm(a - b, axis=1)


def test_a_sphere_stays_a_closed_sphere() -> None:
    """Euler's number is 2, no triangle turns inwards, and the volume stays within a few percent."""
    ball = sphere(30.0, 4)
    left = TriMesh(ball.points, coarsened(ball, np.full(len(ball.points), 8.0)))
    v, e, t = len(np.unique(left.triangles)), len(edges(left.triangles)), len(left.triangles)
    assert v - e + t == 2 and t < 0.25 * len(ball.triangles)
    outward = np.einsum("ti,ti->t", left.normals_by_area, left.points[left.triangles].mean(axis=1))
    assert outward.min() > 0
    assert outward.sum() == pytest.approx(
        np.einsum("ti,ti->", ball.normals_by_area, ball.points[ball.triangles].mean(1)), rel=0.06
    )
    assert np.percentile(lengths(left), 5) > 5.0


def test_the_border_and_its_corners_stay() -> None:
    """Vertices with different labels do not merge, so a square keeps its corners, its outline and its area."""
    square = sheet(20, 20, 40.0, 40.0)
    x, y = square.points[:, 0], square.points[:, 1]
    side, top = np.abs(np.abs(x) - 20.0) < 1e-9, np.abs(np.abs(y) - 20.0) < 1e-9
    rail = np.where(side & top, np.arange(len(x)) + 10, np.where(side, 1, np.where(top, 2, 0))).astype(np.int32)
    left = TriMesh(square.points, coarsened(square, np.full(len(x), 9.0), rail=rail))
    assert left.areas.sum() == pytest.approx(1600.0)
    assert set(np.flatnonzero(side & top)) <= set(np.unique(left.triangles))
    assert len(left.triangles) < 0.2 * len(square.triangles)


def test_small_sizes_change_nothing() -> None:
    """When every edge is long enough the triangles are the old ones."""
    ball = sphere(30.0, 2)
    np.testing.assert_array_equal(coarsened(ball, np.full(len(ball.points), 0.5)), ball.triangles)


def test_sizes_must_fit() -> None:
    """One positive length per vertex."""
    ball = sphere(30.0, 1)
    for size in (np.ones(3), np.zeros(len(ball.points))):
        with pytest.raises(UserError, match="one positive length per vertex"):
            coarsened(ball, size)
