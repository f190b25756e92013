"""Which elements of a solid a model keeps, and the rows of positions of its nodes and its bones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from faceanim.body.solid import Solid
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats

ARM = 100.0
"""Distance of a bone's marks from its first one [mm]."""


class Flesh:
    """Some of the elements of a solid, and rows of positions: the k nodes of `mesh`, then d held nodes that only left
    out elements have, then four marks of each of the b marked bones.

    The marks are carried by their bone alone, as held nodes are; from them the bone's pose is read.
    mesh, region : the elements kept   present : (e,) elements that are kept or that another model stands for
    used : (k + d,) nodes of the solid, row by row   row : (n,) row of each node, -1 = none
    points : (k + d + 4 b, 3) [mm] at rest   weight : (k + d + 4 b, n_bone)
    """

    def __init__(self, solid: Solid, *, layer: int | None = None, gap: int | None = None, marked: Sequence[int] = ()):
        """Leave out the elements of the regions `layer`, whose outer nodes get no row, and `gap`; mark bones `marked`."""
        mesh = solid.mesh
        film = _removable(solid, layer, gap)
        kept = ~film if layer is None else ~film & (solid.region != layer)
        own = np.unique(mesh.tets[kept])
        lost = np.setdiff1d(mesh.tets[film], mesh.tets[~film])
        self.present = ~film
        self.used = np.concatenate([own, lost]).astype(np.int32)
        self.row = np.full(len(mesh.points), -1, dtype=np.int32)
        self.row[self.used] = np.arange(len(self.used))
        self.mesh = mesh if kept.all() else TetMesh(mesh.points[own], self.row[mesh.tets[kept]])
        self.region = solid.region[kept]
        self.marked = tuple(marked)
        marks = np.tile(ARM * np.concatenate([np.zeros((1, 3)), np.eye(3)]), (len(self.marked), 1))
        self.points = np.concatenate([mesh.points[self.used], marks])
        on = np.eye(solid.bone_weight.shape[1])[np.repeat(np.array(self.marked, dtype=np.int32), 4)]
        self.weight = np.concatenate([solid.bone_weight[self.used], on])

    @property
    def extra(self) -> int:
        """How many rows belong to no element."""
        return len(self.points) - len(self.mesh.points)

    def mass(self, solid: Solid) -> Floats:
        """Return the mass of each row, (k + d + 4 b,) [kg]: what is left out stays at its nodes, marks have none."""
        out = np.zeros(len(self.points))
        out[: len(self.used)] = solid.node_mass[self.used]
        return out

    def full(self, x: Floats) -> Floats:
        """Return where the nodes of the solid are, (n, 3) [mm]; those without a row are left to be filled."""
        out = np.zeros((len(self.row), 3))
        out[self.used] = x[: len(self.used)]
        return out

    def poses(self, x: Floats) -> Floats:
        """Return the poses of the marked bones at positions `x`, (b, 4, 4); halfway between two they are rigid as well."""
        marks = x[len(self.used) : len(self.points)].reshape(-1, 4, 3)
        out = np.tile(np.eye(4), (len(marks), 1, 1))
        u, _, vt = np.linalg.svd((marks[:, 1:] - marks[:, :1]).transpose(0, 2, 1))
        out[:, :3, :3], out[:, :3, 3] = u @ vt, marks[:, 0]
        return out


def _removable(solid: Solid, layer: int | None, gap: int | None) -> Bools:
    """Return the elements of the region `gap` without those whose loss would leave a node loose that no bone holds, (e,)."""
    film = np.zeros(len(solid.region), dtype=bool) if gap is None else solid.region == gap
    solid_part = ~film if layer is None else ~film & (solid.region != layer)
    loose = ~solid.held
    loose[solid.mesh.tets[solid_part]] = False
    return np.asarray(film & ~loose[solid.mesh.tets].any(axis=1))
