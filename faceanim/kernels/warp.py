"""Modal warping (Choi & Ko 2005): local displacements and rotations from modal amplitudes, warped into the body frame.

A node with local displacement u and rotation vector w is displaced by Rt(w) u, the mean of exp(t [w]x) over t in 0..1
applied to u (Eq. 22, App. II):  Rt = I + A [w]x + B [w]x^2, A = (1 - cos th) / th^2, B = (1 - sin(th) / th) / th^2,
th = |w|. The end rotation is R = I + S [w]x + A [w]x^2, S = sin(th) / th.

Two layouts: rows (n, 6, columns) in float64 for the dynamics, and blocks (blocks, columns, 6, LANES) in float32 for
display, where A and B are polynomials in th^2, so that LANES nodes are warped at a time without sine or cosine.
"""

from __future__ import annotations

import math

import numpy as np

from faceanim.ground.jit import kernel, prange

LANES = 128
LINEAR, PAPER, CONSISTENT = 0, 1, 2
F = np.float32
TURN = F(39.4)
"""Squared rotation up to which the float32 polynomials hold, a little under (2 pi)^2."""


@kernel(inline=True)
def coefficients(s):
    """Return A, B and S of the rotation vector with squared length `s`."""
    if s < 1e-4:
        a = 0.5 - s / 24.0 + s * s / 720.0
        b = 1.0 / 6.0 - s / 120.0 + s * s / 5040.0
        return a, b, 1.0 - s * b
    th = math.sqrt(s)
    half = math.sin(0.5 * th)
    a = 2.0 * half * half / s
    sine = math.sin(th) / th
    return a, (1.0 - sine) / s, sine


@kernel(inline=True)
def slopes(s, a, b):
    """Return dA/ds and dB/ds at squared length `s`, where A = `a` and B = `b`."""
    if s < 1e-2:
        return (
            -1.0 / 24.0 + s / 360.0 - s * s / 13440.0 + s * s * s / 907200.0,
            -1.0 / 120.0 + s / 2520.0 - s * s / 120960.0 + s * s * s / 9979200.0,
        )
    th = math.sqrt(s)
    sine = math.sin(th) / th
    return 0.5 * (sine - 2.0 * a) / s, 0.5 * ((sine - math.cos(th)) / s - 2.0 * b) / s


@kernel(inline=True)
def turn(p, q, wx, wy, wz, x, y, z):
    """Return v + p w x v + q w x (w x v) for v = (x, y, z)."""
    cx = wy * z - wz * y
    cy = wz * x - wx * z
    cz = wx * y - wy * x
    return (
        x + p * cx + q * (wy * cz - wz * cy),
        y + p * cy + q * (wz * cx - wx * cz),
        z + p * cz + q * (wx * cy - wy * cx),
    )


@kernel
def local(basis, z, count, out):
    """Write local displacement and rotation, `out` (n, 6), of the first `count` amplitudes `z` on `basis` (n, 6, c)."""
    for i in range(len(basis)):
        for c in range(6):
            total = 0.0
            for k in range(count):
                total += basis[i, c, k] * z[k]
            out[i, c] = total


@kernel
def warp(rest, moved, warped, out):
    """Write the points rest + Rt(w) u of `moved` (n, 6) into `out` (n, 3); rest + u unless `warped`."""
    for i in range(len(rest)):
        x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
        if warped:
            wx, wy, wz = moved[i, 3], moved[i, 4], moved[i, 5]
            a, b, _ = coefficients(wx * wx + wy * wy + wz * wz)
            x, y, z = turn(a, b, wx, wy, wz, x, y, z)
        out[i, 0] = rest[i, 0] + x
        out[i, 1] = rest[i, 1] + y
        out[i, 2] = rest[i, 2] + z


@kernel(inline=True)
def torque(ux, uy, uz, wx, wy, wz, fx, fy, fz, a, b, da, db):
    """Return the derivative of f . Rt(w) u by w."""
    cx = uy * fz - uz * fy
    cy = uz * fx - ux * fz
    cz = ux * fy - uy * fx
    wc = wx * cx + wy * cy + wz * cz
    wu = wx * ux + wy * uy + wz * uz
    wf = wx * fx + wy * fy + wz * fz
    uf = ux * fx + uy * fy + uz * fz
    s = wx * wx + wy * wy + wz * wz
    along = 2.0 * da * wc + 2.0 * db * (wf * wu - s * uf) - 2.0 * b * uf
    return (
        a * cx + b * (fx * wu + ux * wf) + along * wx,
        a * cy + b * (fy * wu + uy * wf) + along * wy,
        a * cz + b * (fz * wu + uz * wf) + along * wz,
    )


@kernel
def project(basis, moved, force, kind, out):
    """Write the generalised force of nodal forces `force` (n, 3) into `out` (m,), the first m columns of `basis`.

    kind : LINEAR Phi^T F; PAPER (R Phi)^T F (Eq. 18); CONSISTENT J^T F with J the derivative of Rt(Psi q) Phi q
    """
    m = len(out)
    for k in range(m):
        out[k] = 0.0
    for i in range(len(force)):
        fx, fy, fz = force[i, 0], force[i, 1], force[i, 2]
        if fx == 0.0 and fy == 0.0 and fz == 0.0:
            continue
        if kind != LINEAR:
            wx, wy, wz = moved[i, 3], moved[i, 4], moved[i, 5]
            s = wx * wx + wy * wy + wz * wz
            a, b, sine = coefficients(s)
            if kind == CONSISTENT:
                da, db = slopes(s, a, b)
                tx, ty, tz = torque(
                    moved[i, 0], moved[i, 1], moved[i, 2], wx, wy, wz, fx, fy, fz, a, b, da, db
                )  # fmt: skip
                for k in range(m):
                    out[k] += basis[i, 3, k] * tx + basis[i, 4, k] * ty + basis[i, 5, k] * tz
                fx, fy, fz = turn(-a, b, wx, wy, wz, fx, fy, fz)
            else:
                fx, fy, fz = turn(-sine, a, wx, wy, wz, fx, fy, fz)
        for k in range(m):
            out[k] += basis[i, 0, k] * fx + basis[i, 1, k] * fy + basis[i, 2, k] * fz


@kernel
def coriolis(moved, rate, out):
    """Write R^T R' uL' of every node into `out` (n, 3): rotation `moved` (n, 6), rates uL', w' in `rate` (n, 6)."""
    for i in range(len(moved)):
        wx, wy, wz = moved[i, 3], moved[i, 4], moved[i, 5]
        a, b, _ = coefficients(wx * wx + wy * wy + wz * wz)
        # R^T R' = [Rt(-w) w']x
        x, y, z = turn(-a, b, wx, wy, wz, rate[i, 3], rate[i, 4], rate[i, 5])
        out[i, 0] = y * rate[i, 2] - z * rate[i, 1]
        out[i, 1] = z * rate[i, 0] - x * rate[i, 2]
        out[i, 2] = x * rate[i, 1] - y * rate[i, 0]


@kernel(inline=True)
def _gather(table, block, z, count, turn, acc):
    """Put the amplitudes' sum over one block into `acc` (6, LANES), four columns at a time; rotations times `turn`."""
    for c in range(6):
        for l in range(LANES):
            acc[c, l] = F(0.0)
    k = 0
    while k + 4 <= count:
        z0, z1, z2, z3 = z[k], z[k + 1], z[k + 2], z[k + 3]
        for c in range(6):
            for l in range(LANES):
                acc[c, l] += (
                    z0 * F(table[block, k, c, l])
                    + z1 * F(table[block, k + 1, c, l])
                    + z2 * F(table[block, k + 2, c, l])
                    + z3 * F(table[block, k + 3, c, l])
                )
        k += 4
    while k < count:
        z0 = z[k]
        for c in range(6):
            for l in range(LANES):
                acc[c, l] += z0 * F(table[block, k, c, l])
        k += 1
    for c in range(3, 6):
        for l in range(LANES):
            acc[c, l] *= turn


@kernel(inline=True)
def _turn_lanes(acc):
    """Replace the displacement of each lane of `acc` (6, LANES) by the warped one; A and B by Horner's rule."""
    for l in range(LANES):
        x, y, z = acc[0, l], acc[1, l], acc[2, l]
        wx, wy, wz = acc[3, l], acc[4, l], acc[5, l]
        s = wx * wx + wy * wy + wz * wz
        a = F(1.0 / 403291461126605635584000000.0)
        a = a * s - F(1.0 / 620448401733239439360000.0)
        a = a * s + F(1.0 / 1124000727777607680000.0)
        a = a * s - F(1.0 / 2432902008176640000.0)
        a = a * s + F(1.0 / 6402373705728000.0)
        a = a * s - F(1.0 / 20922789888000.0)
        a = a * s + F(1.0 / 87178291200.0)
        a = a * s - F(1.0 / 479001600.0)
        a = a * s + F(1.0 / 3628800.0)
        a = a * s - F(1.0 / 40320.0)
        a = a * s + F(1.0 / 720.0)
        a = a * s - F(1.0 / 24.0)
        a = a * s + F(0.5)
        b = F(1.0 / 10888869450418352160768000000.0)
        b = b * s - F(1.0 / 15511210043330985984000000.0)
        b = b * s + F(1.0 / 25852016738884976640000.0)
        b = b * s - F(1.0 / 51090942171709440000.0)
        b = b * s + F(1.0 / 121645100408832000.0)
        b = b * s - F(1.0 / 355687428096000.0)
        b = b * s + F(1.0 / 1307674368000.0)
        b = b * s - F(1.0 / 6227020800.0)
        b = b * s + F(1.0 / 39916800.0)
        b = b * s - F(1.0 / 362880.0)
        b = b * s + F(1.0 / 5040.0)
        b = b * s - F(1.0 / 120.0)
        b = b * s + F(1.0 / 6.0)
        cx = wy * z - wz * y
        cy = wz * x - wx * z
        cz = wx * y - wy * x
        acc[0, l] = x + a * cx + b * (wy * cz - wz * cy)
        acc[1, l] = y + a * cy + b * (wz * cx - wx * cz)
        acc[2, l] = z + a * cz + b * (wx * cy - wy * cx)


@kernel(inline=True)
def _turn_far(acc):
    """The same for rotations of a full turn and more, where the polynomials no longer hold."""
    for l in range(LANES):
        wx, wy, wz = float(acc[3, l]), float(acc[4, l]), float(acc[5, l])
        a, b, _ = coefficients(wx * wx + wy * wy + wz * wz)
        x, y, z = turn(a, b, wx, wy, wz, float(acc[0, l]), float(acc[1, l]), float(acc[2, l]))
        acc[0, l], acc[1, l], acc[2, l] = F(x), F(y), F(z)


@kernel(inline=True)
def _warp_block(rest, table, block, z, count, turn, acc, out):
    _gather(table, block, z, count, turn, acc)
    largest = F(0.0)
    for l in range(LANES):
        largest = max(largest, acc[3, l] * acc[3, l] + acc[4, l] * acc[4, l] + acc[5, l] * acc[5, l])
    if largest < TURN:
        _turn_lanes(acc)
    else:
        _turn_far(acc)
    first = block * LANES
    for l in range(min(LANES, len(out) - first)):
        out[first + l, 0] = rest[first + l, 0] + acc[0, l]
        out[first + l, 1] = rest[first + l, 1] + acc[1, l]
        out[first + l, 2] = rest[first + l, 2] + acc[2, l]


@kernel
def warp_blocks(rest, table, z, count, turn, scratch, out):
    """Write the warped points of all blocks into `out` (n, 3) float32.

    rest : (n, 3)   table : (blocks, columns, 6, LANES) float32 or int16   z : the first `count` amplitudes
    turn : factor on the rotations of the table   scratch : (1, 6, LANES)
    """
    for block in range(len(table)):
        _warp_block(rest, table, block, z, count, turn, scratch[0], out)


@kernel(parallel=True)
def warp_blocks_parallel(rest, table, z, count, turn, scratch, out):
    """Do the same with one thread for each layer of `scratch` (threads, 6, LANES); the same bytes come out."""
    threads = len(scratch)
    for t in prange(threads):
        for block in range(t * len(table) // threads, (t + 1) * len(table) // threads):
            _warp_block(rest, table, block, z, count, turn, scratch[t], out)


@kernel
def interpolate(node, weight, points, first, last, out):
    """Write vertices `first`..`last` as means of four nodes: `node`, `weight` (k, 4), `points` (n, 3), `out` (k, 3)."""
    for i in range(first, last):
        a, b, c, d = node[i, 0], node[i, 1], node[i, 2], node[i, 3]
        p, q, r, s = weight[i, 0], weight[i, 1], weight[i, 2], weight[i, 3]
        out[i, 0] = p * points[a, 0] + q * points[b, 0] + r * points[c, 0] + s * points[d, 0]
        out[i, 1] = p * points[a, 1] + q * points[b, 1] + r * points[c, 1] + s * points[d, 1]
        out[i, 2] = p * points[a, 2] + q * points[b, 2] + r * points[c, 2] + s * points[d, 2]


@kernel(parallel=True)
def interpolate_parallel(node, weight, points, threads, out):
    """Do the same for all vertices with `threads` threads."""
    for t in prange(threads):
        interpolate(node, weight, points, t * len(node) // threads, (t + 1) * len(node) // threads, out)
