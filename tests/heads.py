"""Other heads, made from the built-in one: scaled, stretched and mirrored."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from faceanim.face.face import Eyeball, Face
from faceanim.geometry.surface import TriMesh


def _swapped(names: Any) -> dict[str, str]:
    turn = {"left": "right", "right": "left"}
    return {n: "_".join(turn.get(part, part) for part in n.split("_")) for n in names}


def other_head(face: Face, scale: Any) -> Face:
    """Return `face` with x, y, z multiplied by `scale` (one number or three); a negative x mirrors it."""
    factor = np.broadcast_to(np.asarray(scale, dtype=np.float64), 3)
    flip = factor[0] < 0
    size = float(abs(np.prod(factor)) ** (1.0 / 3.0))

    def mesh(old: TriMesh) -> TriMesh:
        return TriMesh(old.points * factor, old.triangles[:, ::-1] if flip else old.triangles)

    def named(table: dict[str, Any]) -> dict[str, Any]:
        turn = _swapped(table) if flip else {n: n for n in table}
        return {turn[n]: value for n, value in table.items()}

    skull = replace(
        face.skull,
        cranium=mesh(face.cranium),
        jaw=mesh(face.jaw_mesh),
        landmarks=named({n: p * factor for n, p in face.skull.landmarks.items()}),
    )
    return replace(
        face,
        mesh=mesh(face.mesh),
        skull=skull,
        landmarks=named(face.landmarks),
        contact_sets=named(face.contact_sets),
        depth=face.depth * size,
        eyes=named({n: Eyeball(e.centre * factor, e.radius * size) for n, e in face.eyes.items()}),
        parts=tuple(replace(p, points=p.points * factor) for p in face.parts),
        uv_triangles=face.uv_triangles[:, ::-1] if flip else face.uv_triangles,
    )
