"""Finite elements of a solid: energy, forces and stiffness element by element, then gathered node by node.

Nothing is scattered: each node, and each pair of nodes, sums its own elements in a fixed order, so that the result
does not depend on the number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faceanim.ground.jit import kernel, prange
from faceanim.kernels.hyperelastic import determinant, energy_density, make_definite, stress, tangent

F8 = NDArray[np.float64]
I4 = NDArray[np.int32]


class Cells(NamedTuple):
    """e elements of a nodes each, with q quadrature points.

    node : (e, a)   gradient : (e, q, a, 3) of the shape functions [1/mm]   weight : (e, q) [mm^3], they sum to the volume
    constant : (e, 5) lambda, mu, c10, c01, kappa [kPa]
    """

    node: I4
    gradient: F8
    weight: F8
    constant: F8


class Work(NamedTuple):
    """Room for one quadrature point of every element.

    F, P : (e, 3, 3)   frame : (e, 3, 3, 3)   A, vectors, values : (e, 9, 9)   half : (e, 9, 3a)
    """

    F: F8
    P: F8
    frame: F8
    A: F8
    vectors: F8
    values: F8
    half: F8


class Gather(NamedTuple):
    """Which element entries each node, and each pair of coupled nodes, sums.

    start : (n + 1,), slot : element * a + corner of node i
    row : (n + 1,) first pair of node i   pair_start : (k + 1,), pair_slot : (element * a + corner) * a + other corner
    """

    start: I4
    slot: I4
    row: I4
    pair_start: I4
    pair_slot: I4


@kernel(inline=True)
def deformation(cells, e, q, u, F):
    """Write F = I + sum_a u_a g_a^T of element `e` at point `q` into `F` (3, 3); `u` (n, 3) are displacements."""
    for i in range(3):
        for j in range(3):
            F[i, j] = 1.0 if i == j else 0.0
    for a in range(cells.node.shape[1]):
        v = cells.node[e, a]
        for i in range(3):
            for j in range(3):
                F[i, j] += u[v, i] * cells.gradient[e, q, a, j]


@kernel(parallel=True)
def energies(cells, law, u, work, out, ratio):
    """Write each element's energy [uJ] into `out` (e,) and its smallest J over the points into `ratio` (e,)."""
    for e in prange(len(cells.node)):
        total = 0.0
        least = np.inf
        for q in range(cells.weight.shape[1]):
            deformation(cells, e, q, u, work.F[e])
            total += cells.weight[e, q] * energy_density(law, work.F[e], cells.constant[e], work.frame[e])
            least = min(least, determinant(work.F[e]))
        out[e] = total
        ratio[e] = least


@kernel(parallel=True)
def forces(cells, law, u, work, out):
    """Write minus the gradient of each element's energy into `out` (e, a, 3) [mN]."""
    for e in prange(len(cells.node)):
        P = work.P[e]
        for a in range(cells.node.shape[1]):
            for i in range(3):
                out[e, a, i] = 0.0
        for q in range(cells.weight.shape[1]):
            deformation(cells, e, q, u, work.F[e])
            stress(law, work.F[e], cells.constant[e], work.frame[e], P)
            w = cells.weight[e, q]
            for a in range(cells.node.shape[1]):
                for i in range(3):
                    s = 0.0
                    for j in range(3):
                        s += P[i, j] * cells.gradient[e, q, a, j]
                    out[e, a, i] -= w * s


@kernel(parallel=True)
def stiffnesses(cells, law, u, definite, work, out):
    """Write the Hessian of each element's energy into `out` (e, 3a, 3a) [mN/mm].

    definite : raise the negative eigenvalues of dP/dF to zero at every point, so that no element has a negative one
    """
    for e in prange(len(cells.node)):
        for r in range(out.shape[1]):
            for s in range(out.shape[2]):
                out[e, r, s] = 0.0
        for q in range(cells.weight.shape[1]):
            deformation(cells, e, q, u, work.F[e])
            tangent(law, work.F[e], cells.constant[e], work.frame[e], work.A[e])
            if definite:
                make_definite(work.A[e], work.vectors[e], work.values[e], 0.0)
            _add_stiffness(cells, e, q, work.A[e], work.half[e], out[e])


@kernel
def _add_stiffness(cells, e, q, A, half, out):
    """Add w g_a . A . g_b of one point to `out` (3a, 3a); `half` (9, 3a) is overwritten."""
    n = cells.node.shape[1]
    w = cells.weight[e, q]
    for m in range(9):
        for b in range(n):
            g0 = w * cells.gradient[e, q, b, 0]
            g1 = w * cells.gradient[e, q, b, 1]
            g2 = w * cells.gradient[e, q, b, 2]
            for k in range(3):
                half[m, 3 * b + k] = A[m, 3 * k] * g0 + A[m, 3 * k + 1] * g1 + A[m, 3 * k + 2] * g2
    for a in range(n):
        g0 = cells.gradient[e, q, a, 0]
        g1 = cells.gradient[e, q, a, 1]
        g2 = cells.gradient[e, q, a, 2]
        for i in range(3):
            for s in range(3 * n):
                out[3 * a + i, s] += half[3 * i, s] * g0 + half[3 * i + 1, s] * g1 + half[3 * i + 2, s] * g2


@kernel(parallel=True)
def gather_nodes(gather, element, out):
    """Sum the vectors `element` (e, a, 3) of each node's elements into `out` (n, 3)."""
    n = element.shape[1]
    for i in prange(len(out)):
        x = 0.0
        y = 0.0
        z = 0.0
        for k in range(gather.start[i], gather.start[i + 1]):
            s = gather.slot[k]
            x += element[s // n, s % n, 0]
            y += element[s // n, s % n, 1]
            z += element[s // n, s % n, 2]
        out[i, 0] = x
        out[i, 1] = y
        out[i, 2] = z


@kernel(parallel=True)
def gather_pairs(gather, element, out):
    """Sum the matrices `element` (e, 3a, 3a) into the values `out` of a sparse matrix with three rows a node."""
    n = element.shape[1] // 3
    for i in prange(len(gather.row) - 1):
        first = gather.row[i]
        count = gather.row[i + 1] - first
        for k in range(9 * first, 9 * (first + count)):
            out[k] = 0.0
        for c in range(count):
            for k in range(gather.pair_start[first + c], gather.pair_start[first + c + 1]):
                s = gather.pair_slot[k]
                e = s // (n * n)
                a = (s // n) % n
                b = s % n
                for r in range(3):
                    at = 9 * first + 3 * r * count + 3 * c
                    for t in range(3):
                        out[at + t] += element[e, 3 * a + r, 3 * b + t]
