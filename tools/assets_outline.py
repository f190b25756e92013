"""Outlines of hair and throat in the side view, shared by the region labels and the texture."""

from __future__ import annotations

import numpy as np

# Outlines in the side view, (z, y) [mm].
HAIR = (
    (130.0, 82.0), (96.0, 80.0), (88.0, 79.0), (76.0, 72.0), (70.0, 60.0), (66.0, 46.0), (54.0, 36.0), (42.0, 22.0),
    (35.0, 6.0), (32.0, -12.0), (18.0, -13.0), (15.0, 16.0), (6.0, 26.0), (-10.0, 25.0), (-18.0, 14.0), (-23.0, -10.0),
    (-28.0, -32.0), (-45.0, -48.0), (-70.0, -53.0), (-130.0, -53.0), (-130.0, 150.0), (130.0, 150.0),
)  # fmt: skip
THROAT = (
    (110.0, -104.0), (90.0, -104.0), (60.0, -93.0), (29.0, -80.0), (8.0, -50.0), (-6.0, -36.0), (-28.0, -33.0),
    (-45.0, -49.0), (-70.0, -54.0), (-160.0, -54.0), (-160.0, -300.0), (110.0, -300.0),
)  # fmt: skip


def inside_outline(points: np.ndarray, outline: tuple[tuple[float, float], ...]) -> np.ndarray:
    """Signed distance [mm] to a closed outline drawn in the side view, positive inside; outline of (z, y) corners."""
    corner = np.array(outline)
    q = points[:, [2, 1]]
    nearest = np.full(len(q), np.inf)
    inside = np.zeros(len(q), bool)
    for a, b in zip(corner, np.roll(corner, -1, axis=0)):
        t = np.clip((q - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(q - a - t[:, None] * (b - a), axis=1))
        crosses = (a[1] > q[:, 1]) != (b[1] > q[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            at = a[0] + (q[:, 1] - a[1]) * (b[0] - a[0]) / (b[1] - a[1])
        inside ^= crosses & (q[:, 0] < at)
    return np.where(inside, nearest, -nearest)
