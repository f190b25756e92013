"""The left-right symmetry of a body: a symmetric scene needs one half only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from faceanim.backends.mass_spring import kernels
from faceanim.body.body import PULL_ALONG, Body
from faceanim.body.control import Control
from faceanim.geometry import topology
from faceanim.ground.arrays import Floats, Ints

CLOSE = 1e-6
"""Positions [mm] and activations that differ by no more count as mirror images."""
FLIP = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The reflection x -> -x that maps a body onto itself: the image of each vertex (n,) and each muscle (m,)."""

    vertex: Ints
    muscle: Ints

    def holds(self, q: Floats, qd: Floats, control: Control) -> bool:
        """Return whether positions, velocities (n, 3), muscles and bones are their own mirror images."""
        active, pose = np.asarray(control.activation), control.bone_pose
        sideways = max(float(np.abs(pose[:, 0, 1:]).max()), float(np.abs(pose[:, 1:3, 0]).max()))
        if sideways > 1e-12 or np.abs(active - active[self.muscle]).max(initial=0.0) > CLOSE:
            return False
        return kernels.asymmetry(q, self.vertex) < CLOSE and kernels.asymmetry(qd, self.vertex) < 1e3 * CLOSE


def find_symmetry(body: Body) -> Symmetry | None:
    """Return the body's symmetry about the plane x = 0, or None if it has none."""
    vertex = topology.mirror_images(body.surface.points)
    if vertex is None or not (_same_surface(body, vertex) and _same_obstacles(body, vertex)):
        return None
    a = body.attachment
    for field in (body.mass, body.pinned, a.stiffness, a.bone_weight):
        if not np.allclose(field, field[vertex], rtol=1e-6, atol=1e-12):
            return None
    muscle = _mirror_muscles(body, vertex)
    return None if muscle is None else Symmetry(vertex, muscle)


def _same_surface(body: Body, vertex: Ints) -> bool:
    """Return whether the mirrored triangles are the same set, with the same modulus and shear layer."""
    corners = body.surface.triangles
    own, image = (np.sort(t, axis=1) for t in (corners, vertex[corners]))
    mine, its = np.lexsort(own.T), np.lexsort(image.T)
    if not np.array_equal(own[mine], image[its]):
        return False
    fields = (body.membrane_modulus, body.attachment.shear, body.attachment.shear_limit)
    return all(f is None or np.allclose(f[mine], f[its], rtol=1e-6) for f in fields)


def _same_obstacles(body: Body, vertex: Ints) -> bool:
    """Return whether bones and eyeballs lie as far from each vertex as from its image, and whether both may touch."""
    points = body.surface.points
    for bone in body.bones:
        if bone.grid is not None:
            far = bone.grid.sample(points)
            if np.abs(far - far[vertex]).max(initial=0.0) > 1e3 * CLOSE:
                return False
    touching = [p.node for p in body.pairs], [s.node for s in body.spheres]
    nodes = [np.concatenate(kind) for kind in touching if kind]
    if body.bone_contact is not None:
        nodes += [body.bone_contact.node[body.bone_contact.bone == b] for b in range(len(body.bones))]
    balls = {(*np.round(s.centre, 5), round(s.radius, 5)) for s in body.spheres}
    images = {(*np.round(s.centre * FLIP, 5), round(s.radius, 5)) for s in body.spheres}
    return balls == images and all(np.array_equal(np.unique(node), np.unique(vertex[node])) for node in nodes)


def _mirror_muscles(body: Body, vertex: Ints) -> Ints | None:
    """Return each muscle's mirror image, (m,), or None if some muscle has none."""
    u = body.muscles
    table = {}
    for k in range(len(u.names)):
        table[k] = _fibres(body, k, np.arange(len(vertex), dtype=np.int32), np.ones(3))
    out = np.full(len(u.names), -1, dtype=np.int32)
    for k in table:
        image = _fibres(body, k, vertex, FLIP)
        for j, own in table.items():
            if own.shape == image.shape and np.allclose(own, image, rtol=1e-6, atol=1e-6):
                out[k] = j
                break
        else:
            return None
    return out


def _fibres(body: Body, k: int, vertex: Ints, flip: Floats) -> Floats:
    """Return what defines muscle `k`, mirrored by `vertex` and `flip`, one fibre a row, in the order of vertices."""
    u = body.muscles
    rows = np.flatnonzero(u.muscle == k)
    force = np.full(len(rows), u.max_force[k])
    columns = (vertex[u.node[rows]], u.kind[rows] == PULL_ALONG, u.bone[rows], u.weight[rows], force, u.softening[rows])
    whole: Floats = np.column_stack([*columns, u.point[rows] * flip])
    return whole[np.lexsort(whole[:, [3, 0]].T)]
