"""A patch under a control: where the bones carry it, how the muscles pull it, what it touches; and its forces."""

from __future__ import annotations

import numpy as np

from faceanim.backends.mass_spring import build, kernels
from faceanim.backends.mass_spring.build import Patch
from faceanim.backends.solver import Energy
from faceanim.body.control import Control
from faceanim.ground.arrays import Floats
from faceanim.kernels import attachment, contact, muscles
from faceanim.kernels.springs import elastic_energy, force_scratch
from faceanim.kernels.tables import Moment

NEAREST = 0.3
"""Lips and lids nearer than this beyond their gap [mm] are always watched; farther ones if they may meet in a step."""


class Load:
    """The work space of one patch and the boundary conditions that a control sets on it.

    x : (n, 3) positions [mm]   force : (n, 4) forces [mN] and stiffness bounds [mN/mm]   moment : see `Moment`
    """

    def __init__(self, patch: Patch) -> None:
        n, e = len(patch.nodes), len(patch.scene.fibres.muscle)
        self.patch = patch
        self.x = np.zeros((n, 3))
        self.force = np.zeros((n, 4))
        pose = np.zeros((patch.scene.tethers.bone_weight.shape[1], 4, 4))
        planes = build.room_for_planes(patch.scene.colliders, n)
        self.moment = Moment(
            np.zeros((n, 3)),
            pose,
            np.zeros(n + 1, dtype=np.int32),
            np.zeros((e, 3)),
            np.zeros(e),
            np.zeros(e),
            planes,
            np.zeros((n, 3)),
        )
        self.activation = np.zeros(patch.muscles)
        self.lead = np.zeros((n, 3))
        self._anchors = np.zeros((2, n, 3))
        self.scratch = force_scratch(patch.scene.springs)

    def apply(self, control: Control) -> None:
        """Carry the anchors by the bones and aim the muscles."""
        scene, moment = self.patch.scene, self.moment
        if not np.array_equal(moment.pose, control.bone_pose):
            moment.pose[:] = control.bone_pose
            attachment.carry(scene.tethers, moment.pose, moment.anchor)
        self.activation[:] = control.activation
        muscles.aim(scene.fibres, control.activation, moment.pose, moment)

    def rest(self) -> None:
        """Set everything as at rest: positions, bones, muscles, contacts."""
        scene, moment = self.patch.scene, self.moment
        moment.pose[:] = np.eye(4)
        attachment.carry(scene.tethers, moment.pose, moment.anchor)
        moment.first[:] = 0
        self.x[:] = scene.tethers.rest
        self.touch(self.x, 0.0)

    def touch(self, x: Floats, reach: float, pair_reach: float | None = None) -> None:
        """Find the contacts nearer than `reach` [mm] at `x`, those of lips and lids nearer than `pair_reach`."""
        scene, near = self.patch.scene, reach if pair_reach is None else pair_reach
        contact.find(x, scene.colliders, scene.grids, self.moment.pose, reach, near, self.moment.planes)

    def follow(self, pose: Floats, pose_before: Floats) -> None:
        """Note by how much the bones speed up, from their poses now and one step before: the skin's guess follows.

        lead = anchor next - 2 anchor now + anchor before; `ahead` adds it once.
        """
        new = self.moment.pose
        if np.array_equal(new, pose) and np.array_equal(new, pose_before):
            return
        for k, known in enumerate((pose, pose_before)):
            attachment.carry(self.patch.scene.tethers, known, self._anchors[k])
        kernels.second_difference(self.moment.anchor, self._anchors[0], self._anchors[1], self.patch.m, self.lead)

    def ahead(self, v: Floats, h: float, least: float, reach: float, pair_reach: float) -> None:
        """Move `x` on by h v and find the contacts for the step: those of lips and lids where it starts, still apart."""
        scene, moment, x = self.patch.scene, self.moment, self.x
        way = h * kernels.fastest(v, scene.colliders.pair_node)
        near = min(pair_reach, NEAREST + 2.0 * way)
        moment.planes.count[1] = contact.find_pairs(x, scene.colliders, near, 0, moment.planes)
        kernels.extrapolate(x, v, h, least)
        kernels.add_once(x, self.lead, self.patch.m)
        contact.hold_back(x, scene.free, moment.planes)
        kernels.reflect(x, self.patch.half)
        contact.find_rigid(x, scene.colliders, scene.grids, moment.pose, reach, moment.planes)

    def forces(self, x: Floats) -> Floats:
        """Return the forces at `x` with the stiffness bounds, (n, 4): springs, tethers, muscles and known contacts."""
        kernels.total_force(x, self.patch.scene, self.moment, self.scratch, self.force)
        return self.force

    def energy(self, x: Floats) -> Energy:
        """Return the energies at `x`, without the kinetic part; of the contacts those found last."""
        scene, moment, m = self.patch.scene, self.moment, self.patch.m
        return Energy(
            kinetic=0.0,
            elastic=elastic_energy(x, scene.springs, scene.law),
            attachment=attachment.tether_energy(x, moment.anchor, scene.tethers, m),
            contact=contact.plane_energy(x, moment.planes, scene.colliders.stiffening),
            muscle=muscles.fibre_energy(x, moment, m),
        )
