"""Signed distance to a closed surface, sampled on a regular grid and read by trilinear interpolation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Distances [mm] on a grid: positive outside, negative inside, clamped to +-`values.max()` far away.

    values : (nx, ny, nz) float32   origin : (3,) [mm] of sample (0, 0, 0)   spacing : [mm]
    """

    values: np.ndarray
    origin: Floats
    spacing: float

    def __post_init__(self) -> None:
        if self.values.ndim != 3 or min(self.values.shape) < 2 or not self.spacing > 0:
            raise UserError(f"distance grid: shape {self.values.shape}, spacing {self.spacing} cannot be interpolated")

    def sample(self, points: Floats) -> Floats:
        """Return the distance at `points` (n, 3), (n,) [mm]; the far value outside the grid."""
        top = np.array(self.values.shape) - 1
        u = (np.asarray(points, dtype=np.float64) - self.origin) / self.spacing
        inside = ((u >= 0) & (u <= top)).all(axis=1)
        cell = np.clip(np.floor(u).astype(np.int64), 0, top - 1)
        f = np.clip(u - cell, 0.0, 1.0)
        out = np.zeros(len(u))
        for corner in range(8):
            step = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
            weight = np.prod(np.where(step == 1, f, 1.0 - f), axis=1)
            i, j, k = (cell + step).T
            out += weight * self.values[i, j, k]
        return np.where(inside, out, float(self.values.max()))
