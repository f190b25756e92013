"""Hexahedral elements of order p on a graded box, linear and elastic: the reference for solutions on blocks.

Tensor-product Lagrange elements with full Gauss integration; order 1 may average its dilatation over each element
(B-bar), the usual cure for the locking of nearly incompressible flesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from faceanim.ground.arrays import Bools, Floats
from faceanim.ground.errors import UserError


class Bricks:
    """A box meshed by hexahedra of `order`; `axes` are the element corners along x, y, z [mm].

    average_dilatation : B-bar, order 1 only
    """

    def __init__(
        self, axes: Sequence[Any], young_modulus: float, poisson_ratio: float, *, order: int = 1,
        average_dilatation: bool = False,
    ) -> None:  # fmt: skip
        if order < 1 or len(axes) != 3 or any(np.any(np.diff(a) <= 0) or len(a) < 2 for a in axes):
            raise UserError("bricks: order must be at least 1 and each of the three axes increase")
        if not (young_modulus > 0 and -1 < poisson_ratio < 0.5):
            raise UserError(f"bricks: E = {young_modulus} must be positive, nu = {poisson_ratio} between -1 and 0.5")
        if average_dilatation and order != 1:
            raise UserError("bricks: the mean dilatation is for order 1")
        self.axes = [np.asarray(a, dtype=np.float64) for a in axes]
        self.order, self.average = order, average_dilatation
        self.shear = 0.5 * young_modulus / (1.0 + poisson_ratio)
        self.lame = 2.0 * self.shear * poisson_ratio / (1.0 - 2.0 * poisson_ratio)
        self.lines = [_refined(a, order) for a in self.axes]
        self.points = np.stack(np.meshgrid(*self.lines, indexing="ij"), axis=-1).reshape(-1, 3)

    @cached_property
    def nodes(self) -> np.ndarray:
        """Nodes of each element, (e, (p + 1)^3); the last axis of the box runs fastest."""
        p = self.order
        shape = [len(line) for line in self.lines]
        local = np.stack(np.meshgrid(*[np.arange(p + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        cell = np.stack(np.meshgrid(*[np.arange(len(a) - 1) for a in self.axes], indexing="ij"), axis=-1).reshape(-1, 3)
        at = p * cell[:, None] + local[None]
        return np.asarray((at[..., 0] * shape[1] + at[..., 1]) * shape[2] + at[..., 2])

    @cached_property
    def matrix(self) -> sparse.csc_matrix:
        """The stiffness, (3n, 3n) [mN/mm]."""
        sides = [np.diff(a) for a in self.axes]
        size = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
        shapes, which = np.unique(size.round(14), axis=0, return_inverse=True)
        block = np.stack([self._element(h) for h in shapes])[which.ravel()]
        rows = (3 * self.nodes[:, :, None] + np.arange(3)).reshape(len(self.nodes), -1)
        k = rows.shape[1]
        i, j = np.repeat(rows, k, axis=1).ravel(), np.tile(rows, (1, k)).ravel()
        return sparse.coo_matrix((block.ravel(), (i, j)), shape=(self.points.size,) * 2).tocsc()

    def _element(self, side: Floats) -> Floats:
        """Return the stiffness of an element with these sides (3,) [mm], (3k, 3k)."""
        t, w = np.polynomial.legendre.leggauss(self.order + 1)
        value, slope = lagrange(self.order, 0.5 * (t + 1.0))
        q = len(t)
        g: Floats = np.empty((q, q, q, len(value[0]) ** 3, 3))
        for axis in range(3):
            parts = [slope / side[a] if a == axis else value for a in range(3)]
            g[..., axis] = np.einsum("ia,jb,kc->ijkabc", *parts).reshape(q, q, q, -1)
        weight = np.einsum("i,j,k->ijk", w, w, w).ravel() * side.prod() / 8.0
        g = g.reshape(len(weight), -1, 3)
        spread = np.average(g, axis=0, weights=weight)[None] if self.average else g
        volume = np.array([weight.sum()]) if self.average else weight
        dots = np.einsum("q,qai,qbi->ab", weight, g, g, optimize=True)
        k = self.lame * np.einsum("q,qai,qbj->aibj", volume, spread, spread, optimize=True)
        k += self.shear * np.einsum("q,qaj,qbi->aibj", weight, g, g, optimize=True)
        k += self.shear * np.einsum("ab,ij->aibj", dots, np.eye(3))
        if self.average:  # the shear law sees the deviator: its dilatation is the mean one too
            own = np.einsum("q,qai,qbj->aibj", weight, g, g, optimize=True)
            mean = np.einsum("q,qai,qbj->aibj", volume, spread, spread, optimize=True)
            k += self.shear * 2.0 / 3.0 * (mean - own)
        size = 3 * g.shape[1]
        return np.asarray(k.reshape(size, size))

    def solve(self, prescribed: Bools, values: Floats, force: Floats | None = None) -> tuple[Floats, Floats]:
        """Return displacements and reactions, 2 x (n, 3) [mm, mN]; `prescribed`, `values`, `force` (n, 3)."""
        free = ~prescribed.ravel()
        if free.all():
            raise UserError("bricks: no displacement is prescribed, so the rigid motion is undetermined")
        u = np.where(prescribed, values, 0.0).ravel()
        load = np.zeros(len(u)) if force is None else force.ravel()
        right = (load - self.matrix @ u)[free]
        u[free] = factor(self.matrix[free][:, free]).solve(right)
        reaction = self.matrix @ u - load
        return u.reshape(-1, 3), reaction.reshape(-1, 3)

    def end_traction(self, traction: Any) -> Floats:
        """Return the nodal forces (n, 3) [mN] of a `traction` (3,) [kPa] on the far x face."""
        weights = [_integrals(self.axes[a], self.order) for a in (1, 2)]
        force = np.zeros((*[len(line) for line in self.lines], 3))
        force[-1] = np.einsum("j,k,c->jkc", *weights, np.asarray(traction, dtype=np.float64))
        return np.asarray(force.reshape(-1, 3))

    def at(self, points: Floats, values: Floats) -> Floats:
        """Return nodal `values` (n, c) interpolated at `points` (k, 3), (k, c)."""
        p = self.order
        grid = values.reshape(*[len(line) for line in self.lines], -1)
        out = np.zeros((len(points), grid.shape[-1]))
        cells, shapes = [], []
        for a in range(3):
            cell = np.clip(np.searchsorted(self.axes[a], points[:, a], side="right") - 1, 0, len(self.axes[a]) - 2)
            t = (points[:, a] - self.axes[a][cell]) / np.diff(self.axes[a])[cell]
            cells.append(p * cell)
            shapes.append(lagrange(p, t)[0])
        for i, j, k in np.ndindex(p + 1, p + 1, p + 1):
            weight = shapes[0][:, i] * shapes[1][:, j] * shapes[2][:, k]
            out += weight[:, None] * grid[cells[0] + i, cells[1] + j, cells[2] + k]
        return out


def factor(matrix: sparse.csc_matrix) -> Any:
    """Return the LU factors of a symmetric positive definite `matrix`."""
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def lagrange(order: int, t: Floats) -> tuple[Floats, Floats]:
    """Return Lagrange polynomials on evenly spaced nodes of [0, 1] and their slopes at `t` (q,), 2 x (q, order + 1)."""
    node = np.linspace(0.0, 1.0, order + 1)
    to_monomial = np.linalg.inv(np.vander(node, increasing=True))
    powers = np.vander(t, order + 1, increasing=True)
    slopes = np.zeros_like(powers)
    slopes[:, 1:] = powers[:, :-1] * np.arange(1, order + 1)
    return powers @ to_monomial, slopes @ to_monomial


def graded(length: float, cells: int, ratio: float, *, both: bool = False) -> Floats:
    """Return the corners of `cells` elements on [0, length] that grow by `ratio` from 0 (`both`: from either end)."""
    if both:
        half = graded(0.5 * length, cells // 2, ratio)
        return np.concatenate([half, length - half[-2::-1]])
    side = ratio ** np.arange(cells)
    return np.concatenate([[0.0], np.cumsum(side) * length / side.sum()])


def _refined(axis: Floats, order: int) -> Floats:
    """Return the nodes along one axis, `order` - 1 between each two corners."""
    inner = axis[:-1, None] + np.diff(axis)[:, None] * np.arange(order) / order
    return np.append(inner.ravel(), axis[-1])


def _integrals(axis: Floats, order: int) -> Floats:
    """Return the integral of each nodal function along one axis."""
    t, w = np.polynomial.legendre.leggauss(order + 1)
    own = 0.5 * w @ lagrange(order, 0.5 * (t + 1.0))[0]
    out = np.zeros(order * (len(axis) - 1) + 1)
    for c, side in enumerate(np.diff(axis)):
        out[order * c : order * (c + 1) + 1] += side * own
    return out
