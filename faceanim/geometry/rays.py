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
    a = mesh.points[mesh.triangles[:, 0]]
    u = mesh.points[mesh.triangles[:, 1]] - a
    v = mesh.points[mesh.triangles[:, 2]] - a
    out, triangle = np.full(len(start), np.inf), np.full(len(start), -1, dtype=np.int32)
    for i, (p, d) in enumerate(zip(start, direction, strict=True)):
        h = np.cross(d, v)
        det = np.einsum("tk,tk->t", u, h)
        with np.errstate(divide="ignore", invalid="ignore"):
            w = p - a
            s = np.einsum("tk,tk->t", w, h) / det
            q = np.cross(w, u)
            r = q @ d / det
            far = np.einsum("tk,tk->t", v, q) / det
            hit = np.flatnonzero((s >= -_EDGE) & (r >= -_EDGE) & (s + r <= 1.0 + _EDGE) & (far >= 0) & (far <= reach))
        if len(hit):
            triangle[i] = hit[far[hit].argmin()]
            out[i] = far[triangle[i]]
    return out, triangle


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
