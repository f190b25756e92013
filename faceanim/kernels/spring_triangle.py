"""The springs of one triangle (Zhang, Prakash & Sung, Eqs. 1-4 and 14): lengths, forces, stiffnesses, energies.

One triangle has three structural springs, s = l - d along an edge,
    tension T(s) = k (1 + q)^alpha s,  q = (s / s0)^2                                           (Eqs. 1, 2)
and three edge repulsion springs (Eqs. 3, 4, 14), s = h - d along the height h of a corner over the line of its
opposite edge, foot p = (1 - t) x_a + t x_b,
    g(h) = -k (1 + q)^alpha s + zeta ((d / h)^beta - 1),
a force g n on the corner, n = (x - p) / h, and with `reaction` also -(1 - t) g n and -t g n on the ends of the edge,
which makes it the exact gradient of an energy. Without it (the paper's form) momentum is not conserved.

All these forces lie in the plane of the triangle, so each corner's force is a combination of two edge vectors, and
three edge lengths and one cross product give all lengths, heights and directions.

The functions are inlined into loops over a block of triangles whose corners were copied to `ForceScratch.corner`; they
hold no branch that depends on the triangle, so that the compiler can work on several triangles at once. `law` is
    (alpha, 1 / s0^2, beta, binomials(alpha), alpha is no small integer, indicators(beta), beta is no small integer).
"""

from __future__ import annotations

import math

import numpy as np

from faceanim.ground.jit import kernel
from faceanim.kernels.memory import copy3, load
from faceanim.kernels.power import power, rsqrt

BLOCK = 128
_LARGEST_INTEGER = 3  # powers 0, 1, 2, 3 are polynomials; every other one goes through `power`


@kernel(inline=True)
def growth(q, alpha, poly, general):
    """Return K(s)/k = (1+q)^alpha and its tangent d(K s)/ds/k = (1+q)^(alpha-1) (1 + (2 alpha + 1) q)."""
    if general:
        p = power(1.0 + q, alpha - 1.0)
        return p * (1.0 + q), p * (1.0 + (2.0 * alpha + 1.0) * q)
    c1, c2, c3 = poly
    return 1.0 + q * (c1 + q * (c2 + q * c3)), 1.0 + q * (3.0 * c1 + q * (5.0 * c2 + q * (7.0 * c3)))


@kernel(inline=True)
def closeness(r, beta, indicators, general):
    """Return r^beta."""
    if general:
        return power(r, beta)
    return r * (indicators[0] + r * (indicators[1] + r * indicators[2]))


@kernel(inline=True)
def binomials(alpha):
    """Return the coefficients of q, q^2, q^3 in (1 + q)^alpha, alpha in 0..3."""
    return alpha, 0.5 * alpha * (alpha - 1.0), alpha * (alpha - 1.0) * (alpha - 2.0) / 6.0


@kernel(inline=True)
def indicators(beta):
    """Return 1 for the power of r that r^beta is, 0 for the others, beta in 1..3."""
    return 1.0 if beta == 1.0 else 0.0, 1.0 if beta == 2.0 else 0.0, 1.0 if beta == 3.0 else 0.0


@kernel(inline=True)
def is_small_integer(value, lowest):
    return value == lowest or (value > lowest and value <= _LARGEST_INTEGER and value == math.floor(value))


@kernel(inline=True)
def edge(square, reciprocal, springs, slot, law):
    """Return tension / length and tangent stiffness of a structural spring."""
    alpha, per_s0_squared, _, poly, general, _, _ = law
    s = square * reciprocal - load(springs.edge_length, slot)
    secant, tangent = growth(s * s * per_s0_squared, alpha, poly, general)
    stiffness = load(springs.edge_stiffness, slot)
    return stiffness * secant * s * reciprocal, stiffness * tangent


@kernel(inline=True)
def height(h, reciprocal, springs, slot, law):
    """Return g / h and -dg/dh of an edge repulsion spring."""
    alpha, per_s0_squared, beta, poly, general_alpha, indicators, general_beta = law
    rest = load(springs.height, slot)
    s = h - rest
    secant, tangent = growth(s * s * per_s0_squared, alpha, poly, general_alpha)
    stiffness = load(springs.height_stiffness, slot)
    zeta = load(springs.repulsion, slot)
    push = zeta * closeness(rest * reciprocal, beta, indicators, general_beta)
    pull = (push - zeta - stiffness * secant * s) * reciprocal
    return pull, stiffness * tangent + beta * push * reciprocal


@kernel(inline=True)
def corner_point(corner, k, q):
    """Return the coordinates of corner k of triangle q of the block."""
    i = 3 * (k * BLOCK + q)
    return load(corner, i), load(corner, i + 1), load(corner, i + 2)


@kernel(inline=True)
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(inline=True)
def triangle_shape(corner, q):
    """Return u, v, the squares and reciprocals of the lengths of u, v, w and of twice the area, and t0, t1, t2.

    u = C - B, v = A - C, w = B - A are the edges opposite A, B, C; the foot of A divides u at t0, and so on.
    """
    a, b, c = corner_point(corner, 0, q), corner_point(corner, 1, q), corner_point(corner, 2, q)
    u = (c[0] - b[0], c[1] - b[1], c[2] - b[2])
    v = (a[0] - c[0], a[1] - c[1], a[2] - c[2])
    w = (b[0] - a[0], b[1] - a[1], b[2] - a[2])
    n = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
    squares = (dot(u, u), dot(v, v), dot(w, w), dot(n, n))
    ru, rv, rw, rn = rsqrt(squares[0]), rsqrt(squares[1]), rsqrt(squares[2]), rsqrt(squares[3])
    uv = dot(u, v)
    return u, v, squares, (ru, rv, rw, rn), (1.0 + uv * (ru * ru), -uv * (rv * rv), -dot(v, w) * (rw * rw))


@kernel(inline=True)
def spring_answers(springs, i, squares, reciprocals, law):
    """Return of the springs of triangle i: edge tension / length, edge tangent, g / height, -dg/dh; three of each."""
    total = springs.a.size
    uu, vv, ww, nn = squares
    ru, rv, rw, rn = reciprocals
    area = nn * rn
    eu, ku = edge(uu, ru, springs, i, law)
    ev, kv = edge(vv, rv, springs, total + i, law)
    ew, kw = edge(ww, rw, springs, 2 * total + i, law)
    g0, y0 = height(area * ru, uu * ru * rn, springs, i, law)
    g1, y1 = height(area * rv, vv * rv * rn, springs, total + i, law)
    g2, y2 = height(area * rw, ww * rw * rn, springs, 2 * total + i, law)
    return (eu, ev, ew), (ku, kv, kw), (g0, g1, g2), (y0, y1, y2)


@kernel(inline=True)
def forces_along_edges(tension, g, t, reaction):
    """Return the forces on A, B, C as coefficients of u and v: (au, av), (bu, bv), (cu, cv).

    The heights as vectors are m0 u + v, -u - t1 v and t2 u - m2 v, with m = 1 - t.
    """
    eu, ev, ew = tension
    t0, t1, t2 = t
    m0, m1, m2 = 1.0 - t0, 1.0 - t1, 1.0 - t2
    g0, g1, g2 = g
    r0, r1, r2 = reaction * g0, reaction * g1, reaction * g2
    return (
        (g0 * m0 + t1 * r1 - m2 * t2 * r2 - ew, g0 + t1 * t1 * r1 + m2 * m2 * r2 - ev - ew),
        (-g1 - m0 * m0 * r0 - t2 * t2 * r2 + ew + eu, -t1 * g1 - m0 * r0 + t2 * m2 * r2 + ew),
        (t2 * g2 - t0 * m0 * r0 + m1 * r1 - eu, -m2 * g2 - t0 * r0 + m1 * t1 * r1 + ev),
    )


@kernel(inline=True)
def larger(a, b):
    return a if a > b else b


@kernel(inline=True)
def stiffness_bounds(tangent, g, slope, t, squares, reciprocals, reaction):
    """Return the stiffness bound of the corners A, B, C; see `elastic_force`."""
    ku, kv, kw = tangent
    t0, t1, t2 = abs(t[0]), abs(t[1]), abs(t[2])
    m0, m1, m2 = abs(1.0 - t[0]), abs(1.0 - t[1]), abs(1.0 - t[2])
    y0 = larger(slope[0], abs(g[0])) * (0.5 + 0.5 * (t0 + m0))
    y1 = larger(slope[1], abs(g[1])) * (0.5 + 0.5 * (t1 + m1))
    y2 = larger(slope[2], abs(g[2])) * (0.5 + 0.5 * (t2 + m2))
    double = 2.0 * reaction * squares[3]
    turn = (reciprocals[0] * reciprocals[0], reciprocals[1] * reciprocals[1], reciprocals[2] * reciprocals[2])
    r0 = larger(double * g[0], 0.0) * turn[0] * turn[0]
    r1 = larger(double * g[1], 0.0) * turn[1] * turn[1]
    r2 = larger(double * g[2], 0.0) * turn[2] * turn[2]
    z0, z1, z2 = reaction * y0, reaction * y1, reaction * y2
    return (
        kv + kw + y0 + t1 * z1 + m2 * z2 + r1 + r2,
        kw + ku + y1 + t2 * z2 + m0 * z0 + r2 + r0,
        ku + kv + y2 + t0 * z0 + m1 * z1 + r0 + r1,
    )


@kernel(inline=True)
def collect_corners(x, springs, corner, first, count):
    """Copy the corners of `count` triangles into the block's work space."""
    for q in range(count):
        i = first + q
        copy3(corner, 3 * q, x, 3 * np.intp(load(springs.a, i)))
        copy3(corner, 3 * (BLOCK + q), x, 3 * np.intp(load(springs.b, i)))
        copy3(corner, 3 * (2 * BLOCK + q), x, 3 * np.intp(load(springs.c, i)))


@kernel(inline=True)
def growth_energy(s, stiffness, alpha, s0, smooth):
    """Return the energy of one spring of Eq. 1: k s0^2 / (2 (alpha + 1)) ((1 + q)^(alpha + 1) - 1) [mN mm]."""
    q = (s / s0) ** 2
    if smooth:
        c1, c2, c3 = binomials(alpha)
        return 0.5 * stiffness * s * s * (1.0 + q * (c1 / 2.0 + q * (c2 / 3.0 + q * (c3 / 4.0))))
    return 0.5 * stiffness * s0 * s0 * math.expm1((alpha + 1.0) * math.log1p(q)) / (alpha + 1.0)


@kernel(inline=True)
def repulsion_energy(h, rest, repulsion, beta):
    """Return zeta (h - d) + zeta d / (beta - 1) ((d / h)^(beta - 1) - 1), for beta = 1 the limit [mN mm]."""
    s = h - rest
    if beta == 2.0:
        return repulsion * s * s / h
    stretch = math.log1p(s / rest)
    if beta == 1.0:
        return repulsion * (s - rest * stretch)
    return repulsion * (s + rest * math.expm1((1.0 - beta) * stretch) / (beta - 1.0))
