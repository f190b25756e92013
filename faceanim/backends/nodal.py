"""What backends of solids share: which body they can take, where bones carry its nodes, and what pulls them."""

from __future__ import annotations

import numpy as np

from faceanim.body.body import Body, Muscles
from faceanim.body.control import Control
from faceanim.body.solid import Solid
from faceanim.geometry.topology import grouped
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError
from faceanim.kernels import muscles
from faceanim.kernels.tables import Fibres


def solid_of(body: Body, backend: str) -> Solid:
    """Return the body's volume; raise `UserError` if it has none or one that cannot be used."""
    if body.solid is None:
        raise UserError(f"backend {backend} needs flesh with a volume; this body is only a surface")
    body.solid.reject_bad()
    return body.solid


def carried(solid: Solid, pose: Floats) -> Floats:
    """Return where the bones at `pose` (n_bone, 4, 4) carry the held nodes, (n_held, 3) [mm]."""
    return carry(solid.mesh.points[solid.held], solid.bone_weight[solid.held], pose)


def carry(points: Floats, weight: Floats, pose: Floats) -> Floats:
    """Return where the bones at `pose` carry `points` (n, 3) by their `weight` (n, n_bone), (n, 3) [mm]."""
    moved = np.einsum("bij,nj->nbi", pose[:, :3, :3], points) + pose[None, :, :3, 3]
    return np.einsum("nb,nbi->ni", weight, moved)


def fibre_table(muscle: Muscles, n: int) -> Fibres:
    """Return the fibres of all muscles sorted by the vertex that they pull, of `n` vertices."""
    rows = grouped(muscle.node, np.arange(len(muscle.node), dtype=np.int32), n)
    k = rows.item
    return Fibres(
        rows.start,
        muscle.muscle[k],
        muscle.kind[k],
        muscle.bone[k],
        muscle.max_force[muscle.muscle[k]] * muscle.weight[k],
        np.ascontiguousarray(muscle.point[k]),
        np.maximum(muscle.softening[k], 1e-3),
    )


class Pull:
    """What pulls a solid: its muscles and forces through its surface, and gravity on its nodes.

    surface_force : (n_surface, 3) [mN] of the last call   matrix : (n_surface, n_node) weights of the surface vertices
    """

    def __init__(self, body: Body, solid: Solid) -> None:
        n = len(solid.mesh.points)
        self.fibres = fibre_table(body.muscles, len(body.surface.points))
        self.matrix = solid.skin.matrix(n)
        self._spread = self.matrix.T.tocsr()
        self.mass = solid.node_mass
        self.surface_force = np.zeros_like(body.surface.points)

    def at(self, control: Control, surface: Floats) -> Floats:
        """Return the nodal forces, (n_node, 3) [mN], while the surface is at `surface` (n_surface, 3)."""
        force = self.surface_force
        force[:] = 0.0 if control.force is None else control.force
        muscles.pull(self.fibres, control.activation, control.bone_pose, surface, force)
        return np.asarray(self._spread @ force + self.mass[:, None] * control.gravity)


def push_out(points: Floats, body: Body) -> None:
    """Move the surface `points` (n, 3) that are inside the body's spheres (eyeballs) out to their clearance, in place."""
    for ball in body.spheres:
        away = points[ball.node] - ball.centre
        distance = np.linalg.norm(away, axis=1)
        wanted = ball.radius + (ball.clearance if ball.thick_clearance is None else ball.thick_clearance)
        inside = (distance < wanted) & (distance > 1e-9)
        factor = (wanted[inside] / distance[inside])[:, None]
        points[ball.node[inside]] = ball.centre + away[inside] * factor
