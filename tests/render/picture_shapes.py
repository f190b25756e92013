"""Shapes that the tests of the pictures share."""

from __future__ import annotations

import numpy as np


def ball(centre: object, radius: float, n: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Return points and outward triangles of a ball, mirror symmetric in x."""
    lift = np.pi * np.arange(n + 1) / n
    turn = 2.0 * np.pi * np.arange(2 * n) / (2 * n)
    s = np.sin(lift)[:, None]
    points = np.stack([s * np.sin(turn), np.cos(lift)[:, None] + 0.0 * turn, s * np.cos(turn)], axis=2)
    i, j = np.meshgrid(np.arange(n), np.arange(2 * n), indexing="ij")
    k = (j + 1) % (2 * n)
    a, b, c, d = i * 2 * n + j, (i + 1) * 2 * n + j, (i + 1) * 2 * n + k, i * 2 * n + k
    quads = np.stack([a, b, c, a, c, d], axis=2).reshape(-1, 3)
    return np.asarray(centre) + radius * points.reshape(-1, 3), quads.astype(np.int32)
