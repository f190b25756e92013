"""Thin skin as flat triangular shells at large rotations, carried by nodes at an arm from its mid-surface.

Node k of m has a position and a rotation vector; `x` (2m, 3) holds the positions [mm], then the rotation vectors [rad],
all of them additive unknowns. The mid-surface is at x_k + R_k offset_k, R_k = exp(theta_k) reference_k, so that a shell
can share the nodes of a solid that it lies upon.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse

from faceanim.elements.factor import Factor
from faceanim.elements.pattern import Pattern
from faceanim.ground.arrays import Bools, Floats, Ints, floats, frozen, ints
from faceanim.ground.errors import UserError, unknown_name
from faceanim.kernels import membrane
from faceanim.kernels import shells as kernels

LAWS = {
    "linear": membrane.LINEAR,
    "neo_hookean": membrane.MOONEY_RIVLIN,
    "mooney_rivlin": membrane.MOONEY_RIVLIN,
    "tension": membrane.TENSION,
}
"""Name of each membrane law -> its number in the kernels; the energies are in `kernels.membrane`."""
BATCHES = 64
"""Triangles are worked through in so many batches at most, each with its own room."""
FLATTEST = 1e-10
"""Least area of a triangle over its longest side squared."""


@dataclass(frozen=True)
class Sheet:
    """A thin elastic sheet.

    law : of the membrane, one of `LAWS`   thickness : [mm]
    young_modulus [kPa], poisson_ratio : of bending, and of the membrane under the law "linear"
    c10, c01 : [kPa] of the incompressible laws   drilling : share of the shear stiffness G h A that holds the turn
    of the nodes about the normal to that of their triangles
    """

    law: str
    thickness: float
    young_modulus: float
    poisson_ratio: float
    c10: float = 0.0
    c01: float = 0.0
    drilling: float = 5e-4

    def __post_init__(self) -> None:
        if self.law not in LAWS:
            raise unknown_name("membrane law", self.law, LAWS)
        rules = [
            ("thickness", self.thickness > 0.0, "positive"),
            ("young_modulus", self.young_modulus > 0.0, "positive"),
            ("poisson_ratio", -1.0 < self.poisson_ratio <= 0.5, "above -1 and at most 0.5"),
            ("drilling", 0.0 < self.drilling <= 1.0, "above 0 and at most 1; 1e-4 to 1e-3 is usual"),
        ]
        if self.law != "linear":
            rules += [
                ("c10", self.c10 > 0.0, "positive"),
                ("c01", self.c10 + self.c01 > 0.0, "above -c10, or the sheet has no stiffness"),
            ]
        if self.law == "tension":
            rules.append(("c01", self.c01 <= 0.0, "at most 0 under the law 'tension'; choose 'mooney_rivlin'"))
        for name, sound, rule in rules:
            value = getattr(self, name)
            if not (math.isfinite(value) and sound):
                raise UserError(f"sheet: {name} = {value} must be finite and {rule}")

    @classmethod
    def elastic(
        cls, thickness: float, young_modulus: float, poisson_ratio: float, law: str = "linear", drilling: float = 5e-4
    ) -> Sheet:
        """Return the sheet with these constants; under the law "neo_hookean" its shear modulus is E / 2 (1 + nu)."""
        half = 0.25 * young_modulus / (1.0 + poisson_ratio) if poisson_ratio > -1.0 else math.nan
        return cls(law, thickness, young_modulus, poisson_ratio, half, 0.0, drilling)

    @classmethod
    def rubber(
        cls,
        thickness: float,
        c10: float,
        c01: float,
        law: str = "tension",
        poisson_ratio: float = 0.5,
        drilling: float = 5e-4,
    ) -> Sheet:
        """Return the sheet with these Mooney-Rivlin constants [kPa]; it bends with E = 4 (c10 + c01) (1 + nu)."""
        return cls(law, thickness, 4.0 * (c10 + c01) * (1.0 + poisson_ratio), poisson_ratio, c10, c01, drilling)

    @property
    def shear_modulus(self) -> float:
        """G [kPa]."""
        return self.young_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def bending_stiffness(self) -> float:
        """D = E h^3 / 12 (1 - nu^2) [mN mm]."""
        return self.young_modulus * self.thickness**3 / (12.0 * (1.0 - self.poisson_ratio**2))

    @property
    def stretch_limit(self) -> float:
        """The principal stretch beyond which the law is not elliptic, sqrt(-c10 / c01); infinite where it always is."""
        if self.law == "mooney_rivlin" and self.c01 < 0.0:
            return math.sqrt(-self.c10 / self.c01)
        return math.inf


class Shells:
    """Flat triangular shells over m nodes: constant-strain membrane, discrete-Kirchhoff bending, weak drilling.

    carrier : (m, 3) positions of the nodes at rest [mm]   offset : (m, 3) from there to the mid-surface at rest [mm]
    points : (2m, 3) the freedoms at rest: `carrier`, then zero rotation vectors
    node : (t, 6) rows of `points` of each triangle: its three positions, then its three rotation vectors
    reference : (m, 3, 3) rotation of every node since rest that its rotation vector comes on top of
    """

    def __init__(
        self, carrier: Any, triangles: Any, sheets: Sheet | Sequence[Sheet], region: Any = None, *, offset: Any = None
    ) -> None:
        """Compile the tables.

        triangles : (t, 3)   sheets, region : one sheet, or several and the index (t,) of each triangle's
        Raises `UserError` for arrays of wrong shape and for triangles without area.
        """
        self.carrier: Floats = floats("carrier", carrier, None, 3).copy()
        m = len(self.carrier)
        self.triangles: Ints = ints("triangles", triangles, None, 3, below=m)
        if not len(self.triangles):
            raise UserError("triangles is empty; a shell needs at least one")
        self.sheets = (sheets,) if isinstance(sheets, Sheet) else tuple(sheets)
        t = len(self.triangles)
        self.region: Ints = (
            np.zeros(t, dtype=np.int32) if region is None else ints("region", region, t, below=len(self.sheets))
        )
        self.offset: Floats = np.zeros((m, 3)) if offset is None else floats("offset", offset, m, 3).copy()
        self.points: Floats = np.concatenate([self.carrier, np.zeros((m, 3))])
        self.node: Ints = np.concatenate([self.triangles, m + self.triangles], axis=1).astype(np.int32)
        self.reference: Floats = np.tile(np.eye(3), (m, 1, 1))
        self.panels = self._panels()
        self._allocate()

    def _panels(self) -> kernels.Panels:
        corner = (self.carrier + self.offset)[self.triangles]
        frame, area = _frames(corner)
        flat = np.einsum("tai,tij->taj", corner - corner[:, :1], frame[:, :, :2])
        slope = _slopes(flat, area)
        sheets = self.sheets
        thickness = np.array([s.thickness for s in sheets])[self.region]
        # 1 - nu^2 is positive for every nu that a sheet may have
        plane = [(s.young_modulus * s.poisson_ratio / (1.0 - s.poisson_ratio**2), s.shear_modulus) for s in sheets]
        constant = np.array([(*p, s.c10, s.c01) for p, s in zip(plane, sheets, strict=True)])[self.region]
        law = np.array([LAWS[s.law] for s in sheets], dtype=np.int32)[self.region]
        bending = np.zeros((len(area), 9, 9))
        turns = np.array([0, 1, 3, 4, 6, 7])
        stiffness = np.array([s.bending_stiffness for s in sheets])[self.region]
        poisson = np.array([s.poisson_ratio for s in sheets])[self.region]
        bending[:, turns[:, None], turns] = _bending(flat, slope, area, stiffness, poisson)
        drill = np.array([s.drilling * s.shear_modulus * s.thickness for s in sheets])[self.region] * area / 3.0
        bending[:, [2, 5, 8], [2, 5, 8]] = drill[:, None]
        self.area: Floats = area
        tables = (self.triangles, slope, frame, thickness * area, law, constant, bending)
        return kernels.Panels(*(frozen(np.ascontiguousarray(table)) for table in tables))

    def _allocate(self) -> None:
        m, t = len(self.carrier), len(self.triangles)
        self._turned = kernels.Turned(
            np.zeros((m, 3, 3)), np.zeros((m, 3, 3)), np.zeros((m, 3, 3)), np.zeros((m, 3)), np.zeros((m, 3))
        )
        b = min(t, BATCHES)
        shapes = (
            (3, 2), (3, 3), (3,), (3, 3, 3), (3, 3, 3), (9,), (9,), (3, 6), (9, 9), (15,), (15, 15), (15, 18), (15, 18),
            (18, 18), (18, 18),
        )  # fmt: skip
        self._room = kernels.Room(*(np.zeros((b, *shape)) for shape in shapes))

    def _turn(self, x: Floats) -> Floats:
        """Place the nodes; return `x` in the kernels' layout."""
        if np.shape(x) != self.points.shape:
            raise UserError(
                f"x has shape {np.shape(x)}; {self.points.shape} is needed: positions, then rotation vectors"
            )
        x = np.ascontiguousarray(x, dtype=np.float64)
        kernels.turn_nodes(x, self.reference, self.offset, self._turned)
        return x

    def energies(self, x: Floats) -> Floats:
        """Return the energy of every triangle, (t,) [uJ], infinite where it has no area."""
        self._turn(x)
        out = np.empty(len(self.triangles))
        kernels.energies(self.panels, self._turned, self._room, out)
        return out

    def forces(self, x: Floats) -> Floats:
        """Return minus the gradient of every triangle's energy, (t, 6, 3) [mN], [mN mm]."""
        self._turn(x)
        out = np.empty((len(self.triangles), 6, 3))
        kernels.forces(self.panels, self._turned, self._room, out)
        return out

    def stiffnesses(self, x: Floats, *, definite: bool = False, out: Floats | None = None) -> Floats:
        """Return the Hessian of every triangle's energy, (t, 18, 18), symmetric.

        definite : with its negative eigenvalues raised to zero   out : (t, 18, 18), to be written to
        """
        x = self._turn(x)
        if out is None:
            out = np.empty((len(self.triangles), 18, 18))
        kernels.stiffnesses(self.panels, x, self._turned, definite, self._room, out)
        return out

    @cached_property
    def stretch_limits(self) -> Floats:
        """The principal stretch beyond which each triangle's law is not elliptic, (t,); mostly infinite."""
        return np.array([s.stretch_limit for s in self.sheets])[self.region]

    def area_ratios(self, x: Floats) -> Floats:
        """Return every triangle's area over that at rest, (t,)."""
        return self._stretches(x)[0]

    def stretches(self, x: Floats) -> Floats:
        """Return the largest principal stretch in every triangle's plane, (t,), to be compared with `stretch_limits`."""
        return self._stretches(x)[1]

    def _stretches(self, x: Floats) -> tuple[Floats, Floats]:
        self._turn(x)
        ratio, largest = np.empty(len(self.triangles)), np.empty(len(self.triangles))
        kernels.stretches(self.panels, self._turned, self._room, ratio, largest)
        return ratio, largest

    def thickness_stretches(self, x: Floats) -> Floats:
        """Return the stretch across the sheet, (t,): what keeps the volume (not a result of the law "linear")."""
        return 1.0 / self.area_ratios(x)

    def rebase(self, x: Floats) -> Floats:
        """Take the rotations of `x` into `reference`; return `x` with rotation vectors of zero.

        The place of every node stays the same. Do it before a rotation vector comes near 2 pi, where it is singular.
        """
        x = self._turn(x).copy()
        self.reference[:] = self._turned.rotation
        # round-off must not grow with the number of times this is done
        u, _, v = np.linalg.svd(self.reference)
        self.reference[:] = u @ v
        x[len(self.carrier) :] = 0.0
        return x

    def middle(self, x: Floats) -> Floats:
        """Return the points of the mid-surface at the nodes, (m, 3) [mm]."""
        self._turn(x)
        return self._turned.middle.copy()

    def rotations(self, x: Floats) -> Floats:
        """Return how every node has turned since rest, (m, 3, 3)."""
        self._turn(x)
        return self._turned.rotation.copy()

    def attached(self, x: Floats, arm: Any) -> Floats:
        """Return where points at `arm` (m, 3) [mm] from the nodes at rest are carried to, (m, 3) [mm]."""
        return np.ascontiguousarray(x[: len(self.carrier)]) + self._arm(x, arm)

    def _arm(self, x: Floats, arm: Any) -> Floats:
        self._turn(x)
        return np.einsum("mij,mj->mi", self._turned.rotation, floats("arm", arm, len(self.carrier), 3))

    def attached_slopes(self, x: Floats, arm: Any) -> Floats:
        """Return the derivative of each attached point by its node's rotation vector, (m, 3, 3): -[R arm]x T."""
        turned = self._arm(x, arm)
        return np.asarray(np.cross(self._turned.spin, turned[:, :, None], axis=1))

    def attached_forces(self, x: Floats, arm: Any, force: Any) -> Floats:
        """Return the load on the freedoms, (2m, 3), of forces (m, 3) [mN] on the attached points: force and moment."""
        load = floats("force", force, len(self.carrier), 3)
        return np.concatenate([load, np.einsum("mij,mi->mj", self.attached_slopes(x, arm), load)])

    def attached_curvatures(self, x: Floats, arm: Any, force: Any) -> Floats:
        """Return the second derivative of force . point by each node's rotation vector, (m, 3, 3) [mN mm], symmetric."""
        turned = self._arm(x, arm)
        load = floats("force", force, len(self.carrier), 3)
        out = np.empty((len(turned), 3, 3))
        kernels.arm_curvatures(np.ascontiguousarray(x, dtype=np.float64), self._turned, turned, load, out)
        return out


def _frames(corner: Floats) -> tuple[Floats, Floats]:
    """Return frames (t, 3, 3), columns along the first side, across it and normal, and the areas (t,)."""
    side = corner[:, [1, 2, 0]] - corner
    normal = np.cross(side[:, 0], -side[:, 2])
    double = np.linalg.norm(normal, axis=1)
    longest = (side**2).sum(axis=2).max(axis=1)
    bad = np.flatnonzero(~(0.5 * double > FLATTEST * longest))
    if len(bad):
        raise UserError(
            f"triangle {bad[0]} has an area of {0.5 * double[bad[0]]:.3g} mm^2 (and {len(bad) - 1} more are as flat); "
            "take out triangles without area"
        )
    first = side[:, 0] / np.linalg.norm(side[:, 0], axis=1)[:, None]
    third = normal / double[:, None]
    return np.stack([first, np.cross(third, first), third], axis=2), 0.5 * double


def _slopes(flat: Floats, area: Floats) -> Floats:
    """Return the gradients, (t, 3, 2) [1/mm], of the barycentric coordinates of triangles with corners `flat` (t, 3, 2)."""
    opposite = flat[:, [2, 0, 1]] - flat[:, [1, 2, 0]]
    return np.stack([-opposite[:, :, 1], opposite[:, :, 0]], axis=2) / (2.0 * area[:, None, None])


def _bending(flat: Floats, slope: Floats, area: Floats, stiffness: Floats, poisson: Floats) -> Floats:
    """Return the bending stiffness, (t, 6, 6) [mN mm], over the slopes (beta_x, beta_y) of the normal at the corners.

    The discrete Kirchhoff triangle of Batoz, Bathe & Ho, Int. J. Numer. Methods Eng. 15, 1980, for corners in their own
    plane: beta = sum L_a beta_a - 3 sum over sides L_i L_j s s^T (beta_i + beta_j), s along the side; three mid-side
    points integrate it exactly.
    """
    strain = np.zeros((len(flat), 3, 3, 6))
    middle = 0.5 * (np.ones((3, 3)) - np.eye(3))
    for q in range(3):
        for a in range(3):
            _add_curvature(strain[:, q], a, slope[:, a, :, None, None] * np.eye(2))
        for i, j in ((0, 1), (1, 2), (2, 0)):
            side = flat[:, j] - flat[:, i]
            along = side / np.linalg.norm(side, axis=1)[:, None]
            bubble = -3.0 * (middle[q, i] * slope[:, j] + middle[q, j] * slope[:, i])
            change = along[:, :, None] * along[:, None, :]
            for a in (i, j):
                _add_curvature(strain[:, q], a, bubble[:, :, None, None] * change[:, None])
    rigid = np.zeros((len(flat), 3, 3))
    rigid[:, 0, 0] = rigid[:, 1, 1] = stiffness
    rigid[:, 0, 1] = rigid[:, 1, 0] = stiffness * poisson
    rigid[:, 2, 2] = 0.5 * stiffness * (1.0 - poisson)
    return np.asarray(np.einsum("t,tqcr,tcd,tqds->trs", area / 3.0, strain, rigid, strain, optimize=True))


def _add_curvature(strain: Floats, a: int, part: Floats) -> None:
    """Add to `strain` (t, 3, 6) the part (t, j, i, k) of beta_k at corner `a` in d(beta_i)/d(x_j)."""
    at = slice(2 * a, 2 * a + 2)
    strain[:, 0, at] += part[:, 0, 0]
    strain[:, 1, at] += part[:, 1, 1]
    strain[:, 2, at] += part[:, 1, 0] + part[:, 0, 1]


@dataclass(eq=False)
class Placed:
    """A pattern with a place for every node, as a factorisation needs it to find a good order."""

    places: Floats
    indices: Ints
    node_pattern: sparse.csr_matrix
    pattern: Pattern

    def matrix(self, values: Floats) -> sparse.csr_matrix:
        """Return the sparse matrix with these `values`."""
        return self.pattern.matrix(values)


class ShellSystem:
    """Shells alone as a system for `newton`: freedoms (2m, 3), positions and then rotation vectors."""

    linear = False

    def __init__(self, shells: Shells) -> None:
        self.shells, self.points, self.node = shells, shells.points, shells.node
        self.pattern = Pattern(shells.node, len(shells.points))
        self.indices, self.indptr = self.pattern.indices, self.pattern.indptr
        self.node_pattern = self.pattern.node_pattern
        self._vector = np.zeros((len(shells.node), 6, 3))
        self._matrix: Floats = np.zeros((0, 18, 18))

    barrier = True

    @cached_property
    def stiffness_scale(self) -> float:
        """Volume times Young's modulus, summed [uJ]."""
        young = np.array([s.young_modulus for s in self.shells.sheets])[self.shells.region]
        return float((self.shells.panels.measure * young).sum())

    def energy(self, x: Floats) -> float:
        """Return the elastic energy [uJ], infinite where a triangle has no area."""
        return float(self.shells.energies(x).sum())

    def forces(self, x: Floats) -> Floats:
        """Return minus the gradient of the energy, (2m, 3) [mN], [mN mm]."""
        self._vector = self.shells.forces(x)
        return self.pattern.vectors(self._vector)

    def force_scale(self) -> float:
        """Return the largest force or moment of a single triangle in the last call of `forces`."""
        return float(np.abs(self._vector).max(initial=0.0))

    def volume_ratio(self, x: Floats) -> Floats:
        """Return every triangle's area over that at rest, (t,); a shell's volume cannot be inverted."""
        return self.shells.area_ratios(x)

    def tangent_values(self, x: Floats, out: Floats, *, definite: bool = False) -> Floats:
        """Write the values of the tangent in its fixed pattern into `out`, and return it."""
        if not len(self._matrix):
            self._matrix = np.zeros((len(self.node), 18, 18))
        self.shells.stiffnesses(x, definite=definite, out=self._matrix)
        return self.pattern.values(self._matrix, out)

    def matrix(self, values: Floats) -> sparse.csr_matrix:
        """Return the sparse matrix (6m, 6m) with these `values`."""
        return self.pattern.matrix(values)

    def tangent(self, x: Floats, *, definite: bool = False) -> sparse.csr_matrix:
        """Return the Hessian of the energy, (6m, 6m), symmetric."""
        return self.matrix(self.tangent_values(x, np.empty(len(self.indices)), definite=definite))

    def factorisation(self, free: Bools) -> Factor:
        """Return what solves with the tangent over the freedoms that are `free`, (2m, 3)."""
        places = np.concatenate([self.shells.carrier, self.shells.carrier])
        return Factor(Placed(places, self.indices, self.node_pattern, self.pattern), free)

    def linear_answer(self, fixed: Any, force: Any) -> Floats:
        """Return the small displacements and rotations, (2m, 3), under `force` (2m, 3) from rest: one linear solution.

        fixed : (2m, 3) bool, freedoms that stay. Raises `UserError` if the fixed freedoms leave the shell loose.
        """
        free = ~np.asarray(fixed, dtype=bool)
        if free.shape != self.points.shape:
            raise UserError(f"fixed has shape {free.shape}; {self.points.shape} is needed")
        factor = self.factorisation(free)
        values = self.tangent_values(self.points, np.empty(len(self.indices)))
        if not factor.factor(values) or not factor.definite():
            raise UserError("the fixed freedoms leave the shell loose; fix at least its six rigid motions")
        return factor.solve(np.where(free, floats("force", force, *self.points.shape), 0.0))
