"""Where the mimetic muscles run within the flesh of a head."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from faceanim.face.attach import LIP
from faceanim.face.columns import Columns
from faceanim.face.muscles import LidMuscle, LinearMuscle, SheetMuscle, SphincterMuscle, both_sides
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats

if TYPE_CHECKING:
    from faceanim.face.face import Face

HALF_WIDTH = 5.0
"""Of the belly of a linear muscle across its line [mm]; sheet muscles have their own."""
HALF_THICKNESS = 3.0
"""Of any belly, along the columns [mm]."""
_ZONE = 0.05


def muscular(face: Face, columns: Columns, mesh: TetMesh, layers: int) -> Bools:
    """Return which elements are muscle, (e,): along the lines of linear and sheet muscles, and in the rings."""
    # the three elements of a prism are of one kind
    centre = mesh.points[mesh.tets].mean(axis=1).reshape(-1, 3, 3).mean(axis=1).repeat(3, axis=0)
    run = columns.foot - columns.top
    run = (run / np.linalg.norm(run, axis=1, keepdims=True))[mesh.tets // (layers + 1)].mean(axis=1)
    run = run.reshape(-1, 3, 3).mean(axis=1).repeat(3, axis=0)
    run /= np.linalg.norm(run, axis=1, keepdims=True)
    out = np.zeros(len(centre), dtype=bool)
    for muscle, _ in both_sides(face.muscle_table).values():
        if isinstance(muscle, (LinearMuscle, SheetMuscle)):
            line = [muscle.origin, *([muscle.via] if muscle.via else []), muscle.insertion]
            wide = muscle.half_width if isinstance(muscle, SheetMuscle) else HALF_WIDTH
            for a, b in pairwise(line):
                away = _from_segment(centre, np.array(a), np.array(b))
                deep = np.abs(np.einsum("ei,ei->e", away, run))
                across = np.sqrt(np.maximum(np.einsum("ei,ei->e", away, away) - deep**2, 0.0))
                out |= (deep < HALF_THICKNESS) & (across < wide)
    ring = _in_rings(face)[columns.vertex] | (face.region[columns.vertex] == LIP)
    return np.asarray(out | ring[mesh.tets // (layers + 1)].reshape(-1, 12).all(axis=1).repeat(3))


def _in_rings(face: Face) -> Bools:
    """Return the vertices that sphincters and lid muscles pull, (n,)."""
    muscles = face.muscles
    rings = [
        name
        for name, (muscle, _) in both_sides(face.muscle_table).items()
        if isinstance(muscle, (SphincterMuscle, LidMuscle))
    ]
    out = np.zeros(len(face.mesh.points), dtype=bool)
    for k in (i for i, name in enumerate(muscles.names) if name in rings):
        row = muscles.muscle == k
        density = muscles.weight[row] / face.mesh.vertex_areas[muscles.node[row]]
        out[muscles.node[row][density > _ZONE * density.max()]] = True
    return out | out[face.mirror]


def _from_segment(points: Floats, a: Floats, b: Floats) -> Floats:
    """Return the way from the nearest point between `a` and `b` to each of `points` (k, 3), (k, 3) [mm]."""
    way = b - a
    share = np.clip((points - a) @ way / (way @ way), 0.0, 1.0)
    return np.asarray(points - a - share[:, None] * way)
