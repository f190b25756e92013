"""Where rays meet triangle meshes."""

from __future__ import annotations

import numpy as np

from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Floats, Ints

_EDGE = 1e-9
"""How far beyond its edges a triangle is still met [-], so that no ray slips between two."""


def first_hit(start: Floats, direction: Floats, mesh: TriMesh, reach: float) -> tuple[Floats, Ints]:
    """Return how far each ray runs to its first hit, (n,) [mm], and the triangle that it meets, (n,).

    start, direction : (n, 3), direction of unit length;  inf and -1 where it misses `mesh` within `reach` [mm]
    """
    corner = mesh.points[mesh.triangles]
    centre = corner.mean(axis=1)
    size = (np.linalg.norm(corner - centre[:, None], axis=2).max(axis=1, initial=0.0) * (1.0 + _EDGE)) ** 2
    out, triangle = np.full(len(start), np.inf), np.full(len(start), -1, dtype=np.int32)
    for i, (p, d) in enumerate(zip(start, direction, strict=True)):
        way = centre - p
        near = np.flatnonzero(np.einsum("tk,tk->t", way, way) - (way @ d) ** 2 <= size + _EDGE)
        far = _distances(corner[near], p, d, reach)
        if len(near) and np.isfinite(far).any():
            triangle[i], out[i] = near[far.argmin()], far.min()
    return out, triangle


def _distances(corner: Floats, p: Floats, d: Floats, reach: float) -> Floats:
    """Return how far the ray from p along d runs to each triangle with `corner` (t, 3, 3), (t,); inf where it misses."""
    a, u, v = corner[:, 0], corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    h = np.cross(d, v)
    det = np.einsum("tk,tk->t", u, h)
    with np.errstate(divide="ignore", invalid="ignore"):
        w = p - a
        s = np.einsum("tk,tk->t", w, h) / det
        q = np.cross(w, u)
        r = q @ d / det
        far = np.einsum("tk,tk->t", v, q) / det
        hit = (s >= -_EDGE) & (r >= -_EDGE) & (s + r <= 1.0 + _EDGE) & (far >= 0) & (far <= reach)
    return np.where(hit, far, np.inf)


def ray_hit(start: Floats, direction: Floats, mesh: TriMesh, reach: float) -> Floats:
    """Return how far each ray runs to its first hit, (n,) [mm]; see `first_hit`."""
    return first_hit(start, direction, mesh, reach)[0]


def barycentric(corners: Floats, points: Floats) -> Floats:
    """Return the barycentric coordinates of `points` (n, 3) in triangles with `corners` (n, 3, 3), (n, 3)."""
    u, v, w = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    uu, uv, vv = (np.einsum("ij,ij->i", *pair) for pair in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("ij,ij->i", w, u), np.einsum("ij,ij->i", w, v)
    det = uu * vv - uv * uv
    b, c = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
    return np.stack([1.0 - b - c, b, c], axis=1)
