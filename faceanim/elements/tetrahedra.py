"""The elements of a volume as functions of its nodes' positions: energy, forces, tangent, mass and loads.

This layer knows no bones, muscles or time; verification uses it directly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from scipy import sparse

from faceanim.elements import shapes
from faceanim.elements.factor import Factor
from faceanim.geometry.topology import grouped
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats, Ints, floats, frozen, ints
from faceanim.ground.errors import UserError, unknown_name
from faceanim.kernels import hyperelastic, solids
from faceanim.tissue.material import Material

LAWS = {
    "linear": hyperelastic.LINEAR,
    "neo_hookean": hyperelastic.NEO_HOOKEAN,
    "corotational": hyperelastic.COROTATIONAL,
    "stvk": hyperelastic.STVK,
    "mooney_rivlin": hyperelastic.MOONEY_RIVLIN,
    "tension": hyperelastic.TENSION,
    "stvk_barrier": hyperelastic.STVK_BARRIER,
}
"""Name of each elastic law -> its number in the kernels; the energies are in `kernels.hyperelastic`."""
BARRIER = ("neo_hookean", "mooney_rivlin", "tension", "stvk_barrier")
"""Laws whose energy is infinite where an element is inverted."""


class Elements:
    """Linear (`order` 1) or quadratic (2) tetrahedra of elastic materials under one law.

    points : (n, 3) rest positions [mm]: the nodes of `mesh`, then, for order 2, one on each edge, then `extra` rows of 0
    node : (e, 4 | 10)   edges : (k, 2) corners beside each mid-edge node, empty for order 1
    Positions `x` are (n, 3) [mm]. Quadratic elements may be curved: `middle` (k, 3) moves the mid-edge nodes at rest.
    """

    laws: ClassVar[Mapping[str, int]] = LAWS

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
    ) -> None:
        """Compile the tables.

        materials, region : one material, or several and the index (e,) of each element's
        quadrature : points for the energy, 1, 4 or 14; None = 1 for linear, 4 for quadratic elements
        coupled : (k, 2) further pairs of nodes that the tangent's pattern must have room for, both ways
        extra : further nodes after the mesh's that only other terms touch, such as the rotations of a shell; their rest
        value is 0, and each has room in the pattern for itself and for what `coupled` names
        Raises `UserError` for an unknown law, a wrong order or region, and for elements inverted or flat at rest.
        """
        if law not in self.laws:
            raise unknown_name("elastic law", law, self.laws)
        if order not in (1, 2):
            raise UserError(f"order = {order}: elements are linear (1) or quadratic (2)")
        mesh.reject_bad()
        self.mesh, self.order, self.law = mesh, order, law
        self._law = self.laws[law]
        self._quadrature = (1 if order == 1 else 4) if quadrature is None else quadrature
        self.materials = (materials,) if isinstance(materials, Material) else tuple(materials)
        self.extra = extra
        self._reject_unfit()
        self.region = self._regions(region)
        self._nodes(middle)
        self.cells = self._cells()
        self._allocate()
        self._pattern(coupled)

    def _reject_unfit(self) -> None:
        if self.extra < 0:
            raise UserError(f"extra = {self.extra}: the number of further nodes must not be negative")
        for material in self.materials:
            if self.law == "tension" and material.mooney > 0:
                raise UserError(
                    f"material {material.name!r}: the law 'tension' needs mooney <= 0 (c01 <= 0), not {material.mooney}; "
                    "choose 'mooney_rivlin', which is stable for c01 >= 0"
                )

    def _regions(self, region: Any) -> Ints:
        e = len(self.mesh.tets)
        if region is None:
            return np.zeros(e, dtype=np.int32)
        return ints("region", region, e, below=len(self.materials))

    def _nodes(self, middle: Any) -> None:
        mesh = self.mesh
        self.points, self.node = mesh.points, mesh.tets
        self.edges: Ints = np.zeros((0, 2), dtype=np.int32)
        if self.order == 2:
            pairs = np.sort(mesh.tets[:, shapes.TET_EDGES].reshape(-1, 2), axis=1)
            self.edges, index = np.unique(pairs, axis=0, return_inverse=True)
            self.node = np.concatenate([mesh.tets, len(mesh.points) + index.reshape(-1, 6)], axis=1).astype(np.int32)
            halfway = mesh.points[self.edges].mean(axis=1)
            if middle is not None:
                halfway = floats("middle", middle, len(self.edges), 3)
            self.points = np.concatenate([mesh.points, halfway])
        elif middle is not None:
            raise UserError("middle: linear elements have no mid-edge nodes; choose order 2")
        if self.extra:
            self.points = np.concatenate([self.points, np.zeros((self.extra, 3))])

    def rule(self, points: int) -> tuple[Floats, Floats, Floats]:
        """Return shape values (q, a), gradients (e, q, a, 3) [1/mm] and weights (e, q) [mm^3] of a rule."""
        at, share = shapes.tet_rule(points)
        slope = shapes.shape_slopes(self.order, at, shapes.TET_EDGES)
        local = slope[:, :, 1:] - slope[:, :, :1]
        jacobian = np.einsum("eai,qaj->eqij", self.points[self.node], local)
        weight = np.linalg.det(jacobian) * share / 6.0
        if not weight.min() > 0:
            e = int(np.argmin(weight.min(axis=1)))
            raise UserError(f"element {e} is folded by its mid-edge nodes; keep them nearer to the middle of the edges")
        gradient = np.einsum("qaj,eqji->eqai", local, np.linalg.inv(jacobian))
        return shapes.shape_values(self.order, at, shapes.TET_EDGES), gradient, weight

    def _constants(self) -> Floats:
        """Return lambda, mu, c10, c01 and kappa of every material, (r, 5) [kPa], as the kernels take them."""
        return np.array([(m.lame_first, m.shear_modulus, m.c10, m.c01, m.bulk_modulus) for m in self.materials])

    def _cells(self) -> solids.Cells:
        constant = self._constants()
        _, gradient, weight = self.rule(self._quadrature)
        tables = (self.node, gradient, weight, constant[self.region])
        return solids.Cells(*(frozen(np.ascontiguousarray(table)) for table in tables))

    def _allocate(self) -> None:
        e, a = self.node.shape
        self._work = solids.Work(
            np.zeros((e, 3, 3)), np.zeros((e, 3, 3)), np.zeros((e, 3, 3, 3)), np.zeros((e, 9, 9)),
            np.zeros((e, 9, 9)), np.zeros((e, 9, 9)), np.zeros((e, 9, 3 * a)),
        )  # fmt: skip
        self._energy, self._ratio, self._vector = np.zeros(e), np.ones(e), np.zeros((e, a, 3))
        self._matrix: Floats = np.zeros((0, 0, 0))

    def _pattern(self, coupled: Ints | None) -> None:
        e, a = self.node.shape
        n = len(self.points)
        key = (self.node[:, :, None].astype(np.int64) * n + self.node[:, None, :]).ravel()
        own = np.arange(n - self.extra, n, dtype=np.int64)
        further = [own * n + own]
        if coupled is not None and len(coupled):
            both = ints("coupled", coupled, None, 2, below=n).astype(np.int64)
            further += [both[:, 0] * n + both[:, 1], both[:, 1] * n + both[:, 0]]
        pairs_known = np.unique(np.concatenate([key, *further]))
        pair = np.searchsorted(pairs_known, key).astype(np.int32)
        slots = grouped(pair, np.arange(len(key), dtype=np.int32), len(pairs_known))
        users = grouped(self.node.ravel(), np.arange(e * a, dtype=np.int32), n)
        row, column = pairs_known // n, (pairs_known % n).astype(np.int32)
        first = np.zeros(n + 1, dtype=np.int32)
        np.cumsum(np.bincount(row, minlength=n), out=first[1:])
        self._gather = solids.Gather(*map(frozen, (users.start, users.item, first, slots.start, slots.item)))
        self._pairs = pairs_known
        self.node_pattern = sparse.csr_matrix((np.ones(len(column)), column, first), shape=(n, n))
        self.indptr, self.indices = _scalar_pattern(first, column)
        self.places = self._places()

    def _places(self) -> Floats:
        """Return where each node is for the order of elimination, (n, 3): further nodes are amid what they couple."""
        own = len(self.points) - self.extra
        if not self.extra:
            return self.points
        beside = self.node_pattern[own:, :own]
        count = np.asarray(beside.sum(axis=1)).reshape(-1, 1)
        amid = np.asarray(beside @ self.points[:own]) / np.maximum(count, 1.0)
        return np.concatenate([self.points[:own], amid])

    @property
    def size(self) -> int:
        """How many freedoms there are, 3 n."""
        return 3 * len(self.points)

    def entries(self, i: Ints, j: Ints) -> Ints:
        """Return where the 3 x 3 blocks of the node pairs (`i`, `j`), (k,) each, are in the tangent's data, (k, 3, 3)."""
        pair = np.searchsorted(self._pairs, i.astype(np.int64) * len(self.points) + j)
        first = self._gather.row[i].astype(np.int64)
        count = self._gather.row[i.astype(np.int64) + 1] - first
        at = 9 * first + 3 * (pair - first)
        return np.asarray(at[:, None, None] + 3 * count[:, None, None] * np.arange(3)[:, None] + np.arange(3))

    @property
    def linear(self) -> bool:
        """Whether the law is linear: then it holds, as a mathematical model, at any deformation."""
        return self._law == hyperelastic.LINEAR

    @property
    def barrier(self) -> bool:
        """Whether the law forbids inversion."""
        return self.law in BARRIER

    @cached_property
    def stiffness_scale(self) -> float:
        """The elastic energy of a body whose strains are all about 1 [uJ]."""
        cells = self.cells
        stiff = cells.constant[:, 0] + 2.0 * cells.constant[:, 1]
        return float((stiff * cells.weight.sum(axis=1)).sum())

    def factorisation(self, free: Bools) -> Factor:
        """Return what solves with the tangent over the freedoms that are `free`, (n, 3)."""
        return Factor(self, free)

    def _displacement(self, x: Floats) -> Floats:
        if np.shape(x) != self.points.shape:
            raise UserError(f"positions have shape {np.shape(x)}; {self.points.shape} is needed")
        return np.ascontiguousarray(x - self.points)

    def energies(self, x: Floats) -> Floats:
        """Return the energy of every element, (e,) [uJ], infinite where a law with a barrier is inverted."""
        solids.energies(self.cells, self._law, self._displacement(x), self._work, self._energy, self._ratio)
        return self._energy.copy()

    def energy(self, x: Floats) -> float:
        """Return the elastic energy [uJ]."""
        return float(self.energies(x).sum())

    def volume_ratio(self, x: Floats) -> Floats:
        """Return the smallest det F over the quadrature points of every element, (e,) [-]."""
        self.energies(x)
        return self._ratio.copy()

    def element_forces(self, x: Floats) -> Floats:
        """Return minus the gradient of every element's energy, (e, a, 3) [mN]."""
        solids.forces(self.cells, self._law, self._displacement(x), self._work, self._vector)
        return self._vector.copy()

    def forces(self, x: Floats) -> Floats:
        """Return minus the gradient of the energy, (n, 3) [mN]."""
        solids.forces(self.cells, self._law, self._displacement(x), self._work, self._vector)
        out = np.empty_like(self.points)
        solids.gather_nodes(self._gather, self._vector, out)
        return out

    def force_scale(self) -> float:
        """Return the largest force of a single element in the last call of `forces` [mN]."""
        return float(np.abs(self._vector).max(initial=0.0))

    def tangent_values(self, x: Floats, out: Floats, *, definite: bool = False) -> Floats:
        """Write the values of the tangent in its fixed pattern (`indptr`, `indices`) into `out`, and return it."""
        if not len(self._matrix):
            e, a = self.node.shape
            self._matrix = np.zeros((e, 3 * a, 3 * a))
        u = self._displacement(x)
        solids.stiffnesses(self.cells, self._law, u, definite, self._work, self._matrix)
        solids.gather_pairs(self._gather, self._matrix, out)
        return out

    def matrix(self, values: Floats) -> sparse.csr_matrix:
        """Return the sparse matrix (3n, 3n) with these `values` in the fixed pattern."""
        return sparse.csr_matrix((values, self.indices, self.indptr), shape=(self.size, self.size))

    def tangent(self, x: Floats, *, definite: bool = False) -> sparse.csr_matrix:
        """Return the Hessian of the energy, (3n, 3n) [mN/mm], symmetric.

        definite : with the negative eigenvalues of dP/dF raised to zero at every quadrature point
        """
        return self.matrix(self.tangent_values(x, np.empty(len(self.indices)), definite=definite))

    @cached_property
    def density(self) -> Floats:
        """Density of every element, (e,) [kg/mm^3]."""
        return np.array([m.density for m in self.materials])[self.region]

    @cached_property
    def mass(self) -> sparse.csr_matrix:
        """The consistent mass, (3n, 3n) [kg]."""
        value, _, weight = self.rule(4 if self.order == 1 else 14)
        share = np.einsum("eq,qa,qb->eab", weight * self.density[:, None], value, value)
        blocks = np.einsum("eab,ij->eaibj", share, np.eye(3))
        a = self.node.shape[1]
        out = np.empty(len(self.indices))
        solids.gather_pairs(self._gather, np.ascontiguousarray(blocks.reshape(-1, 3 * a, 3 * a)), out)
        return self.matrix(out)

    @cached_property
    def lumped_mass(self) -> Floats:
        """Mass of every node, (n,) [kg]: the consistent diagonal scaled to each element's mass (Hinton et al. 1976)."""
        value, _, weight = self.rule(4 if self.order == 1 else 14)
        diagonal = np.einsum("eq,qa->ea", weight, value**2)
        whole = self.density * weight.sum(axis=1)
        share = diagonal * (whole / diagonal.sum(axis=1))[:, None]
        return np.asarray(np.bincount(self.node.ravel(), share.ravel(), len(self.points)), dtype=np.float64)

    @cached_property
    def gravity_mass(self) -> Floats:
        """Row sums of the consistent mass, (n,) [kg]: g times this is the consistent load of a gravity g."""
        value, _, weight = self.rule(4)
        share = np.einsum("eq,qa->ea", weight * self.density[:, None], value)
        return np.asarray(np.bincount(self.node.ravel(), share.ravel(), len(self.points)), dtype=np.float64)

    def body_force(self, density: Any) -> Floats:
        """Return the nodal loads, (n, 3) [mN], of a function of rest positions (k, 3) -> force per volume (k, 3)."""
        value, _, weight = self.rule(14)
        at = np.einsum("qa,eai->eqi", value, self.points[self.node])
        load = np.asarray(density(at.reshape(-1, 3))).reshape(at.shape)
        share = np.einsum("eq,qa,eqi->eai", weight, value, load)
        out = np.zeros_like(self.points)
        for i in range(3):
            out[:, i] = np.bincount(self.node.ravel(), share[:, :, i].ravel(), len(self.points))
        return out

    def face_nodes(self, triangles: Ints) -> Ints:
        """Return the nodes, (t, 3 | 6), of the faces with corners `triangles` (t, 3); `UserError` if one is no face."""
        corners = ints("triangles", triangles, None, 3, below=len(self.mesh.points))
        if self.order == 1:
            return corners
        span = len(self.mesh.points)
        known = self.edges[:, 0].astype(np.int64) * span + self.edges[:, 1]
        pairs = np.sort(corners[:, shapes.TRIANGLE_EDGES], axis=2).astype(np.int64)
        key = pairs[:, :, 0] * span + pairs[:, :, 1]
        at = np.minimum(np.searchsorted(known, key), len(known) - 1)
        if (known[at] != key).any():
            raise UserError("triangles: some corners are not joined by an edge of the mesh; take faces of its elements")
        return np.concatenate([corners, span + at], axis=1).astype(np.int32)

    def traction(self, triangles: Ints, value: Any) -> Floats:
        """Return the consistent nodal loads, (n, 3) [mN], of a dead traction on faces at rest.

        triangles : (t, 3) corners   value : (3,) or (t, 3) [kPa], or a function of rest positions (k, 3) -> (k, 3)
        """
        node = self.face_nodes(triangles)
        at, share = shapes.triangle_rule()
        shape = shapes.shape_values(self.order, at, shapes.TRIANGLE_EDGES)
        slope = shapes.shape_slopes(self.order, at, shapes.TRIANGLE_EDGES)
        corner = self.points[node]
        along = np.einsum("qac,tai->tqci", slope[:, :, 1:] - slope[:, :, :1], corner)
        area = 0.5 * np.linalg.norm(np.cross(along[:, :, 0], along[:, :, 1]), axis=2) * share
        if callable(value):
            place = np.einsum("qa,tai->tqi", shape, corner)
            load = np.asarray(value(place.reshape(-1, 3))).reshape(place.shape)
        else:
            load = np.broadcast_to(np.asarray(value, dtype=np.float64).reshape(-1, 1, 3), (*area.shape, 3))
        part = np.einsum("tq,qa,tqi->tai", area, shape, load)
        out = np.zeros_like(self.points)
        for i in range(3):
            out[:, i] = np.bincount(node.ravel(), part[:, :, i].ravel(), len(self.points))
        return out


def _scalar_pattern(first: Ints, column: Ints) -> tuple[Ints, Ints]:
    """Return indptr and indices of the matrix with 3 x 3 blocks at the node pairs (rows from `first`, `column`)."""
    count = np.diff(first)
    starts = np.zeros(3 * len(count) + 1, dtype=np.int32)
    np.cumsum(np.repeat(3 * count, 3), out=starts[1:])
    node = np.repeat(np.arange(len(count)), count)
    offset = np.arange(len(column)) - first[node]
    indices = np.empty(9 * len(column), dtype=np.int32)
    for r in range(3):
        at = 9 * first[node] + 3 * r * count[node] + 3 * offset
        for t in range(3):
            indices[at + t] = 3 * column + t
    return starts, indices
