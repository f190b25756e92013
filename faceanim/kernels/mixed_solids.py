"""Solids whose change of volume is averaged before it costs energy: shape part, volume part and their derivatives.

The volume measure J - 1 (its linear part, tr(F - I), for the linear law) is weighted with the pressure's shape functions
N_a: g_a = sum of w N_a (J - 1). Its conjugate is the mean pressure p_a, positive in tension; see `elements.mixed`.
"""

from __future__ import annotations

from typing import NamedTuple

from faceanim.ground.jit import kernel, prange
from faceanim.kernels.hyperelastic import LINEAR, make_definite, stress, tangent, volume_change
from faceanim.kernels.solids import _add_stiffness, deformation
from faceanim.kernels.tables import I4


class Blocks(NamedTuple):
    """Which element entries each pair of a pressure and a node sums.

    row : (m + 1,) first pair of pressure a   pair_start : (k + 1,)   pair_slot : (element * 4 + corner) * a + node
    """

    row: I4
    pair_start: I4
    pair_slot: I4


@kernel(inline=True)
def cofactor(law, F, C):
    """Write dJ/dF, or I for the linear law, into `C` (3, 3)."""
    for i in range(3):
        k = (i + 1) % 3
        m = (i + 2) % 3
        for j in range(3):
            p = (j + 1) % 3
            q = (j + 2) % 3
            if law == LINEAR:
                C[i, j] = 1.0 if i == j else 0.0
            else:
                C[i, j] = F[k, p] * F[m, q] - F[k, q] * F[m, p]


@kernel(parallel=True)
def volumes(cells, law, shape, u, work, out):
    """Write each element's share of g into `out` (e, 4) [mm^3]; `shape` (q, 4) are the pressure's shape functions."""
    for e in prange(len(cells.node)):
        F = work.F[e]
        for a in range(4):
            out[e, a] = 0.0
        for q in range(cells.weight.shape[1]):
            deformation(cells, e, q, u, F)
            change = F[0, 0] + F[1, 1] + F[2, 2] - 3.0 if law == LINEAR else volume_change(F)
            for a in range(4):
                out[e, a] += cells.weight[e, q] * shape[q, a] * change


@kernel(parallel=True)
def forces(cells, law, shape, u, pressure, work, out):
    """Write minus the gradient of each element's energy into `out` (e, a, 3) [mN]; `pressure` (e, 4) [kPa]."""
    for e in prange(len(cells.node)):
        P = work.P[e]
        C = work.frame[e, 0]
        for a in range(cells.node.shape[1]):
            for i in range(3):
                out[e, a, i] = 0.0
        for q in range(cells.weight.shape[1]):
            deformation(cells, e, q, u, work.F[e])
            stress(law, work.F[e], cells.constant[e], work.frame[e], P)
            p = 0.0
            for a in range(4):
                p += shape[q, a] * pressure[e, a]
            cofactor(law, work.F[e], C)
            for i in range(3):
                for j in range(3):
                    P[i, j] += p * C[i, j]
            w = cells.weight[e, q]
            for a in range(cells.node.shape[1]):
                for i in range(3):
                    s = 0.0
                    for j in range(3):
                        s += P[i, j] * cells.gradient[e, q, a, j]
                    out[e, a, i] -= w * s


@kernel(parallel=True)
def stiffnesses(cells, law, shape, u, pressure, definite, work, out, slope):
    """Write the Hessian at constant pressure into `out` (e, 3a, 3a) [mN/mm] and dg into `slope` (e, 4, a, 3) [mm^2].

    definite : raise the negative eigenvalues of d(P + p dJ/dF)/dF to zero at every point
    """
    for e in prange(len(cells.node)):
        F = work.F[e]
        A = work.A[e]
        C = work.frame[e, 0]
        n = cells.node.shape[1]
        out[e] = 0.0
        slope[e] = 0.0
        for q in range(cells.weight.shape[1]):
            deformation(cells, e, q, u, F)
            tangent(law, F, cells.constant[e], work.frame[e], A)
            p = 0.0
            for a in range(4):
                p += shape[q, a] * pressure[e, a]
            if law != LINEAR:
                _add_spin(F, p, A)
            if definite:
                make_definite(A, work.vectors[e], work.values[e], 0.0)
            _add_stiffness(cells, e, q, A, work.half[e], out[e])
            cofactor(law, F, C)
            w = cells.weight[e, q]
            for b in range(n):
                for i in range(3):
                    s = 0.0
                    for j in range(3):
                        s += C[i, j] * cells.gradient[e, q, b, j]
                    for a in range(4):
                        slope[e, a, b, i] += w * shape[q, a] * s


@kernel(inline=True)
def _add_spin(F, p, A):
    """Add p d2J/dF dF, whose entries (ij, kl) are those of F with the signs of a double permutation, to `A` (9, 9)."""
    for i in range(3):
        for j in range(3):
            for s in range(2):
                k = (i + 1 + s) % 3
                m = (i + 2 - s) % 3
                for t in range(2):
                    l = (j + 1 + t) % 3
                    o = (j + 2 - t) % 3
                    A[3 * i + j, 3 * k + l] += p * F[m, o] if s == t else -p * F[m, o]


@kernel(parallel=True)
def gather_slopes(blocks, slope, out):
    """Sum dg of the elements, `slope` (e, 4, a, 3), into the values `out` (k, 3) of each pressure's pairs with nodes."""
    n = slope.shape[2]
    for c in prange(len(blocks.pair_start) - 1):
        x = 0.0
        y = 0.0
        z = 0.0
        for k in range(blocks.pair_start[c], blocks.pair_start[c + 1]):
            s = blocks.pair_slot[k]
            e = s // (4 * n)
            a = (s // n) % 4
            b = s % n
            x += slope[e, a, b, 0]
            y += slope[e, a, b, 1]
            z += slope[e, a, b, 2]
        out[c, 0] = x
        out[c, 1] = y
        out[c, 2] = z
