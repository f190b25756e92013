"""The parts of the distance field: sides by pseudo-normals, winding numbers, spline weights, the lattice's tetrahedra."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.geometry.bone_field import pseudo_normals
from faceanim.geometry.shapes import sphere
from faceanim.geometry.surface import TriMesh
from faceanim.kernels import bone_field as kernels

TETRAHEDRON = TriMesh(
    np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0.1, 0.1, 8.0]]), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
)


def corners_of(surface: TriMesh) -> np.ndarray:
    """Return the corners of every triangle."""
    return np.ascontiguousarray(surface.points[surface.triangles])


@pytest.mark.parametrize("surface", [TETRAHEDRON, sphere(3.0, 1)])
def test_sides_and_winding_numbers_agree(surface: TriMesh) -> None:
    """The nearest triangle's pseudo-normal tells the same side as the solid angle, wherever the nearest point lies."""
    corners, normals = corners_of(surface), pseudo_normals(surface)
    low, high = surface.points.min(axis=0) - 1.0, surface.points.max(axis=0) + 1.0
    points = np.random.default_rng(0).uniform(low, high, size=(400, 3))
    sides = []
    for x, y, z in points:
        distances = [kernels.inward(x, y, z, corners, t, *normals)[1] for t in range(len(corners))]
        nearest = int(np.argmin(distances))
        inside, d, *way = kernels.inward(x, y, z, corners, nearest, *normals)
        number = kernels.winding(x, y, z, corners)
        assert number == pytest.approx(round(number), abs=1e-9)
        assert inside == (number > 0.5)
        assert np.linalg.norm(way) == pytest.approx(d)
        sides.append(inside)
    assert 3 < sum(sides) < 397


def test_spline_weights_are_a_partition_of_unity() -> None:
    """The three bells sum to 1, their slopes to 0, and a linear function is reproduced."""
    for t in (-0.5, -0.2, 0.0, 0.31, 0.5):
        value, slope = np.array([kernels.bell(t, a) for a in (-1, 0, 1)]).T
        assert value.sum() == pytest.approx(1.0) and slope.sum() == pytest.approx(0.0, abs=1e-15)
        assert value @ [-1, 0, 1] == pytest.approx(t) and slope @ [-1, 0, 1] == pytest.approx(1.0)
        assert value.min() >= 0.0


def test_axes_are_ordered() -> None:
    """Largest, middle and smallest for every order, and for ties."""
    for numbers in ((3, 2, 1), (3, 1, 2), (2, 3, 1), (1, 3, 2), (2, 1, 3), (1, 2, 3), (1, 1, 2), (2, 1, 1), (1, 1, 1)):
        got = kernels.order_of(*(float(n) for n in numbers))
        assert sorted(got) == [0, 1, 2]
        assert [numbers[k] for k in got] == sorted(numbers, reverse=True)


def test_every_cube_is_six_tetrahedra() -> None:
    """A lattice with all nodes set has six positive tetrahedra a cube that fill it; with one node missing, fewer."""
    slot = np.arange(27, dtype=np.int32).reshape(3, 3, 3).copy()
    place = np.argwhere(slot >= 0).astype(float)
    cell, flip, node = np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(4, np.int64)
    for first in ((0, 0, 0), (-3, 2, 5)):
        start = np.array(first, dtype=np.int32)
        out = np.zeros((48, 4), np.int32)
        assert kernels.tetrahedra(slot, start, cell, flip, node, True, out) == 48
        edge = place[out[:, 1:]] - place[out[:, :1]]
        assert np.allclose(np.linalg.det(edge) / 6.0, 1.0 / 6.0)
    slot[1, 1, 1] = kernels.DEEP
    assert kernels.tetrahedra(slot, start, cell, flip, node, False, out) == 48 - (out == 13).any(axis=1).sum() < 48
