"""Simple shapes for tests, demonstrations and benchmarks."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from faceanim.geometry.surface import TriMesh
from faceanim.geometry.volume import TetMesh
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


SPLITS = ("kuhn", "mirrored")


def box_tets(cells: tuple[int, int, int], size: tuple[float, float, float], *, split: str = "mirrored") -> TetMesh:
    """Return a box from the origin to `size` [mm] as cells[0] x cells[1] x cells[2] cubes of six tetrahedra each.

    Node (i, j, k) has the number (i * (cells[1] + 1) + j) * (cells[2] + 1) + k.
    split : "kuhn" gives every cube the same main diagonal, which makes the box lean sideways under load;
    "mirrored" turns neighbouring cubes into mirror images, so that it does not
    """
    if min(cells) < 1 or not min(size) > 0 or split not in SPLITS:
        raise UserError(
            f"box: cells {cells} must be at least 1, sizes {size} positive, split one of {', '.join(SPLITS)}"
        )
    axes = [np.linspace(0.0, s, c + 1) for s, c in zip(size, cells, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cell = np.stack(np.meshgrid(*(np.arange(c) for c in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    flip = cell % 2 if split == "mirrored" else np.zeros_like(cell)
    stride = np.array([(cells[1] + 1) * (cells[2] + 1), cells[2] + 1, 1])
    tets = []
    for path in permutations(range(3)):
        corner = np.zeros((4, 3), dtype=np.int64)
        for step, axis in enumerate(path):
            corner[step + 1 :, axis] = 1
        at = cell[:, None, :] + (corner[None] ^ flip[:, None, :])
        even = _parity(path) * np.where(flip.sum(axis=1) % 2, -1, 1) > 0
        index = (at * stride).sum(axis=2)
        tets.append(np.where(even[:, None], index, index[:, [0, 2, 1, 3]]))
    return TetMesh(points, np.stack(tets, axis=1).reshape(-1, 4).astype(np.int32))


def _parity(order: tuple[int, ...]) -> int:
    swaps = sum(order[i] > order[j] for i in range(len(order)) for j in range(i + 1, len(order)))
    return -1 if swaps % 2 else 1
