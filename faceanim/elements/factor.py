"""Sparse direct solution for the freedoms that are free, with a node order and a pattern that are made once."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from faceanim.ground.arrays import Bools, Floats, Ints

LEAF = 16
"""Node sets of this size are no longer divided."""


def dissected(points: Floats, adjacent: sparse.csr_matrix) -> Ints:
    """Return an elimination order of `points` (n, 3) with little fill: halves first, then what separates them.

    adjacent : (n, n) pattern of who is coupled. Geometric nested dissection (George, SIAM J. Numer. Anal. 10, 1973).
    """
    order: list[Ints] = []
    mark = np.zeros(len(points))
    waiting: list[tuple[Ints, bool]] = [(np.arange(len(points), dtype=np.int32), False)]
    while waiting:
        nodes, final = waiting.pop()
        parts = None if final or len(nodes) <= LEAF else _halves(points, adjacent, nodes, mark)
        if parts is None:
            order.append(nodes)
        else:
            left, right, border = parts
            waiting += [(border, True), (right, False), (left, False)]
    return np.concatenate(order) if order else np.zeros(0, dtype=np.int32)


def _halves(points: Floats, adjacent: sparse.csr_matrix, nodes: Ints, mark: Floats) -> tuple[Ints, Ints, Ints] | None:
    """Return two halves of `nodes` across their longest side and the border between them, or None if there are none.

    The border is taken from the half where it is smaller: between quadratic elements a single layer of nodes does.
    """
    place = points[nodes]
    axis = int(np.argmax(np.ptp(place, axis=0)))
    # nodes of one layer stay together although their places differ by rounding
    low = place[:, axis] < np.median(place[:, axis]) - 1e-9 * np.ptp(place[:, axis])
    if not low.any():
        return None
    halves = (nodes[low], nodes[~low])
    borders = [_touching(adjacent, halves[k], halves[1 - k], mark) for k in (0, 1)]
    k = int(borders[1].sum() < borders[0].sum())
    return halves[k][~borders[k]], halves[1 - k], halves[k][borders[k]]


def _touching(adjacent: sparse.csr_matrix, nodes: Ints, others: Ints, mark: Floats) -> Bools:
    """Return which of `nodes` are coupled to one of `others`; `mark` (n,) is zero before and after."""
    mark[others] = 1.0
    out = np.asarray(adjacent[nodes] @ mark) > 0.0
    mark[others] = 0.0
    return out


class Patterned(Protocol):
    """A matrix over the freedoms of nodes, in a fixed pattern; `node_pattern` (n, n) says which nodes are coupled.

    places : (n, 3) where the nodes are, for the order of elimination
    """

    places: Floats
    indices: Ints
    node_pattern: sparse.csr_matrix

    def matrix(self, values: Floats) -> sparse.csr_matrix:
        """Return the matrix (3n, 3n) with these `values`."""


class Factor:
    """Solves K u = b for the free freedoms of `elements`; the others of u are zero.

    SuperLU in symmetric mode without pivoting, on rows in nested dissection order.
    """

    def __init__(self, elements: Patterned, free: Bools) -> None:
        self.free = free.ravel().copy()
        self._elements = elements
        self._values: Floats = np.zeros(len(elements.indices))
        nodes = np.flatnonzero(self.free.reshape(-1, 3).any(axis=1))
        pattern = elements.node_pattern[nodes][:, nodes]
        inner = nodes[dissected(elements.places[nodes], pattern)]
        rows = (3 * inner[:, None] + np.arange(3)).ravel()
        self.rows = rows[self.free[rows]]
        numbered = elements.matrix(np.arange(1.0, len(elements.indices) + 1.0))
        reduced = numbered[self.rows][:, self.rows].tocsc()
        reduced.sort_indices()
        self._pick = reduced.data.astype(np.int64) - 1
        self._matrix = sparse.csc_matrix((np.zeros(len(self._pick)), reduced.indices, reduced.indptr), reduced.shape)
        self._lu: Any = None

    def factor(self, values: Floats, shift: float = 0.0) -> bool:
        """Factorise the matrix with these `values` in the elements' pattern, plus `shift` I; return whether it could be."""
        self._values = values
        self._matrix.data[:] = values[self._pick]
        matrix = self._matrix + shift * sparse.identity(len(self.rows), format="csc") if shift else self._matrix
        try:
            self._lu = splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError:  # exactly singular
            self._lu = None
        return self._lu is not None

    def solve(self, right: Floats, moved: Floats | None = None) -> Floats:
        """Return u, (n, 3), for the right-hand side `right` (n, 3) while the fixed freedoms go by `moved` (n, 3)."""
        if moved is not None:
            pushed = self._elements.matrix(self._values) @ moved.ravel()
            right = right - pushed.reshape(-1, 3)
        out = np.zeros(right.size)
        if len(self.rows):
            out[self.rows] = self._lu.solve(right.ravel()[self.rows])
        return out.reshape(-1, 3)

    def definite(self) -> bool:
        """Return whether the matrix factorised last is positive definite: all its pivots are positive."""
        return bool((self._lu.U.diagonal() > 0).all())


class Cholesky(Factor):
    """The same by CHOLMOD through the extra `cholespy`, three times as fast on large quadratic meshes; definite only.

    A matrix that is not definite counts as one that cannot be factorised, so that a search takes the definite tangent.
    """

    def factor(self, values: Floats, shift: float = 0.0) -> bool:
        """Factorise the matrix with these `values` plus `shift` I; return whether it is positive definite."""
        from cholespy import CholeskySolverD, MatrixType

        self._values = values
        self._matrix.data[:] = values[self._pick]
        matrix = self._matrix + shift * sparse.identity(len(self.rows), format="csc") if shift else self._matrix
        parts = (matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data)
        try:
            self._lu = _Solved(CholeskySolverD(len(self.rows), *parts, MatrixType.CSC))
        except ValueError:
            self._lu = None
        return self._lu is not None

    def definite(self) -> bool:
        """Return true: others are not factorised."""
        return self._lu is not None


@dataclass(frozen=True)
class _Solved:
    """A Cholesky factor with the interface of SuperLU's."""

    factor: Any

    def solve(self, right: Floats) -> Floats:
        """Return the solution (n,)."""
        out = np.zeros(len(right))
        self.factor.solve(np.ascontiguousarray(right), out)
        return out


def has_cholesky() -> bool:
    """Whether the extra is installed."""
    return find_spec("cholespy") is not None
