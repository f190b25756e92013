"""The boundary of a body: points with normals and areas, and what is prescribed there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Bools, Floats, floats, frozen
from faceanim.ground.errors import UserError


@dataclass(frozen=True, eq=False)
class Boundary:
    """n points of a closed boundary with what is prescribed there, component by component.

    points : (n, 3) [mm]   normals : (n, 3) unit, outward   weights : (n,) [mm^2], areas that the points stand for
    prescribed : (n, 3) bool, whether the displacement is given (else the traction)
    values : (n, 3), displacement [mm] or traction [kPa]
    """

    points: Floats
    normals: Floats
    weights: Floats
    prescribed: Bools
    values: Floats

    def __init__(self, points: Any, normals: Any, weights: Any, prescribed: Any, values: Any = None) -> None:
        x = floats("boundary.points", points, None, 3)
        if not len(x):
            raise UserError("boundary: it has no points; at least some are needed on every face of the body")
        n = len(x)
        v = np.zeros((n, 3)) if values is None else values
        p = np.asarray(prescribed, dtype=bool)
        if p.shape in ((), (3,)):
            p = np.broadcast_to(p, (n, 3))
        if p.shape != (n, 3):
            raise UserError(f"boundary: prescribed has shape {p.shape}; ({n}, 3) is needed")
        fields = {
            "points": x,
            "normals": floats("boundary.normals", normals, n, 3),
            "weights": floats("boundary.weights", weights, n),
            "values": floats("boundary.values", v, n, 3),
        }
        if not (fields["weights"] > 0).all():
            raise UserError("boundary: every weight must be positive")
        if np.abs(np.linalg.norm(fields["normals"], axis=1) - 1.0).max() > 1e-6:
            raise UserError("boundary: every normal must have length 1")
        for name, value in fields.items():
            object.__setattr__(self, name, frozen(value.copy()))
        object.__setattr__(self, "prescribed", frozen(np.ascontiguousarray(p)))

    @classmethod
    def of_surface(cls, surface: TriMesh, prescribed: Any = False, values: Any = None, *, order: int = 2) -> Boundary:
        """Return the boundary `surface`, seen from outside, with the quadrature points of each triangle.

        prescribed, values : (t, 3) by triangle, or as `Boundary` says for all points   order : 1, 2 or 4, exactness
        """
        local, share = TRIANGLE_RULES[order]
        corner = surface.points[surface.triangles]
        points = np.einsum("qa,tai->tqi", local, corner).reshape(-1, 3)
        cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = 0.5 * np.linalg.norm(cross, axis=1)
        many = len(share)
        given = np.broadcast_to(np.asarray(prescribed, dtype=bool), (len(corner), 3))
        given_values = np.zeros((len(corner), 3)) if values is None else np.broadcast_to(values, (len(corner), 3))
        return cls(
            points, np.repeat(0.5 * cross / area[:, None], many, axis=0), (area[:, None] * share).ravel(),
            np.repeat(given, many, axis=0), np.repeat(given_values, many, axis=0),
        )  # fmt: skip

    @classmethod
    def joined(cls, parts: Sequence[Boundary]) -> Boundary:
        """Return several pieces as one."""
        names = ("points", "normals", "weights", "prescribed", "values")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def with_values(self, values: Any) -> Boundary:
        """Return the same boundary with other `values` (n, 3)."""
        return Boundary(self.points, self.normals, self.weights, self.prescribed, values)

    def scaled(self, factor: float) -> Boundary:
        """Return the boundary in another unit of length: points and prescribed displacements times `factor`."""
        values = np.where(self.prescribed, factor * self.values, self.values)
        return Boundary(factor * self.points, self.normals, factor**2 * self.weights, self.prescribed, values)

    @property
    def extent(self) -> float:
        """The largest dimension [mm]."""
        return float(np.ptp(self.points, axis=0).max())

    @property
    def thickness(self) -> float:
        """Four volumes per area [mm]: about the side of the cross-section of a long body."""
        volume = float((self.weights * (self.points * self.normals).sum(axis=1)).sum()) / 3.0
        return 4.0 * volume / float(self.weights.sum())

    def reject_floating(self) -> None:
        """Raise `UserError` if what is prescribed leaves the body free to move as a whole."""
        if not self.prescribed.any():
            raise UserError(
                "boundary: no displacement is prescribed anywhere, so the rigid motion is undetermined; "
                "prescribe displacements at three points or more"
            )
        x = (self.points - self.points.mean(axis=0)) / max(self.extent, 1e-300)
        rows = np.zeros((len(x), 3, 6))
        rows[:, :, :3] = np.eye(3)
        for a in range(3):
            rows[:, :, 3 + a] = np.cross(np.eye(3)[a], x)
        if np.linalg.matrix_rank(rows[self.prescribed], tol=1e-6 * np.sqrt(self.prescribed.sum())) < 6:
            raise UserError(
                "boundary: the prescribed displacements leave a rigid motion undetermined; prescribe more components"
            )


_A, _B = 0.445948490915965, 0.091576213509771
TRIANGLE_RULES: dict[int, tuple[Floats, Floats]] = {
    1: (np.full((1, 3), 1 / 3), np.ones(1)),
    2: (np.full((3, 3), 1 / 6) + 0.5 * np.eye(3), np.full(3, 1 / 3)),
    4: (
        np.concatenate([np.full((3, 3), a) + (1 - 3 * a) * np.eye(3) for a in (_A, _B)]),
        np.repeat([0.223381589678011, 0.109951743655322], 3),
    ),
}
"""Exactness -> barycentric points (q, 3) and shares of the area (q,) (Dunavant 1985)."""
