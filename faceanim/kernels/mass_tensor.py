"""The mass-tensor model: forces of linear tetrahedra from tensors that are computed once; no element is evaluated.

The linear part has a 3 x 3 tensor for each vertex and each edge. What Green's strain adds to St Venant-Kirchhoff's law is
a polynomial in the displacements u_a of an element's corners, with s_q = u_k . u_l for its ten pairs q = (k, l), k <= l:

    W = 1/2 u . K u + sum_jq (u_j . C_jq) s_q + sum_qr D_qr s_q s_r
"""

from __future__ import annotations

from typing import NamedTuple

from faceanim.ground.jit import kernel, prange
from faceanim.kernels.tables import F8, I4


class Tensors(NamedTuple):
    """What the model keeps of e elements over n vertices.

    start : (n + 1,), other : (k,) vertices that share an edge with each vertex, and itself   linear : (k, 3, 3) [mN/mm]
    node : (e, 4)   cubic : (e, 4, 10, 3) [mN/mm^2]   quartic : (e, 10, 10) [mN/mm^3]; multiplicities of pairs are included
    """

    start: I4
    other: I4
    linear: F8
    node: I4
    cubic: F8
    quartic: F8


@kernel(inline=True)
def pair(q):
    """Return k <= l of the pair `q` of 0..9, in the order 00 01 02 03 11 12 13 22 23 33."""
    if q < 4:
        return 0, q
    if q < 7:
        return 1, q - 3
    if q < 9:
        return 2, q - 5
    return 3, 3


@kernel(parallel=True)
def linear_forces(tensors, u, out):
    """Write minus the tensors times the displacements `u` of each vertex's neighbours into `out` (n, 3) [mN]."""
    for i in prange(len(out)):
        x = 0.0
        y = 0.0
        z = 0.0
        for k in range(tensors.start[i], tensors.start[i + 1]):
            T = tensors.linear[k]
            v = u[tensors.other[k]]
            x -= T[0, 0] * v[0] + T[0, 1] * v[1] + T[0, 2] * v[2]
            y -= T[1, 0] * v[0] + T[1, 1] * v[1] + T[1, 2] * v[2]
            z -= T[2, 0] * v[0] + T[2, 1] * v[1] + T[2, 2] * v[2]
        out[i, 0] = x
        out[i, 1] = y
        out[i, 2] = z


@kernel(inline=True)
def _products(tensors, e, u, s, t):
    """Write s_q and t_q = dW/ds_q of element `e` into rows of `s` and `t`; return its cubic and quartic energy."""
    cubic = 0.0
    quartic = 0.0
    for q in range(10):
        k, l = pair(q)
        a = u[tensors.node[e, k]]
        b = u[tensors.node[e, l]]
        s[e, q] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    for q in range(10):
        along = 0.0
        for j in range(4):
            v = u[tensors.node[e, j]]
            C = tensors.cubic[e, j, q]
            along += v[0] * C[0] + v[1] * C[1] + v[2] * C[2]
        bend = 0.0
        for r in range(10):
            bend += tensors.quartic[e, q, r] * s[e, r]
        t[e, q] = along + 2.0 * bend
        cubic += along * s[e, q]
        quartic += bend * s[e, q]
    return cubic + quartic


@kernel(parallel=True)
def energies(tensors, u, s, t, out):
    """Write the cubic and quartic energy of each element into `out` (e,) [uJ]; `s`, `t` (e, 10) are overwritten."""
    for e in prange(len(out)):
        out[e] = _products(tensors, e, u, s, t)


@kernel(parallel=True)
def forces(tensors, u, s, t, out):
    """Write the cubic and quartic forces of each element on its corners into `out` (e, 4, 3) [mN]."""
    for e in prange(len(out)):
        _products(tensors, e, u, s, t)
        for p in range(4):
            for i in range(3):
                f = 0.0
                for q in range(10):
                    f -= tensors.cubic[e, p, q, i] * s[e, q]
                out[e, p, i] = f
        for q in range(10):
            k, l = pair(q)
            for i in range(3):
                out[e, k, i] -= t[e, q] * u[tensors.node[e, l], i]
                out[e, l, i] -= t[e, q] * u[tensors.node[e, k], i]
