"""Elements whose pressure is a continuous field of its own, so that nearly incompressible tissue does not lock.

The energy is that of the shape plus that of a volume change averaged over each node's surroundings. With N_a the linear
shape functions of the corners, g_a = int N_a (J - 1) dV and M_ab = int N_a N_b / kappa dV it is

    Pi(x) = int psi_shape(F) dV + 1/2 g . M^-1 g,    p = M^-1 g.

order 1  M is lumped, so that Pi = ... + sum_a V_a kappa_a / 2 (J_a - 1)^2 with the nodal volume ratio
         J_a = sum_e v_e / sum_e V_e (Bonet & Burton, Commun. Numer. Meth. Engng 14, 1998). 1 / kappa_a is the mean of
         1 / kappa over the elements around node a, weighted by volume: between two tissues the softer one rules.
order 2  P2-P1, Taylor-Hood: M is consistent (Brezzi & Fortin, Mixed and Hybrid Finite Element Methods, 1991, VI.6).

The pressure is eliminated from the energy, which is minimised over positions alone; the linear system keeps it,
[[A, B^T], [B, -M]] with A the Hessian at constant pressure and B = dg/dx, because A + B^T M^-1 B would be far fuller.
Order 1 has no bound below on pressures that alternate from node to node: read forces and shapes, not nodal pressures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from faceanim.elements import shapes
from faceanim.elements.factor import dissected
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.topology import grouped
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats, Ints, frozen
from faceanim.ground.errors import UserError, unknown_name
from faceanim.kernels import hyperelastic, mixed_solids, solids
from faceanim.tissue.material import Material

MIXED_LAWS = {
    "linear": hyperelastic.LINEAR,
    "herrmann": hyperelastic.LINEAR,
    "neo_hookean": hyperelastic.MOONEY_RIVLIN,
    "mooney_rivlin": hyperelastic.MOONEY_RIVLIN,
    "tension": hyperelastic.TENSION,
}
"""Law of the shape -> its number in the kernels, taken with kappa = 0.

"neo_hookean" is mu/2 (J^(-2/3) I1 - 3) here. "linear" leaves mu dev e : dev e to the elements and kappa/2 (tr e)^2 to
the pressure; "herrmann" splits the same law into mu e : e and lambda/2 (tr e)^2 (Herrmann, AIAA J. 3, 1965), which is
stiffer on coarse meshes because the elements keep a share of the volume change.
"""
CORRECTIONS = 3
"""Times that a step is taken back to the volumes that its tangent promised."""
PRESSURES = ("continuous", "by_tissue")


class MixedElements(Elements):
    """Linear or quadratic tetrahedra with a linear pressure; a `newton.System` over the positions (n, 3) alone.

    The values of the tangent are those of A, in the pattern of `Elements` and at the same places (`entries`), then those
    of B. `pressure_node` (m,) is the mesh node where each pressure is.
    """

    laws: ClassVar[Mapping[str, int]] = MIXED_LAWS

    def __init__(
        self,
        mesh: TetMesh,
        materials: Material | Sequence[Material],
        region: Any = None,
        *,
        order: int = 1,
        law: str = "neo_hookean",
        quadrature: int | None = None,
        middle: Any = None,
        coupled: Ints | None = None,
        extra: int = 0,
        pressure: str = "continuous",
    ) -> None:
        """Compile the tables; the arguments are those of `Elements`.

        pressure : "continuous", or "by_tissue" = a node between two materials has a pressure for each of them
        Raises `UserError` as `Elements` does, and for an unknown `pressure` and one point for quadratic elements.
        """
        if pressure not in PRESSURES:
            raise unknown_name("pressure", pressure, PRESSURES)
        if order == 2 and quadrature == 1:
            raise UserError("quadrature = 1 leaves quadratic elements without shape stiffness; take 4 or 14 points")
        super().__init__(
            mesh, materials, region, order=order, law=law, quadrature=quadrature, middle=middle, coupled=coupled, extra=extra
        )  # fmt: skip
        self.pressure = pressure
        self._shape = frozen(np.ascontiguousarray(shapes.tet_rule(self._quadrature)[0]))
        self._pressures()
        self._blocks_of()
        self.compliance = self._compliance()

    def _constants(self) -> Floats:
        """Return the constants of the shape alone, (r, 5) [kPa]: without bulk modulus."""
        rows = []
        for m in self.materials:
            c10, c01 = (0.5 * m.shear_modulus, 0.0) if self.law == "neo_hookean" else (m.c10, m.c01)
            lame = 0.0 if self.law == "herrmann" else -2.0 / 3.0 * m.shear_modulus
            rows.append((lame, m.shear_modulus, c10, c01, 0.0))
        return np.array(rows)

    def _pressures(self) -> None:
        corner = self.mesh.tets.astype(np.int64)
        if self.pressure == "by_tissue":
            corner = corner * len(self.materials) + self.region[:, None]
        known, index = np.unique(corner, return_inverse=True)
        count = len(self.materials) if self.pressure == "by_tissue" else 1
        self.pressure_node: Ints = (known // count).astype(np.int32)
        self.corner: Ints = index.reshape(corner.shape).astype(np.int32)
        self._mean, self._change = np.zeros(self.corner.shape), np.zeros(self.corner.shape)

    def _blocks_of(self) -> None:
        """Find the pairs of a pressure and a node of one element, and where their entries are."""
        a = self.node.shape[1]
        n, m = len(self.points), len(self.pressure_node)
        key = (self.corner[:, :, None].astype(np.int64) * n + self.node[:, None, :]).ravel()
        pairs = np.unique(key)
        slots = grouped(np.searchsorted(pairs, key).astype(np.int32), np.arange(len(key), dtype=np.int32), len(pairs))
        row = np.zeros(m + 1, dtype=np.int32)
        np.cumsum(np.bincount(pairs // n, minlength=m), out=row[1:])
        self._blocks = mixed_solids.Blocks(*map(frozen, (row, slots.start, slots.item)))
        self._shape_size = len(self.indices)
        self._slope_indptr = 3 * row
        self._slope_indices = (3 * (pairs % n)[:, None] + np.arange(3)).ravel().astype(np.int32)
        self.indices = np.concatenate([self.indices, self._slope_indices])
        self._slopes: Floats = np.zeros((0, 4, a, 3))
        self._last: tuple[Floats, Floats, Floats] | None = None

    def _compliance(self) -> sparse.csr_matrix:
        """Return M, (m, m) [mm^3/kPa]; lumped for linear elements."""
        m = len(self.pressure_node)
        stiff = np.array([k.lame_first if self.law == "herrmann" else k.bulk_modulus for k in self.materials])
        if not stiff.min() > 0.0:
            raise UserError("the law 'herrmann' needs Poisson's ratios above 0; choose 'linear'")
        soft = self.cells.weight / stiff[self.region][:, None]
        if self.order == 1:
            share = soft @ self._shape
            return sparse.diags(np.bincount(self.corner.ravel(), share.ravel(), m), format="csr")
        share = np.einsum("eq,qa,qb->eab", soft, self._shape, self._shape)
        row = np.repeat(self.corner, 4, axis=1).ravel()
        column = np.tile(self.corner, (1, 4)).ravel()
        return sparse.csr_matrix((share.ravel(), (row, column)), shape=(m, m))

    @cached_property
    def _stiffened(self) -> Any:
        """What solves with M."""
        return splu(self.compliance.tocsc(), diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    @cached_property
    def pressure_volume(self) -> Floats:
        """Volume around every pressure, int N_a dV, (m,) [mm^3]."""
        share = self.cells.weight @ self._shape
        return np.asarray(np.bincount(self.corner.ravel(), share.ravel(), len(self.pressure_node)), dtype=np.float64)

    @cached_property
    def stiffness_scale(self) -> float:
        """The elastic energy of a body whose strains are all about 1 [uJ]."""
        stiff = np.array([m.lame_first + 2.0 * m.shear_modulus for m in self.materials])[self.region]
        return float((stiff * self.cells.weight.sum(axis=1)).sum())

    def volume_changes(self, x: Floats) -> Floats:
        """Return g, (m,) [mm^3]: the growth of the volume around every pressure."""
        u = self._displacement(x)
        mixed_solids.volumes(self.cells, self._law, self._shape, u, self._work, self._change)
        changes = np.bincount(self.corner.ravel(), self._change.ravel(), len(self.pressure_node))
        return np.asarray(changes, dtype=np.float64)

    def mean_ratios(self, x: Floats) -> Floats:
        """Return J_a = 1 + g_a / V_a, (m,) [-], which the bulk modulus holds near 1."""
        return 1.0 + self.volume_changes(x) / self.pressure_volume

    def pressures(self, x: Floats) -> Floats:
        """Return p = M^-1 g, (m,) [kPa], positive where the tissue is drawn apart."""
        return self._pressures_of(self.volume_changes(x))

    def _pressures_of(self, change: Floats) -> Floats:
        if self.order == 1:
            return np.asarray(change / self.compliance.diagonal())
        return np.asarray(self._stiffened.solve(change))

    def energy(self, x: Floats) -> float:
        """Return the elastic energy [uJ], infinite where an element is inverted (but for the linear law)."""
        total = super().energy(x)
        if not np.isfinite(total):
            return np.inf
        change = self.volume_changes(x)
        return total + 0.5 * float(change @ self._pressures_of(change))

    def _spread(self, x: Floats) -> Floats:
        """Return the pressures at the corners of the elements, (e, 4) [kPa]."""
        np.take(self.pressures(x), self.corner, out=self._mean)
        return self._mean

    def element_forces(self, x: Floats) -> Floats:
        """Return minus the gradient of the energy as shares of the elements, (e, a, 3) [mN]."""
        mean = self._spread(x)
        u = self._displacement(x)
        mixed_solids.forces(self.cells, self._law, self._shape, u, mean, self._work, self._vector)
        return self._vector.copy()

    def forces(self, x: Floats) -> Floats:
        """Return minus the gradient of the energy, (n, 3) [mN]."""
        mean = self._spread(x)
        u = self._displacement(x)
        mixed_solids.forces(self.cells, self._law, self._shape, u, mean, self._work, self._vector)
        out = np.empty_like(self.points)
        solids.gather_nodes(self._gather, self._vector, out)
        return out

    def tangent_values(self, x: Floats, out: Floats, *, definite: bool = False) -> Floats:
        """Write the values of A, then of B, into `out` and return it.

        Along a search A takes the pressure that the last tangent promised for `x`, unless the true one costs less: a step
        that is off by the curvature of J has a pressure that is off by kappa times that, which would spoil the next one.
        Both agree where the search ends; `forget` makes the next tangent the Hessian itself.
        definite : with d(P + p dJ/dF)/dF made positive semidefinite at every point, so that A + B^T M^-1 B is it too
        """
        if not len(self._slopes):
            e, a = self.node.shape
            self._matrix = np.zeros((e, 3 * a, 3 * a))
            self._slopes = np.zeros((e, 4, a, 3))
        u = self._displacement(x)
        change = self.volume_changes(x)
        np.take(self._promised(x, change), self.corner, out=self._mean)
        mean = self._mean
        mixed_solids.stiffnesses(
            self.cells, self._law, self._shape, u, mean, definite, self._work, self._matrix, self._slopes
        )
        solids.gather_pairs(self._gather, self._matrix, out[: self._shape_size])
        mixed_solids.gather_slopes(self._blocks, self._slopes, out[self._shape_size :].reshape(-1, 3))
        self._last = (x.copy(), change, out[self._shape_size :].copy())
        return out

    def _promised(self, x: Floats, change: Floats) -> Floats:
        """Return the pressure (m,) for a tangent at `x`, where g is `change`."""
        true = self._pressures_of(change)
        if self._last is None:
            return true
        place, before, slope = self._last
        promised = before + self._slope_matrix(slope) @ (x - place).ravel()
        other = self._pressures_of(promised)
        return other if promised @ other < change @ true else true

    def forget(self) -> None:
        """Forget the last tangent: what follows is a new search, or a check of derivatives."""
        self._last = None

    def matrix(self, values: Floats) -> sparse.csr_matrix:
        """Return A, (3n, 3n) [mN/mm], the Hessian at constant pressure."""
        k = self._shape_size
        return sparse.csr_matrix((values[:k], self.indices[:k], self.indptr), shape=(self.size, self.size))

    def volume_slopes(self, values: Floats) -> sparse.csr_matrix:
        """Return B = dg/dx, (m, 3n) [mm^2]."""
        return self._slope_matrix(values[self._shape_size :])

    def _slope_matrix(self, data: Floats) -> sparse.csr_matrix:
        shape = (len(self.pressure_node), self.size)
        return sparse.csr_matrix((data, self._slope_indices, self._slope_indptr), shape=shape)

    def augmented(self, values: Floats) -> sparse.csr_matrix:
        """Return [[A, B^T], [B, -M]], (3n + m, 3n + m)."""
        slope = self.volume_slopes(values)
        return sparse.bmat([[self.matrix(values), slope.T], [slope, -self.compliance]], format="csr")

    def tangent(self, x: Floats, *, definite: bool = False) -> sparse.csr_matrix:
        """Return the Hessian of the energy, A + B^T M^-1 B, (3n, 3n) [mN/mm]; full, for small meshes and for checks."""
        self.forget()
        values = self.tangent_values(x, np.empty(len(self.indices)), definite=definite)
        slope = self.volume_slopes(values)
        stiff = np.linalg.solve(self.compliance.toarray(), slope.toarray())
        return sparse.csr_matrix(self.matrix(values) + slope.T @ sparse.csr_matrix(stiff))

    def factorisation(self, free: Bools) -> MixedFactor:  # type: ignore[override]
        """Return what solves with the tangent over the freedoms that are `free`, (n, 3)."""
        return MixedFactor(self, free)


class MixedFactor:
    """Solves [[A, B^T], [B, -M]] (u, p) = (b, 0) for the free freedoms and all pressures; a `newton.Factorisation`.

    SuperLU in symmetric mode without pivoting: where A + B^T M^-1 B is definite so is every Schur complement that matters,
    up to sign, in the order u of a node, then its p (Vanderbei, Symmetric quasidefinite matrices, SIAM J. Optim. 5, 1995).
    Rows are in nested dissection order; one step of refinement makes up for the missing pivoting.
    """

    def __init__(self, elements: MixedElements, free: Bools) -> None:
        self.free = free.ravel().copy()
        self._elements = elements
        self._values: Floats = np.zeros(len(elements.indices))
        self.rows = self._order()
        k = len(elements.indices)
        numbered = elements.augmented(np.arange(1.0, k + 1.0))
        full = len(self.free)
        lower = elements.compliance.copy()
        self._constant = -lower.data
        lower.data = np.arange(k + 1.0, k + 1.0 + len(lower.data))
        slope = numbered[full:, :full]
        numbered = sparse.bmat([[numbered[:full, :full], slope.T], [slope, lower]], format="csr")
        reduced = numbered[self.rows][:, self.rows].tocsc()
        reduced.sort_indices()
        self._pick = reduced.data.astype(np.int64) - 1
        self._matrix = sparse.csc_matrix((np.zeros(len(self._pick)), reduced.indices, reduced.indptr), reduced.shape)
        self._solved = self._matrix
        self._moving = self.rows < full
        self._lu: Any = None

    def _order(self) -> Ints:
        """Return the free freedoms and the pressures, 3n + a, in the order of their elimination."""
        elements = self._elements
        n = len(elements.points)
        kept: Bools = np.asarray(self.free.reshape(-1, 3).any(axis=1))
        kept[elements.pressure_node] = True
        nodes = np.flatnonzero(kept)
        moving = np.flatnonzero(self.free)
        rows = np.concatenate([moving, 3 * n + np.arange(len(elements.pressure_node))])
        owner = np.concatenate([moving // 3, elements.pressure_node])
        belongs = sparse.csr_matrix((np.ones(len(rows)), (np.arange(len(rows)), owner)), shape=(len(rows), n))
        # held nodes count by their pressures alone: pairs of them that only muscles or bones couple would mislead
        matrix = abs(elements.augmented(np.ones(len(elements.indices))))[rows][:, rows]
        adjacent = (belongs.T @ matrix @ belongs).tocsr()
        inner = nodes[dissected(elements.places[nodes], adjacent[nodes][:, nodes])]
        rank = np.zeros(n, dtype=np.int64)
        rank[inner] = np.arange(len(inner))
        at = np.concatenate([2 * rank[moving // 3], 2 * rank[elements.pressure_node] + 1])
        return np.asarray(rows[np.argsort(at, kind="stable")])

    def factor(self, values: Floats, shift: float = 0.0) -> bool:
        """Factorise the matrix with these `values`, plus `shift` I on the positions; return whether it could be."""
        self._values = values
        self._matrix.data[:] = np.concatenate([values, self._constant])[self._pick]
        self._solved = self._matrix
        if shift:
            self._solved = (self._matrix + sparse.diags(shift * self._moving, format="csc")).tocsc()
        try:
            self._lu = splu(self._solved, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError:  # exactly singular
            self._lu = None
        return self._lu is not None

    def solve(self, right: Floats, moved: Floats | None = None) -> Floats:
        """Return u, (n, 3), for the right-hand side `right` (n, 3) while the fixed freedoms go by `moved` (n, 3)."""
        full = np.concatenate([right.ravel(), np.zeros(len(self._elements.pressure_node))])
        if moved is not None:
            full[: right.size] -= self._elements.matrix(self._values) @ moved.ravel()
            full[right.size :] -= self._elements.volume_slopes(self._values) @ moved.ravel()
        out = np.zeros(len(full))
        wanted = full[self.rows]
        found = self._lu.solve(wanted)
        out[self.rows] = found + self._lu.solve(wanted - self._solved @ found)
        return out[: right.size].reshape(-1, 3)

    def correction(self, x: Floats, step: Floats) -> Floats:
        """Return the second step, (n, 3), that takes g at `x` + `step` back to g + B `step`, by the same factors."""
        elements = self._elements
        promised = elements.volume_changes(x) + elements.volume_slopes(self._values) @ step.ravel()
        total, out = np.zeros_like(step), np.zeros(len(self.free) + len(promised))
        for _ in range(CORRECTIONS):
            full = np.concatenate([np.zeros(step.size), promised - elements.volume_changes(x + step + total)])
            out[self.rows] = self._lu.solve(full[self.rows])
            total += out[: step.size].reshape(-1, 3)
        return total

    def definite(self) -> bool:
        """Return whether the energy has a minimum there: as many negative pivots as pressures, the others positive."""
        pivots = self._lu.U.diagonal()
        return bool((pivots != 0.0).all() and int((pivots < 0.0).sum()) == len(self._elements.pressure_node))
