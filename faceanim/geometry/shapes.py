"""Simple shapes for tests, demonstrations and benchmarks."""

from __future__ import annotations

import numpy as np

from faceanim.geometry.surface import TriMesh
from faceanim.ground.errors import UserError


def sheet(nx: int, ny: int, width: float, height: float, *, bulge: float = 0.0) -> TriMesh:
    """Return a sheet of (nx + 1) (ny + 1) vertices centred in the plane z = 0, seen from +z, mirror symmetric in x.

    The diagonals are mirrored about x = 0, so `nx` must be even. `bulge` [mm] lifts the middle along z (paraboloid).
    """
    if nx < 2 or nx % 2 or ny < 1 or not (width > 0 and height > 0):
        raise UserError(f"sheet: nx = {nx} must be even and positive, ny = {ny} positive, sides positive")
    u = np.linspace(-0.5, 0.5, nx + 1)
    u = 0.5 * (u - u[::-1])  # exactly mirror symmetric
    v = np.linspace(-0.5, 0.5, ny + 1)
    grid_v, grid_u = np.meshgrid(v, u, indexing="ij")
    z = bulge * (1.0 - 2.0 * grid_u**2 - 2.0 * grid_v**2)
    points = np.stack([width * grid_u, height * grid_v, z], axis=2).reshape(-1, 3)
    row, column = (a.ravel() for a in np.meshgrid(np.arange(ny), np.arange(nx), indexing="ij"))
    p = row * (nx + 1) + column
    q, r, s = p + 1, p + nx + 2, p + nx + 1
    left = (column < nx // 2)[:, None]
    first = np.where(left, np.stack([p, q, r], 1), np.stack([p, q, s], 1))
    second = np.where(left, np.stack([p, r, s], 1), np.stack([q, r, s], 1))
    return TriMesh(points, np.stack([first, second], axis=1).reshape(-1, 3))


def sphere(radius: float, subdivisions: int = 3) -> TriMesh:
    """Return a sphere about the origin with 20 * 4^subdivisions nearly equal triangles."""
    if not radius > 0 or subdivisions < 0:
        raise UserError(f"sphere: radius = {radius} must be positive, subdivisions = {subdivisions} not negative")
    g = 0.5 * (1.0 + 5.0**0.5)
    points = np.array(
        [
            (-1, g, 0),
            (1, g, 0),
            (-1, -g, 0),
            (1, -g, 0),
            (0, -1, g),
            (0, 1, g),
            (0, -1, -g),
            (0, 1, -g),
            (g, 0, -1),
            (g, 0, 1),
            (-g, 0, -1),
            (-g, 0, 1),
        ],
        dtype=np.float64,
    )
    triangles = np.array(
        [
            (0, 11, 5),
            (0, 5, 1),
            (0, 1, 7),
            (0, 7, 10),
            (0, 10, 11),
            (1, 5, 9),
            (5, 11, 4),
            (11, 10, 2),
            (10, 7, 6),
            (7, 1, 8),
            (3, 9, 4),
            (3, 4, 2),
            (3, 2, 6),
            (3, 6, 8),
            (3, 8, 9),
            (4, 9, 5),
            (2, 4, 11),
            (6, 2, 10),
            (8, 6, 7),
            (9, 8, 1),
        ],
        dtype=np.int32,
    )
    for _ in range(subdivisions):
        sides = np.stack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]], axis=1)
        unique, index = np.unique(np.sort(sides.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
        ab, bc, ca = (len(points) + index.reshape(-1, 3)).T
        points = np.concatenate([points, 0.5 * (points[unique[:, 0]] + points[unique[:, 1]])])
        a, b, c = triangles.T
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = np.concatenate([np.stack(part, axis=1) for part in parts])
    points = radius * points / np.linalg.norm(points, axis=1, keepdims=True)
    return TriMesh(points, triangles)
