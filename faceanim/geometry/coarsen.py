"""Coarser triangle meshes whose vertices are some of the finer mesh's own: edges collapse, shortest first."""

from __future__ import annotations

import heapq
import math

import numpy as np

from faceanim.geometry.surface import TriMesh
from faceanim.geometry.topology import edges
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import UserError

_Vector = tuple[float, float, float]
_LEAST_SHAPE = 0.3
_LEAST_COSINE = 0.5
_LONGEST = 1.9


def coarsened(mesh: TriMesh, size: Floats, *, rail: Ints | None = None, deviation: float = 0.12) -> Ints:
    """Return triangles (t, 3) over the vertices of `mesh` whose edges are mostly longer than `size`.

    A vertex goes by moving onto a neighbour, so what is left are vertices of the mesh itself.
    size : (n,) [mm] wanted length of edges   deviation : how far a removed vertex may lie off the new surface, as a
    share of its size   rail : (n,) 0 = free; vertices of the border move only along it, and only onto equal labels
    Raises `UserError` if `size` does not fit.
    """
    if size.shape != (len(mesh.points),) or not (size > 0).all():
        raise UserError("coarsening: size must be one positive length per vertex")
    work = _Collapse(mesh, size, np.zeros(len(size), dtype=np.int32) if rail is None else rail, deviation)
    work.run()
    return work.triangles()


class _Collapse:
    """The mesh while it is coarsened: corners of each triangle, triangles at each vertex."""

    def __init__(self, mesh: TriMesh, size: Floats, rail: Ints, deviation: float) -> None:
        self.point: list[_Vector] = [tuple(p) for p in mesh.points.tolist()]
        self.size, self.rail, self.deviation = size.tolist(), rail.tolist(), deviation
        self.corner: list[tuple[int, int, int] | None] = [tuple(t) for t in mesh.triangles.tolist()]
        self.at: list[set[int]] = [set() for _ in self.point]
        for t, corner in enumerate(mesh.triangles.tolist()):
            for v in corner:
                self.at[v].add(t)
        self.border = [False] * len(self.point)
        self.heap: list[tuple[float, int, int]] = []
        for a, b in edges(mesh.triangles).tolist():
            if len(self.at[a] & self.at[b]) == 1:
                self.border[a] = self.border[b] = True
            self._push(a, b)

    def triangles(self) -> Ints:
        """Return what is left, (t, 3)."""
        left = [c for c in self.corner if c is not None]
        return np.array(left, dtype=np.int32).reshape(-1, 3)

    def run(self) -> None:
        """Collapse edges, the shortest for their size first, until none is short."""
        while self.heap:
            _, a, b = heapq.heappop(self.heap)
            if not self.at[a] or not self.at[b] or not self.at[a] & self.at[b]:
                continue
            for gone, kept in ((a, b), (b, a)):
                if self._may(gone, kept):
                    self._collapse(gone, kept)
                    break

    def _push(self, a: int, b: int) -> None:
        a, b = min(a, b), max(a, b)
        cost = math.dist(self.point[a], self.point[b]) / (0.5 * (self.size[a] + self.size[b]))
        if cost < 1.0:
            heapq.heappush(self.heap, (round(cost, 9), a, b))

    def _ring(self, v: int) -> set[int]:
        ring = {w for t in self.at[v] for w in self.corner[t] or ()}
        ring.discard(v)
        return ring

    def _may(self, gone: int, kept: int) -> bool:
        shared = self.at[gone] & self.at[kept]
        if self.rail[gone] and self.rail[gone] != self.rail[kept]:
            return False
        if self.border[gone] and not (self.border[kept] and len(shared) == 1):
            return False
        if len(self._ring(gone) & self._ring(kept)) != len(shared):
            return False
        if len(self.at[gone]) == len(shared):
            return False
        return self._keeps_shape(gone, kept, shared)

    def _keeps_shape(self, gone: int, kept: int, shared: set[int]) -> bool:
        p = self.point
        nearest = math.inf
        longest = _LONGEST * self.size[gone]
        if any(math.dist(p[kept], p[w]) > longest for w in self._ring(gone) - {kept}):
            return False
        for t in self.at[gone] - shared:
            corner = self.corner[t]
            assert corner is not None
            old = [p[v] for v in corner]
            new = [p[kept if v == gone else v] for v in corner]
            before, after = _normal(*old), _normal(*new)
            size_before, size_after = math.hypot(*before), math.hypot(*after)
            if size_before > 1e-9 and _dot(before, after) < _LEAST_COSINE * size_before * size_after:
                return False
            shape = _shape(new, size_after)
            if shape < _LEAST_SHAPE and shape < _shape(old, size_before):
                return False
            nearest = min(nearest, abs(_dot(after, _minus(p[gone], new[0]))) / max(size_after, 1e-12))
        return self.border[gone] or nearest <= self.deviation * self.size[gone]

    def _collapse(self, gone: int, kept: int) -> None:
        for t in list(self.at[gone]):
            corner = self.corner[t]
            assert corner is not None
            if kept in corner:
                for v in corner:
                    self.at[v].discard(t)
                self.corner[t] = None
            else:
                a, b, c = (kept if v == gone else v for v in corner)
                self.corner[t] = (a, b, c)
                self.at[kept].add(t)
        self.at[gone] = set()
        for v in self._ring(kept):
            self._push(kept, v)


def _minus(a: _Vector, b: _Vector) -> _Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _dot(a: _Vector, b: _Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _normal(a: _Vector, b: _Vector, c: _Vector) -> _Vector:
    u, v = _minus(b, a), _minus(c, a)
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])


def _shape(corner: list[_Vector], double_area: float) -> float:
    """Return 1 for an equilateral triangle, 0 for a flat one."""
    a, b, c = corner
    return (
        2.0
        * math.sqrt(3.0)
        * double_area
        / max(math.dist(a, b) ** 2 + math.dist(b, c) ** 2 + math.dist(c, a) ** 2, 1e-30)
    )
