"""What pulls the modes: forces on nodes, and the energy that they have."""

from __future__ import annotations

import numpy as np

from faceanim.backends.nodal import Pull
from faceanim.body.body import PULL_TO_POINT, Body
from faceanim.body.control import Control
from faceanim.body.solid import Solid
from faceanim.ground.arrays import Floats, Ints
from faceanim.kernels import muscles


class Loads(Pull):
    """Muscles, surface forces and gravity on the free nodes of a solid, with their potential."""

    def __init__(self, body: Body, solid: Solid) -> None:
        super().__init__(body, solid)
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
        if control.activation.any():
            surface = np.asarray(self.matrix @ points)
            total += float(muscles.pull_energy(self.fibres, control.activation, control.bone_pose, surface))
        return total


class MuscleStiffness:
    """How much less the muscles pull to their points as the modes give way, for steps that are long for it.

    A fibre that pulls with F to a point at the distance r has at most the stiffness F / r. Of each muscle the modes see
    G = sum F / r0 P^T P, r0 at rest and P the motion of its vertices per unit of each mode; while it shortens, G grows by
    the largest r0 / r. That is an upper bound: a step with it is stable, and the equilibrium does not depend on it.
    """

    def __init__(self, body: Body, loads: Pull, shapes: Floats) -> None:
        u, m = body.muscles, shapes.shape[1]
        self.fibre = np.flatnonzero(u.kind == PULL_TO_POINT)
        self.muscle, self.node, self.bone = u.muscle[self.fibre], u.node[self.fibre], u.bone[self.fibre]
        self.point, self.softening = u.point[self.fibre], np.maximum(u.softening[self.fibre], 1e-3)
        self.count = len(u.names)
        self.inverse_rest = 1.0 / self._distance(body.surface.points, np.tile(np.eye(4), (len(body.bones), 1, 1)))
        pull = u.max_force[self.muscle] * u.weight[self.fibre] * self.inverse_rest
        self.stiffness = np.zeros((self.count, m, m))
        moved = shapes.reshape(-1, 3, m)
        for k in range(self.count):
            own = self.muscle == k
            rows = loads.matrix[self.node[own]]
            for axis in range(3):
                p = rows @ moved[:, axis]
                self.stiffness[k] += p.T @ (pull[own, None] * p)

    def _distance(self, surface: Floats, pose: Floats) -> Floats:
        aim = np.einsum("kij,kj->ki", pose[self.bone, :3, :3], self.point) + pose[self.bone, :3, 3]
        return np.asarray(np.sqrt(((aim - surface[self.node]) ** 2).sum(axis=1) + self.softening**2))

    def at(self, control: Control, surface: Floats) -> Floats | None:
        """Return the stiffness (m, m) of the modes while the surface is at `surface`, None if no muscle acts."""
        acting: Ints = np.flatnonzero(control.activation).astype(np.int32)
        if not len(acting) or not len(self.fibre):
            return None
        nearer = np.zeros(self.count)
        np.maximum.at(nearer, self.muscle, 1.0 / (self.inverse_rest * self._distance(surface, control.bone_pose)))
        return np.tensordot(control.activation[acting] * nearer[acting], self.stiffness[acting], axes=1)
