"""Distances to a triangle mesh: of points, and signed on a grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from faceanim.geometry.distance import DistanceGrid
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Floats, Ints, floats
from faceanim.ground.errors import UserError

_LARGEST_GRID = 60_000_000
# Grid lines are moved off round numbers by this share of a cell, so that none runs along an edge of a mesh.
_OFFSET = np.array([0.0123456789, 0.0171572875, 0.0157179672])


def point_distance(points: Floats, mesh: TriMesh) -> tuple[Floats, Ints]:
    """Return the unsigned distance of `points` (n, 3) to `mesh`, (n,) [mm], and the nearest triangle, (n,)."""
    from faceanim.kernels import distance_field as kernels

    points = floats("points", points, None, 3)
    corners = np.ascontiguousarray(mesh.points[mesh.triangles])
    if not len(corners):
        raise UserError("the distance to a mesh without triangles is not defined")
    centres = np.ascontiguousarray(corners.mean(axis=1))
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    used = np.unique(mesh.triangles)
    bound = np.ascontiguousarray(cKDTree(mesh.points[used]).query(points)[0])
    distance, triangle = np.empty(len(points)), np.empty(len(points), dtype=np.int32)
    kernels.nearest_triangle(points, corners, centres, radii, bound, distance, triangle)
    return distance, triangle


def winding_vote(corners: Floats, origin: Floats, spacing: float, shape: tuple[int, ...]) -> np.ndarray:
    """Mean winding number on the grid, seen along the six directions of its lines, (nx, ny, nz)."""
    from faceanim.kernels import distance_field as kernels

    total = np.zeros(shape, dtype=np.float32)
    for axis in range(3):
        order = [axis, (axis + 1) % 3, (axis + 2) % 3]
        steps = np.zeros([shape[k] for k in order], dtype=np.int16)
        kernels.count_crossings(corners, axis, origin, spacing, steps)
        forward = np.cumsum(steps, axis=0, dtype=np.int16)
        backward = forward - forward[-1:]
        total += np.transpose(forward + backward, np.argsort(order)) / 6.0
    return total


def signed_distance_grid(
    meshes: Sequence[TriMesh],
    *,
    spacing: float,
    margin: float,
    band: float,
    symmetric: bool = False,
    even: bool = False,
) -> DistanceGrid:
    """Return the signed distance to the union of `meshes` on a grid, positive outside, clamped to +-band [mm].

    The inside is where the winding number, averaged over the six directions of the grid lines, exceeds one half: a
    vote that small holes and flipped triangles do not overturn. Inner walls of a union are not removed: distances
    inside overlapping meshes are to the nearest of all walls' union, that is the most negative of the single ones.

    spacing, margin (around the meshes), band : [mm];  symmetric : mirror about x = 0, exactly
    even : an even number of samples along x, so that x = 0 lies between two (only with `symmetric`)
    """
    from faceanim.kernels import distance_field as kernels

    low = np.min([m.points.min(axis=0) for m in meshes], axis=0) - margin
    high = np.max([m.points.max(axis=0) for m in meshes], axis=0) + margin
    if symmetric:
        half = (np.ceil(max(-low[0], high[0]) / spacing) + 0.5 * even) * spacing
        low[0], high[0] = -half, half
    shape = tuple(int(c) for c in np.round(np.ceil((high - low) / spacing - 1e-9)).astype(int) + 1)
    if np.prod(shape) > _LARGEST_GRID:
        raise UserError(f"a distance grid of {shape} samples is too large; choose a spacing above {spacing:g} mm")
    values = np.full(shape, band, dtype=np.float64)
    for mesh in meshes:
        corners = np.ascontiguousarray(mesh.points[mesh.triangles])
        squared = np.full(shape, band * band)
        kernels.splat_distance(corners, low, spacing, band, squared)
        inside = winding_vote(corners, low + _OFFSET * spacing * 1e-3, spacing, shape) > 0.5
        values = np.minimum(values, np.where(inside, -1.0, 1.0) * np.sqrt(squared))
    if symmetric:
        values = 0.5 * (values + values[::-1])
    return DistanceGrid(values.astype(np.float32), low, float(spacing))
