"""Triangle meshes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from faceanim.ground.arrays import Floats, Ints, floats, frozen, ints
from faceanim.ground.errors import UserError


@dataclass(frozen=True, eq=False)
class TriMesh:
    """A triangle mesh: `points` (n, 3) [mm] and `triangles` (t, 3), counter-clockwise seen from outside."""

    points: Floats
    triangles: Ints

    def __init__(self, points: Any, triangles: Any) -> None:
        p = floats("points", points, None, 3)
        object.__setattr__(self, "points", frozen(p.copy()))
        object.__setattr__(self, "triangles", frozen(ints("triangles", triangles, None, 3, below=len(p)).copy()))

    @cached_property
    def normals_by_area(self) -> Floats:
        """Triangle normals scaled by area, (t, 3) [mm^2]."""
        a, b, c = (self.points[self.triangles[:, k]] for k in range(3))
        return 0.5 * np.cross(b - a, c - a)

    @cached_property
    def areas(self) -> Floats:
        """Triangle areas, (t,) [mm^2]."""
        return np.linalg.norm(self.normals_by_area, axis=1)

    @cached_property
    def vertex_areas(self) -> Floats:
        """One third of the incident triangles' areas, (n,) [mm^2]."""
        out = np.zeros(len(self.points))
        np.add.at(out, self.triangles.ravel(), np.repeat(self.areas / 3.0, 3))
        return out

    @cached_property
    def vertex_normals(self) -> Floats:
        """Unit normals, area-weighted, (n, 3); zero where a vertex has no triangle."""
        out = np.zeros_like(self.points)
        np.add.at(out, self.triangles.ravel(), np.repeat(self.normals_by_area, 3, axis=0))
        length = np.linalg.norm(out, axis=1, keepdims=True)
        return np.divide(out, length, out=np.zeros_like(out), where=length > 0)

    @cached_property
    def heights(self) -> Floats:
        """Height of each corner over the line through the opposite edge, (t, 3) [mm]."""
        corners = self.points[self.triangles]
        opposite = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num(2.0 * self.areas[:, None] / opposite)

    def reject_degenerate(self, smallest_height: float = 1e-6) -> None:
        """Raise `UserError` naming the first triangle whose smallest height is below `smallest_height` [mm]."""
        low = self.heights.min(axis=1) if len(self.triangles) else np.zeros(0)
        if (low < smallest_height).any():
            t = int(np.argmax(low < smallest_height))
            raise UserError(
                f"triangle {t} (vertices {self.triangles[t].tolist()}) is degenerate: height {low[t]:.2g} mm is below "
                f"{smallest_height:g} mm; weld or remove it"
            )
