"""The mass-tensor model of surgery simulation as a system to be solved: linear, or with Green's strain.

Cotin, Delingette & Ayache, A hybrid elastic model for real-time cutting, deformations, and force feedback for surgery
training and simulation, The Visual Computer 16, 2000 (linear); Picinbono, Delingette & Ayache, Non-linear anisotropic
elasticity for real-time surgery simulation, Graphical Models 65, 2003 (St Venant-Kirchhoff). Brought to rest, it is the
finite element solution of the same law: what it changes is how forces are summed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from faceanim.elements.tetrahedra import LAWS, Elements
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Floats, Ints, frozen
from faceanim.kernels import mass_tensor, solids
from faceanim.tissue.material import Material

PAIRS = np.array([(k, l) for k in range(4) for l in range(k, 4)])
"""Corners of the pairs of an element, in the kernels' order."""


class MassTensor(Elements):
    """Linear tetrahedra whose energy and forces come from vertex, edge and element tensors; a `newton.System`.

    The tangent is that of `Elements`. Like its law it knows no barrier: look at `Report.valid` before using a result.
    """

    laws: ClassVar[Mapping[str, int]] = {name: LAWS[name] for name in ("linear", "stvk")}

    def __init__(
        self,
        mesh: TetMesh,
        materials: Material | Sequence[Material],
        region: Any = None,
        *,
        law: str = "stvk",
        coupled: Ints | None = None,
        extra: int = 0,
    ) -> None:
        """Compile the tensors; the arguments are those of `Elements`, `law` is "linear" or "stvk"."""
        super().__init__(mesh, materials, region, law=law, coupled=coupled, extra=extra)
        lame, shear = self.cells.constant[:, 0] * mesh.volumes, self.cells.constant[:, 1] * mesh.volumes
        slope = self.cells.gradient[:, 0]
        start, other, linear = self._linear(slope, lame, shear)
        cubic, quartic = _cubic(slope, lame, shear), _quartic(slope, lame, shear)
        tables: tuple[Any, ...] = (start, other, linear, self.cells.node, cubic, quartic)
        self.tensors = mass_tensor.Tensors(*map(frozen, tables))
        e = len(mesh.tets)
        self._s, self._t = np.zeros((e, 10)), np.zeros((e, 10))

    def _linear(self, slope: Floats, lame: Floats, shear: Floats) -> tuple[Ints, Ints, Floats]:
        """Return the tensors of vertices and edges, in rows of vertices: start, other vertex, tensor (3, 3)."""
        block = np.einsum("e,eai,ebj->eabij", lame, slope, slope)
        block += np.einsum("e,ebi,eaj->eabij", shear, slope, slope)
        block += np.einsum("e,eak,ebk,ij->eabij", shear, slope, slope, np.eye(3))
        pattern = self.node_pattern
        row = np.repeat(np.arange(len(self.points), dtype=np.int64), np.diff(pattern.indptr))
        known = row * len(self.points) + pattern.indices
        key = self.node[:, :, None].astype(np.int64) * len(self.points) + self.node[:, None, :]
        at = np.searchsorted(known, key.ravel())
        tensor = np.zeros((len(known), 3, 3))
        for i in range(3):
            for j in range(3):
                tensor[:, i, j] = np.bincount(at, block[..., i, j].ravel(), len(known))
        return pattern.indptr.astype(np.int32), pattern.indices.astype(np.int32), tensor

    def energy(self, x: Floats) -> float:
        """Return the elastic energy [uJ]."""
        u = self._displacement(x)
        out = np.empty_like(u)
        mass_tensor.linear_forces(self.tensors, u, out)
        total = -0.5 * float((out * u).sum())
        if not self.linear:
            mass_tensor.energies(self.tensors, u, self._s, self._t, self._energy)
            total += float(self._energy.sum())
        return total

    def forces(self, x: Floats) -> Floats:
        """Return minus the gradient of the energy, (n, 3) [mN]."""
        u = self._displacement(x)
        out = np.empty_like(u)
        mass_tensor.linear_forces(self.tensors, u, out)
        if not self.linear:
            mass_tensor.forces(self.tensors, u, self._s, self._t, self._vector)
            more = np.empty_like(u)
            solids.gather_nodes(self._gather, self._vector, more)
            out += more
        return out

    def force_scale(self) -> float:
        """Return the largest force of a single element in the last call of `forces` [mN]; no element has one if linear."""
        return 0.0 if self.linear else super().force_scale()


def _cubic(slope: Floats, lame: Floats, shear: Floats) -> Floats:
    """Return C, (e, 4, 10, 3): lambda/2 g_j (g_k . g_l) + mu/2 (g_k (g_j . g_l) + g_l (g_j . g_k)), pairs counted."""
    k, l = PAIRS.T
    twice = np.where(k == l, 1.0, 2.0)
    gram = np.einsum("eai,ebi->eab", slope, slope)
    out = 0.5 * np.einsum("e,eji,eq->ejqi", lame, slope, gram[:, k, l])
    out += 0.5 * np.einsum("e,eqi,ejq->ejqi", shear, slope[:, k], gram[:, :, l])
    out += 0.5 * np.einsum("e,eqi,ejq->ejqi", shear, slope[:, l], gram[:, :, k])
    return np.ascontiguousarray(out * twice[:, None])


def _quartic(slope: Floats, lame: Floats, shear: Floats) -> Floats:
    """Return D, (e, 10, 10): lambda/8 (g_j . g_k)(g_l . g_m) + mu/8 ((g_j . g_l)(g_k . g_m) + (g_j . g_m)(g_k . g_l))."""
    j, k = PAIRS.T
    twice = np.where(j == k, 1.0, 2.0)
    gram = np.einsum("eai,ebi->eab", slope, slope)
    own = gram[:, j, k]
    out = np.einsum("e,eq,er->eqr", 0.125 * lame, own, own)
    cross = gram[:, j[:, None], j] * gram[:, k[:, None], k] + gram[:, j[:, None], k] * gram[:, k[:, None], j]
    out += 0.125 * shear[:, None, None] * cross
    return np.ascontiguousarray(out * twice[:, None] * twice)
