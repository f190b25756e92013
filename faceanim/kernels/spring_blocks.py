"""Gradient and diagonal Hessian blocks of the skin springs, for descent vertex by vertex or all at once."""

from __future__ import annotations

import numpy as np

from faceanim.ground.jit import kernel
from faceanim.kernels.memory import STORE, add4, load
from faceanim.kernels.spring_triangle import (
    BLOCK,
    binomials,
    collect_corners,
    forces_along_edges,
    indicators,
    is_small_integer,
    larger,
    spring_answers,
    triangle_shape,
)

_HALF = BLOCK // 2  # the results, more than twice those of the force alone, fill the cache sooner

# A kernel cannot index a tuple of functions.
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7, _S8, _S9, _S10, _S11, _S12, _S13 = STORE[:14]
_S14, _S15, _S16, _S17, _S18, _S19, _S20, _S21, _S22, _S23, _S24, _S25, _S26 = STORE[14:27]


@kernel(inline=True)
def _projected(tension, tangent, g, slope, t, squares, reciprocals, reaction):
    """Return of the corners A, B, C the numbers (s, p, q, r) of their blocks s I + p u u' + q (u v' + v u') + r v v'.

    Every spring gives its own direction the stiffness `tangent` or `slope`, the others its tension, if any.
    """
    t0, t1, t2 = t
    m0, m1, m2 = 1.0 - t0, 1.0 - t1, 1.0 - t2
    su, sv, sw = larger(tension[0], 0.0), larger(tension[1], 0.0), larger(tension[2], 0.0)
    ru, rv, rw, rn = reciprocals
    cu, cv, cw = (tangent[0] - su) * ru * ru, (tangent[1] - sv) * rv * rv, (tangent[2] - sw) * rw * rw
    s0, s1, s2 = larger(-g[0], 0.0), larger(-g[1], 0.0), larger(-g[2], 0.0)
    flat = rn * rn
    c0, c1, c2 = (
        (slope[0] - s0) * squares[0] * flat,
        (slope[1] - s1) * squares[1] * flat,
        (slope[2] - s2) * squares[2] * flat,
    )
    p0, q0 = c0 * m0 * m0, c0 * m0
    q1, r1 = c1 * t1, c1 * t1 * t1
    p2, q2, r2 = c2 * t2 * t2, -c2 * t2 * m2, c2 * m2 * m2
    a1, a2 = reaction * t1 * t1, reaction * m2 * m2
    b0, b2 = reaction * m0 * m0, reaction * t2 * t2
    d0, d1 = reaction * t0 * t0, reaction * m1 * m1
    eu, ev, ew = s0 * ru * ru, s1 * rv * rv, s2 * rw * rw  # a corner moving along the edge keeps its height
    return (
        (sv + sw + s0 + a1 * s1 + a2 * s2, cw + p0 - eu + a1 * c1 + a2 * p2, cw + q0 + a1 * q1 + a2 * q2,
         cv + cw + c0 + a1 * r1 + a2 * r2),
        (sw + su + s1 + b0 * s0 + b2 * s2, cu + cw + c1 + b0 * p0 + b2 * p2, cw + q1 + b0 * q0 + b2 * q2,
         cw + r1 - ev + b0 * c0 + b2 * r2),
        (su + sv + s2 + d0 * s0 + d1 * s1, cu + p2 - ew + d0 * p0 + d1 * c1, q2 - ew + d0 * q0 + d1 * q1,
         cv + r2 - ew + d0 * c0 + d1 * r1),
    )  # fmt: skip


@kernel(inline=True)
def _symmetric(number, uu, uv, vv):
    """Return the entries xx, xy, xz, yy, yz, zz of s I + p u u' + q (u v' + v u') + r v v'."""
    s, p, q, r = number
    return (
        s + p * uu[0] + q * uv[0] + r * vv[0],
        p * uu[1] + q * uv[1] + r * vv[1],
        p * uu[2] + q * uv[2] + r * vv[2],
        s + p * uu[3] + q * uv[3] + r * vv[3],
        p * uu[4] + q * uv[4] + r * vv[4],
        s + p * uu[5] + q * uv[5] + r * vv[5],
    )


@kernel(inline=True)
def _square(a):
    return a[0] * a[0], a[0] * a[1], a[0] * a[2], a[1] * a[1], a[1] * a[2], a[2] * a[2]


@kernel(inline=True)
def _mixed(a, b):
    return (
        2.0 * a[0] * b[0], a[0] * b[1] + a[1] * b[0], a[0] * b[2] + a[2] * b[0],
        2.0 * a[1] * b[1], a[1] * b[2] + a[2] * b[1], 2.0 * a[2] * b[2],
    )  # fmt: skip


@kernel(inline=True)
def _gradient_block(springs, corner, result, first, count, law, reaction):
    """Compute gradient and diagonal Hessian block of the corners of `count` triangles from `first` on."""
    for q in range(count):
        u, v, squares, reciprocals, t = triangle_shape(corner, q)
        tension, tangent, g, slope = spring_answers(springs, first + q, squares, reciprocals, law)
        a, b, c = forces_along_edges(tension, g, t, reaction)
        na, nb, nc = _projected(tension, tangent, g, slope, t, squares, reciprocals, reaction)
        uu, uv, vv = _square(u), _mixed(u, v), _square(v)
        ha, hb, hc = _symmetric(na, uu, uv, vv), _symmetric(nb, uu, uv, vv), _symmetric(nc, uu, uv, vv)
        i, j, k = 4 * q, 4 * (BLOCK + q), 4 * (2 * BLOCK + q)
        _S0(result, i, -(a[0] * u[0] + a[1] * v[0]))
        _S1(result, i + 1, -(a[0] * u[1] + a[1] * v[1]))
        _S2(result, i + 2, -(a[0] * u[2] + a[1] * v[2]))
        _S3(result, i + 3, ha[0])
        _S4(result, 12 * BLOCK + i, ha[1])
        _S5(result, 12 * BLOCK + i + 1, ha[2])
        _S6(result, 12 * BLOCK + i + 2, ha[3])
        _S7(result, 12 * BLOCK + i + 3, ha[4])
        _S8(result, 24 * BLOCK + q, ha[5])
        _S9(result, j, -(b[0] * u[0] + b[1] * v[0]))
        _S10(result, j + 1, -(b[0] * u[1] + b[1] * v[1]))
        _S11(result, j + 2, -(b[0] * u[2] + b[1] * v[2]))
        _S12(result, j + 3, hb[0])
        _S13(result, 12 * BLOCK + j, hb[1])
        _S14(result, 12 * BLOCK + j + 1, hb[2])
        _S15(result, 12 * BLOCK + j + 2, hb[3])
        _S16(result, 12 * BLOCK + j + 3, hb[4])
        _S17(result, 25 * BLOCK + q, hb[5])
        _S18(result, k, -(c[0] * u[0] + c[1] * v[0]))
        _S19(result, k + 1, -(c[0] * u[1] + c[1] * v[1]))
        _S20(result, k + 2, -(c[0] * u[2] + c[1] * v[2]))
        _S21(result, k + 3, hc[0])
        _S22(result, 12 * BLOCK + k, hc[1])
        _S23(result, 12 * BLOCK + k + 1, hc[2])
        _S24(result, 12 * BLOCK + k + 2, hc[3])
        _S25(result, 12 * BLOCK + k + 3, hc[4])
        _S26(result, 26 * BLOCK + q, hc[5])


@kernel(inline=True)
def _add_nine(out, vertex, result, k, q):
    add4(out, 9 * vertex, result, 4 * (k * BLOCK + q))
    add4(out, 9 * vertex + 4, result, 4 * ((3 + k) * BLOCK + q))
    out[vertex, 8] += load(result, (24 + k) * BLOCK + q)


@kernel
def elastic_gradient_blocks(x, springs, law, scratch, out):
    """Write gradient and projected diagonal Hessian block of the elastic energy of every vertex into `out`.

    x : (n, 3) [mm]   springs : `Springs`   law : `Law`   scratch : `force_scratch(springs)`
    out : (n, 9): gradient gx, gy, gz = minus `elastic_force` [mN], then xx, xy, xz, yy, yz, zz of the block [mN/mm]

    A structural spring with tangent stiffness k, length l and tension f along u gives each end
        k u u' + max(f / l, 0) (I - u u'),
    an edge repulsion spring with k = -g'(h), n along the height and e along the edge gives its corner
        k n n' + max(-g / h, 0) (I - n n' - e e'),
    and with reaction the ends of its edge, times (1 - t)^2 and t^2,
        k n n' + max(-g / h, 0) (I - n n').
    Every term is positive semidefinite. The blocks are exact at rest; in tension those of structural springs and of
    a height at its own corner are, those at the ends of an edge lie above the exact ones as far as the turning of the
    edge goes; in compression the negative directions are left out.
    """
    total = springs.a.size
    smooth = is_small_integer(law.alpha, 0.0) and is_small_integer(law.beta, 1.0)
    reaction = 1.0 * law.reaction
    whole = (law.alpha, 1.0 / (law.s0 * law.s0), law.beta, binomials(law.alpha))
    powers = indicators(law.beta)
    for i in range(out.shape[0]):
        for d in range(9):
            out[i, d] = 0.0
    for first in range(0, total, _HALF):
        count = min(_HALF, total - first)
        collect_corners(x, springs, scratch.corner, first, count)
        if smooth:
            _gradient_block(
                springs, scratch.corner, scratch.result, first, count, (*whole, False, powers, False), reaction
            )
        elif is_small_integer(law.beta, 1.0):
            _gradient_block(
                springs, scratch.corner, scratch.result, first, count, (*whole, True, powers, False), reaction
            )
        else:
            _gradient_block(
                springs, scratch.corner, scratch.result, first, count, (*whole, True, powers, True), reaction
            )
        for q in range(count):
            i = first + q
            _add_nine(out, np.intp(load(springs.a, i)), scratch.result, 0, q)
            _add_nine(out, np.intp(load(springs.b, i)), scratch.result, 1, q)
            _add_nine(out, np.intp(load(springs.c, i)), scratch.result, 2, q)
