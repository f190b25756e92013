"""What pulls the modes: forces on nodes, and the energy that they have."""

from __future__ import annotations

import numpy as np

from faceanim.backends.nodal import Pull
from faceanim.body.body import PULL_TO_POINT, Body
from faceanim.body.control import Control
from faceanim.body.solid import Solid
from faceanim.ground.arrays import Floats


class Loads(Pull):
    """Muscles, surface forces and gravity on the free nodes of a solid, with their potential."""

    def __init__(self, body: Body, solid: Solid) -> None:
        super().__init__(body, solid)
        self.muscles = body.muscles
        self.held = solid.held
        self.rest = solid.mesh.points
        self.surface = body.surface.points.copy()

    def force(self, control: Control, points: Floats) -> Floats | None:
        """Return the nodal forces (n, 3) [mN] while the nodes are at `points` (n, 3), zero at held nodes; None if none."""
        pulls = bool(control.activation.any())
        if not (pulls or control.loaded):
            return None
        if pulls:
            self.surface = np.asarray(self.matrix @ points)
        force = self.at(control, self.surface)
        force[self.held] = 0.0
        return force

    def energy(self, control: Control, points: Floats) -> float:
        """Return the potential of all pulls and loads with the nodes at `points` (n, 3) [uJ]; loads zero at rest."""
        moved = points - self.rest
        total = -float(self.mass @ moved @ control.gravity)
        if control.force is not None:
            total -= float((control.force * (self.matrix @ moved)).sum())
        m = self.muscles
        pull = control.activation[m.muscle] * m.max_force[m.muscle] * m.weight
        active = np.flatnonzero(pull)
        if not len(active):
            return total
        pose = control.bone_pose[m.bone[active]]
        at = (self.matrix @ points)[m.node[active]]
        aim = np.einsum("kij,kj->ki", pose[:, :3, :3], m.point[active])
        d = aim + pose[:, :3, 3] - at
        soft = np.maximum(m.softening[active], 1e-3)
        to_point = np.sqrt((d**2).sum(axis=1) + soft**2)
        along = -(aim * at).sum(axis=1)
        return total + float(pull[active] @ np.where(m.kind[active] == PULL_TO_POINT, to_point, along))
