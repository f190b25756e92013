"""Meshes of triangles on a grid, for the tests of shells."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def grid_triangles(cells: tuple[int, int], diagonal: str = "falling") -> np.ndarray:
    """Return the triangles, (t, 3), of a grid of `cells`; node (i, j) has the number i (cells[1] + 1) + j.

    diagonal : "rising" = from (i, j) to (i + 1, j + 1), "falling" = the other, "crossed" = alternately
    """
    number = np.arange((cells[0] + 1) * (cells[1] + 1)).reshape(cells[0] + 1, cells[1] + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    rising = np.stack([np.stack([a, b, c], 2), np.stack([a, c, d], 2)], 2)
    falling = np.stack([np.stack([a, b, d], 2), np.stack([b, c, d], 2)], 2)
    odd = np.add.outer(np.arange(cells[0]), np.arange(cells[1])) % 2
    which = {"rising": 0 * odd, "falling": 0 * odd + 1, "crossed": odd}[diagonal]
    return np.where(which[:, :, None, None] == 0, rising, falling).reshape(-1, 3)


def grid_points(
    cells: tuple[int, int], low: tuple[float, float], high: tuple[float, float], place: Callable | None = None
) -> np.ndarray:
    """Return the nodes, (m, 3), between the corners `low` and `high`, in the plane z = 0 or at `place`(u, v)."""
    u, v = np.meshgrid(*(np.linspace(*side) for side in zip(low, high, (cells[0] + 1, cells[1] + 1))), indexing="ij")
    if place is None:
        return np.stack([u, v, 0.0 * u], axis=2).reshape(-1, 3)
    return np.stack(place(u, v), axis=2).reshape(-1, 3)


def shared_load(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the area that belongs to every node, (m,): a third of its triangles'."""
    corner = points[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return np.bincount(triangles.ravel(), np.repeat(area / 3.0, 3), len(points))
