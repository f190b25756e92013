"""From modal amplitudes to positions, and from nodal forces back to generalised forces."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from faceanim.backends.modal_warping import kernels
from faceanim.backends.modal_warping.build import Modes, factorised
from faceanim.backends.nodal import carried
from faceanim.body.solid import Solid
from faceanim.ground.arrays import Floats
from faceanim.kernels import warp


class NodeWarp:
    """Every node turned by its own rotation: x = X + Rt(w) uL (Eq. 22), with uL and w linear in the amplitudes.

    moved : (n, 6) uL [mm] and w [rad] of the last placement   points : (n, 3) [mm] where it put the nodes
    force_kind, warped : which force (see `kernels.warp.project`) and whether nodes are turned at all
    """

    def __init__(self, solid: Solid, modes: Modes, variant: str) -> None:
        self.solid, self.modes, self.rest = solid, modes, np.ascontiguousarray(solid.mesh.points)
        n, columns = len(self.rest), modes.basis.shape[2]
        self.moved, self.points = np.zeros((n, 6)), self.rest.copy()
        self.amplitudes = np.zeros(columns)
        self.pose = np.zeros((0, 4, 4))
        self.held = np.flatnonzero(solid.held)
        self.out = np.zeros(modes.count)
        self.warped = variant != "linear"
        self.force_kind = {"linear": warp.LINEAR, "consistent": warp.CONSISTENT}.get(variant, warp.PAPER)
        self._placed = False

    def place(self, q: Floats, twist: Floats, pose: Floats) -> Floats:
        """Return the nodes' positions (n, 3) [mm] at amplitudes `q`, with the bones at `twist` (bones, 6) and `pose`.

        Held nodes are exactly where the bones carry them. The result is kept, and given again if nothing changed.
        """
        m, z = self.modes.count, self.amplitudes
        flat = twist.ravel()
        same = self._placed and np.array_equal(z[:m], q) and np.array_equal(z[m:], flat)
        if same and np.array_equal(self.pose, pose):
            return self.points
        z[:m], z[m:], self.pose = q, flat, pose.copy()
        moving = np.flatnonzero(flat)
        count = m + (int(moving[-1]) + 1 if len(moving) else 0)
        warp.local(self.modes.basis, z, count, self.moved)
        self._shape()
        self._placed = True
        return self.points

    def _shape(self) -> None:
        warp.warp(self.rest, self.moved, self.warped, self.points)
        self.points[self.held] = carried(self.solid, self.pose)

    def project(self, force: Floats) -> Floats:
        """Return the generalised force (m,) of nodal forces (n, 3), at the last placement; overwritten by the next call."""
        warp.project(self.modes.basis, self.moved, force, self.force_kind, self.out)
        return self.out


class RotationStrain(NodeWarp):
    """Elements turned by exp([w_e]x) and stretched by their strain, joined by min sum V_e |grad x - F_e|^2.

    With the consistent force (Huang, Li & Desbrun's line of work) unless the variant is "rotation_strain_shape".
    """

    def __init__(self, solid: Solid, modes: Modes, variant: str) -> None:
        super().__init__(solid, modes, variant)
        mesh = solid.mesh
        self.tets, self.gradients = np.ascontiguousarray(mesh.tets), mesh.gradients
        self.volumes = np.ascontiguousarray(mesh.volumes)
        laplacian = _laplacian(solid)
        self.free = np.flatnonzero(~solid.held)
        self.coupling = laplacian[self.free][:, self.held]
        self.factors = factorised(laplacian[self.free][:, self.free])
        self.own_force = variant == "rotation_strain"
        self.scratch, self.right = np.zeros((3, 3, 3)), np.zeros_like(self.rest)
        self.potential = np.zeros_like(self.rest)

    def _shape(self) -> None:
        kernels.rotation_strain(self.tets, self.gradients, self.volumes, self.moved, self.scratch, self.right)
        at = carried(self.solid, self.pose)
        self.points[self.held] = at
        self.points[self.free] = self.factors.solve(self.right[self.free] - self.coupling @ at)

    def project(self, force: Floats) -> Floats:
        """Return the generalised force (m,) of nodal forces (n, 3): J^T F by one solve and a sum over elements."""
        if not self.own_force:
            return super().project(force)
        self.potential[self.free] = self.factors.solve(np.ascontiguousarray(force[self.free]))
        kernels.rotation_strain_force(
            self.tets, self.gradients, self.volumes, self.moved, self.potential, self.scratch, self.right
        )
        warp.project(self.modes.basis, self.moved, self.right, warp.LINEAR, self.out)
        return self.out


def _laplacian(solid: Solid) -> Any:
    """Return sum V_e g_a . g_b, (n, n)."""
    mesh = solid.mesh
    blocks = np.einsum("e,eai,ebi->eab", mesh.volumes, mesh.gradients, mesh.gradients)
    i, j = np.repeat(mesh.tets, 4, axis=1).ravel(), np.tile(mesh.tets, (1, 4)).ravel()
    n = len(mesh.points)
    return sparse.coo_matrix((blocks.ravel(), (i, j)), shape=(n, n)).tocsr()


def make_shape(solid: Solid, modes: Modes, variant: str) -> NodeWarp:
    """Return the shape of `variant`, one of `options.VARIANTS`."""
    if variant.startswith("rotation_strain"):
        return RotationStrain(solid, modes, variant)
    return NodeWarp(solid, modes, variant)
