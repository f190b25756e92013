"""Flat triangular shells at large rotations: a constant-strain membrane, discrete-Kirchhoff bending, a little drilling.

Each triangle has a frame E = (e1, e2, n) that turns with it: n is its normal, and F = (e1, e2) U is the polar
decomposition of the gradient of its mid-surface, f1 and f2 the columns of F. With t^2 = tr C + 2 J, J = |f1 x f2|:

    e1 = (f1 + f2 x n) / t,   e2 = (f2 - f1 x n) / t

Node a has turned from rest by R_a; relative to the triangle by Q = E^T R_a E0. Its director d = Q e3 is tilted by the
angle alpha; the numbers q = (g d1, g d2, (Q21 - Q12) / 2), g = alpha / sin alpha, are the two rotations of the Kirchhoff
triangle and the drilling rotation. The energy is w(C) h A + q^T K q / 2 with a constant K: nothing but the turning is
nonlinear in bending, and rigid motions are free at any angle.

A node's mid-surface point is carried at an arm: x_a = X_a + R_a arm. Derivatives are taken first in the frame, by the
entries A (3, 2) of E^T dF and the spins p_a = E^T (turn of node a), 15 numbers in all; then by the 18 freedoms.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faceanim.ground.jit import kernel, prange
from faceanim.kernels.hyperelastic import make_definite
from faceanim.kernels.membrane import membrane_curvatures, membrane_energy, membrane_slopes
from faceanim.kernels.rotations import add_spin_curvature, turn

F8 = NDArray[np.float64]
I4 = NDArray[np.int32]

SERIES = np.cumprod([1.0] + [k / (2.0 * k + 1.0) for k in range(1, 24)])
"""alpha / sin alpha = sum of k! / (2k + 1)!! (1 - cos alpha)^k; the terms kept reach round-off where it is used."""


class Panels(NamedTuple):
    """t triangles over m nodes.

    node : (t, 3)   slope : (t, 3, 2) in-plane gradients of the shape functions at rest [1/mm]
    frame : (t, 3, 3) columns e1, e2, n at rest   measure : (t,) h A [mm^3]   law : (t,)   constant : (t, 4) [kPa]
    bending : (t, 9, 9) K over (q of node 0, 1, 2) [mN mm]
    """

    node: I4
    slope: F8
    frame: F8
    measure: F8
    law: I4
    constant: F8
    bending: F8


class Turned(NamedTuple):
    """Where the m nodes are.

    own : (m, 3, 3) exp(theta)   rotation : (m, 3, 3) from rest   spin : (m, 3, 3) T   arm : (m, 3) turned offset [mm]
    middle : (m, 3) points of the mid-surface [mm]
    """

    own: F8
    rotation: F8
    spin: F8
    arm: F8
    middle: F8


class Room(NamedTuple):
    """Working room of b batches of triangles.

    F : (b, 3, 2)   E : (b, 3, 3)   U : (b, 3) entries 11, 12, 22   Q, L : (b, 3, 3, 3)   q, moment : (b, 9)
    W : (b, 3, 6)   near : (b, 9, 9)   slope : (b, 15)   bend : (b, 15, 15)   map, half : (b, 15, 18)
    vectors, values : (b, 18, 18)
    """

    F: F8
    E: F8
    U: F8
    Q: F8
    L: F8
    q: F8
    moment: F8
    W: F8
    near: F8
    slope: F8
    bend: F8
    map: F8
    half: F8
    vectors: F8
    values: F8


@kernel(parallel=True)
def turn_nodes(x, reference, offset, turned):
    """Fill `turned` for `x` (2m, 3): positions, then rotation vectors on top of `reference` (m, 3, 3)."""
    for a in prange(len(offset)):
        _turn_node(a, x, reference, offset, turned)


@kernel
def _turn_node(a, x, reference, offset, turned):
    """Fill the rows of node `a`."""
    own = turned.own[a]
    R = turned.rotation[a]
    turn(x[len(offset) + a], own, turned.spin[a])
    for i in range(3):
        for j in range(3):
            R[i, j] = own[i, 0] * reference[a, 0, j] + own[i, 1] * reference[a, 1, j] + own[i, 2] * reference[a, 2, j]
    for i in range(3):
        turned.arm[a, i] = R[i, 0] * offset[a, 0] + R[i, 1] * offset[a, 1] + R[i, 2] * offset[a, 2]
        turned.middle[a, i] = x[a, i] + turned.arm[a, i]


@kernel(parallel=True)
def energies(panels, turned, room, out):
    """Write each triangle's energy [uJ] into `out` (t,), infinite where it has none."""
    t = len(out)
    batches = len(room.F)
    for k in prange(batches):
        for e in range(k * t // batches, (k + 1) * t // batches):
            out[e] = _energy(panels, e, turned, room, k)


@kernel(parallel=True)
def forces(panels, turned, room, out):
    """Write minus the gradient of each triangle's energy into `out` (t, 6, 3): forces [mN], then moments [mN mm]."""
    t = len(out)
    batches = len(room.F)
    for k in prange(batches):
        for e in range(k * t // batches, (k + 1) * t // batches):
            _forces(panels, e, turned, room, k, out[e])


@kernel
def _forces(panels, e, turned, room, k, out):
    """Write minus the gradient of the energy of triangle `e`, nan where it has no area, into `out` (6, 3)."""
    J = _place(panels, e, turned.middle, room.F[k], room.E[k], room.U[k])
    if not J > 0.0:
        out[:] = math.nan
        return
    _relative(panels, e, turned.rotation, room, k)
    _slope(panels, e, J, room, k)
    _pull_back(panels, e, turned, room, k, out)


@kernel(parallel=True)
def stiffnesses(panels, x, turned, definite, room, out):
    """Write the Hessian of each triangle's energy into `out` (t, 18, 18), symmetric.

    definite : with its negative eigenvalues raised to zero
    """
    t = len(out)
    batches = len(room.F)
    for k in prange(batches):
        for e in range(k * t // batches, (k + 1) * t // batches):
            _stiffness(panels, e, x, turned, room, k, out[e])
            if definite and out[e, 0, 0] == out[e, 0, 0] and not _is_definite(out[e], room.vectors[k]):
                make_definite(out[e], room.vectors[k], room.values[k], 0.0)


@kernel
def _stiffness(panels, e, x, turned, room, k, out):
    """Write the Hessian of the energy of triangle `e`, nan where it has no area, into `out` (18, 18)."""
    J = _place(panels, e, turned.middle, room.F[k], room.E[k], room.U[k])
    if not J > 0.0:
        out[:] = math.nan
        return
    _relative(panels, e, turned.rotation, room, k)
    _slope(panels, e, J, room, k)
    _bend(panels, e, J, room, k)
    _transform(panels, e, x, turned, room, k, out)


@kernel(parallel=True)
def stretches(panels, turned, room, ratio, largest):
    """Write each triangle's area over its area at rest and its largest in-plane stretch into (t,) each."""
    t = len(ratio)
    batches = len(room.F)
    for k in prange(batches):
        for e in range(k * t // batches, (k + 1) * t // batches):
            ratio[e] = _place(panels, e, turned.middle, room.F[k], room.E[k], room.U[k])
            largest[e] = _largest(room.U[k])


@kernel
def _largest(U):
    """Return the larger eigenvalue of U."""
    return 0.5 * (U[0] + U[2]) + math.sqrt((0.5 * (U[0] - U[2])) ** 2 + U[1] * U[1])


@kernel
def _place(panels, e, middle, F, E, U):
    """Write F, E and U of triangle `e`, nan where it has no area; return J, its area over that at rest."""
    for i in range(3):
        for j in range(2):
            F[i, j] = 0.0
        for a in range(3):
            F[i, 0] += middle[panels.node[e, a], i] * panels.slope[e, a, 0]
            F[i, 1] += middle[panels.node[e, a], i] * panels.slope[e, a, 1]
    n0 = F[1, 0] * F[2, 1] - F[2, 0] * F[1, 1]
    n1 = F[2, 0] * F[0, 1] - F[0, 0] * F[2, 1]
    n2 = F[0, 0] * F[1, 1] - F[1, 0] * F[0, 1]
    J = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if not J > 0.0:
        E[:] = math.nan
        U[:] = math.nan
        return J
    E[0, 2] = n0 / J
    E[1, 2] = n1 / J
    E[2, 2] = n2 / J
    trace = 0.0
    for i in range(3):
        trace += F[i, 0] * F[i, 0] + F[i, 1] * F[i, 1]
    t = math.sqrt(trace + 2.0 * J)
    for i in range(3):
        k = (i + 1) % 3
        l = (i + 2) % 3
        E[i, 0] = (F[i, 0] + F[k, 1] * E[l, 2] - F[l, 1] * E[k, 2]) / t
        E[i, 1] = (F[i, 1] - F[k, 0] * E[l, 2] + F[l, 0] * E[k, 2]) / t
    for i in range(3):
        U[i] = 0.0
    for i in range(3):
        U[0] += E[i, 0] * F[i, 0]
        U[1] += 0.5 * (E[i, 0] * F[i, 1] + E[i, 1] * F[i, 0])
        U[2] += E[i, 1] * F[i, 1]
    return J


@kernel(inline=True)
def _excess(F):
    """Return tr (C - I) and det (C - I)."""
    first = F[0, 0] * F[0, 0] + F[1, 0] * F[1, 0] + F[2, 0] * F[2, 0] - 1.0
    second = F[0, 1] * F[0, 1] + F[1, 1] * F[1, 1] + F[2, 1] * F[2, 1] - 1.0
    mixed = F[0, 0] * F[0, 1] + F[1, 0] * F[1, 1] + F[2, 0] * F[2, 1]
    return first + second, first * second - mixed * mixed


@kernel
def tilt_factor(c):
    """Return g = alpha / sin alpha, dg/dc and d2g/dc2 at c = cos alpha > -1."""
    y = 1.0 - c
    if y < 0.3:
        g = 0.0
        g1 = 0.0
        g2 = 0.0
        for k in range(len(SERIES) - 1, -1, -1):
            g2 = g2 * y + g1
            g1 = g1 * y + g
            g = g * y + SERIES[k]
        return g, -g1, 2.0 * g2
    square = max((1.0 - c) * (1.0 + c), 1e-300)
    sine = math.sqrt(square)
    g = math.acos(max(c, -1.0)) / sine
    g1 = (c * g - 1.0) / square
    return g, g1, (g + 3.0 * c * g1) / square


@kernel
def _relative(panels, e, rotation, room, k):
    """Write Q of each node, q, and the moments K q."""
    E = room.E[k]
    q = room.q[k]
    for a in range(3):
        R = rotation[panels.node[e, a]]
        Q = room.Q[k, a]
        for i in range(3):
            v0 = E[0, i] * R[0, 0] + E[1, i] * R[1, 0] + E[2, i] * R[2, 0]
            v1 = E[0, i] * R[0, 1] + E[1, i] * R[1, 1] + E[2, i] * R[2, 1]
            v2 = E[0, i] * R[0, 2] + E[1, i] * R[1, 2] + E[2, i] * R[2, 2]
            for j in range(3):
                Q[i, j] = v0 * panels.frame[e, 0, j] + v1 * panels.frame[e, 1, j] + v2 * panels.frame[e, 2, j]
        g, _, _ = tilt_factor(Q[2, 2])
        q[3 * a] = g * Q[0, 2]
        q[3 * a + 1] = g * Q[1, 2]
        q[3 * a + 2] = 0.5 * (Q[1, 0] - Q[0, 1])
    for r in range(9):
        total = 0.0
        for s in range(9):
            total += panels.bending[e, r, s] * q[s]
        room.moment[k, r] = total


@kernel
def _energy(panels, e, turned, room, k):
    """Return the energy of triangle `e` [uJ]."""
    J = _place(panels, e, turned.middle, room.F[k], room.E[k], room.U[k])
    if not J > 0.0:
        return math.inf
    x, z = _excess(room.F[k])
    total = panels.measure[e] * membrane_energy(panels.law[e], x, z, panels.constant[e])
    _relative(panels, e, turned.rotation, room, k)
    for r in range(9):
        total += 0.5 * room.moment[k, r] * room.q[k, r]
    return total


@kernel
def _spin_slopes(Q, L):
    """Write dq/drho (3, 3) of one node, rho the spin of Q in the triangle's frame."""
    s1 = Q[0, 2]
    s2 = Q[1, 2]
    c = Q[2, 2]
    g, g1, _ = tilt_factor(c)
    L[0, 0] = g1 * s1 * s2
    L[0, 1] = g * c - g1 * s1 * s1
    L[0, 2] = -g * s2
    L[1, 0] = g1 * s2 * s2 - g * c
    L[1, 1] = -g1 * s1 * s2
    L[1, 2] = g * s1
    L[2, 0] = -0.5 * Q[2, 0]
    L[2, 1] = -0.5 * Q[2, 1]
    L[2, 2] = 0.5 * (Q[0, 0] + Q[1, 1])


@kernel
def _slope(panels, e, J, room, k):
    """Write the gradient by A (entry 2i + j) and the spins (6 + 3a + i) into `slope`; L and W too."""
    U = room.U[k]
    W = room.W[k]
    g = room.slope[k]
    x, z = _excess(room.F[k])
    wT, wD = membrane_slopes(panels.law[e], x, z, panels.constant[e])
    h = 2.0 * panels.measure[e]
    g[0] = h * (wT * U[0] + wD * J * U[2])
    g[1] = h * (wT - wD * J) * U[1]
    g[2] = g[1]
    g[3] = h * (wT * U[2] + wD * J * U[0])
    _frame_spin(U, J, W)
    s0 = 0.0
    s1 = 0.0
    s2 = 0.0
    for a in range(3):
        L = room.L[k, a]
        _spin_slopes(room.Q[k, a], L)
        for i in range(3):
            g[6 + 3 * a + i] = (
                L[0, i] * room.moment[k, 3 * a]
                + L[1, i] * room.moment[k, 3 * a + 1]
                + L[2, i] * room.moment[k, 3 * a + 2]
            )
        s0 += g[6 + 3 * a]
        s1 += g[7 + 3 * a]
        s2 += g[8 + 3 * a]
    g[4] = 0.0
    g[5] = 0.0
    for c in range(6):
        g[c] -= W[0, c] * s0 + W[1, c] * s1 + W[2, c] * s2


@kernel
def _frame_spin(U, J, W):
    """Write W (3, 6): the spin of the frame for a change A of the gradient."""
    t = U[0] + U[2]
    for i in range(3):
        for c in range(6):
            W[i, c] = 0.0
    W[0, 4] = -U[1] / J
    W[0, 5] = U[0] / J
    W[1, 4] = -U[2] / J
    W[1, 5] = U[1] / J
    W[2, 1] = -1.0 / t
    W[2, 2] = 1.0 / t


@kernel
def _pull_back(panels, e, turned, room, k, out):
    """Write the forces (6, 3) from the gradient in the frame."""
    E = room.E[k]
    g = room.slope[k]
    for a in range(3):
        v = panels.node[e, a]
        f0 = panels.slope[e, a, 0] * g[0] + panels.slope[e, a, 1] * g[1]
        f1 = panels.slope[e, a, 0] * g[2] + panels.slope[e, a, 1] * g[3]
        f2 = panels.slope[e, a, 0] * g[4] + panels.slope[e, a, 1] * g[5]
        for i in range(3):
            out[a, i] = -(E[i, 0] * f0 + E[i, 1] * f1 + E[i, 2] * f2)
        m0, m1, m2 = _moment(E, g, a)
        r = turned.arm[v]
        m0 += r[2] * out[a, 1] - r[1] * out[a, 2]
        m1 += r[0] * out[a, 2] - r[2] * out[a, 0]
        m2 += r[1] * out[a, 0] - r[0] * out[a, 1]
        T = turned.spin[v]
        for i in range(3):
            out[3 + a, i] = -(T[0, i] * m0 + T[1, i] * m1 + T[2, i] * m2)


@kernel(inline=True)
def _moment(E, g, a):
    """Return the gradient by the spin of node `a` along the fixed axes, without that of its arm."""
    u = g[6 + 3 * a]
    v = g[7 + 3 * a]
    w = g[8 + 3 * a]
    return (
        E[0, 0] * u + E[0, 1] * v + E[0, 2] * w,
        E[1, 0] * u + E[1, 1] * v + E[1, 2] * w,
        E[2, 0] * u + E[2, 1] * v + E[2, 2] * w,
    )


@kernel
def _bend(panels, e, J, room, k):
    """Write the second derivatives by A and the spins into `bend` (15, 15)."""
    H = room.bend[k]
    for r in range(15):
        for s in range(15):
            H[r, s] = 0.0
    _add_membrane(panels, e, J, room.F[k], room.U[k], H)
    _near(panels, e, room, k)
    near = room.near[k]
    W = room.W[k]
    for r in range(9):
        for s in range(9):
            H[6 + r, 6 + s] = near[r, s]
    for c in range(6):
        for s in range(9):
            total = 0.0
            for a in range(3):
                for i in range(3):
                    total += W[i, c] * near[3 * a + i, s]
            H[c, 6 + s] -= total
    for c in range(6):
        for d in range(6):
            # H[c, 6 + s] = -W^T near, before what the frame's second derivative adds to it
            for a in range(3):
                for i in range(3):
                    H[c, d] -= H[c, 6 + 3 * a + i] * W[i, d]
    _add_frame(room.U[k], J, room.slope[k], H)
    for c in range(6):
        for s in range(9):
            H[6 + s, c] = H[c, 6 + s]


@kernel
def _add_membrane(panels, e, J, F, U, H):
    """Add the second derivatives of h A w(T, D) by A to `H`."""
    x, z = _excess(F)
    law = panels.law[e]
    h = panels.measure[e]
    wT, wD = membrane_slopes(law, x, z, panels.constant[e])
    wTT, wTD, wDD = membrane_curvatures(law, x, z, panels.constant[e])
    T = (2.0 * U[0], 2.0 * U[1], 2.0 * U[1], 2.0 * U[2])
    D = (2.0 * J * U[2], -2.0 * J * U[1], -2.0 * J * U[1], 2.0 * J * U[0])
    # changes of C11, C22 and C12
    P = (2.0 * U[0], 0.0, 2.0 * U[1], 0.0)
    R = (0.0, 2.0 * U[1], 0.0, 2.0 * U[2])
    S = (U[1], U[0], U[2], U[1])
    for c in range(4):
        for d in range(4):
            H[c, d] += h * (
                wTT * T[c] * T[d]
                + wTD * (T[c] * D[d] + D[c] * T[d])
                + wDD * D[c] * D[d]
                + wD * (P[c] * R[d] + R[c] * P[d] - 2.0 * S[c] * S[d])
            )
    C11 = U[0] * U[0] + U[1] * U[1]
    C22 = U[1] * U[1] + U[2] * U[2]
    C12 = U[1] * (U[0] + U[2])
    for i in range(3):
        H[2 * i, 2 * i] += 2.0 * h * (wT + wD * C22)
        H[2 * i + 1, 2 * i + 1] += 2.0 * h * (wT + wD * C11)
        H[2 * i, 2 * i + 1] -= 2.0 * h * wD * C12
        H[2 * i + 1, 2 * i] -= 2.0 * h * wD * C12


@kernel
def _near(panels, e, room, k):
    """Write the second derivatives by the relative spins, L^T K L and the curvature of q, into `near` (9, 9)."""
    near = room.near[k]
    K = panels.bending[e]
    for a in range(3):
        La = room.L[k, a]
        for b in range(3):
            Lb = room.L[k, b]
            for i in range(3):
                v0 = La[0, i] * K[3 * a, 3 * b] + La[1, i] * K[3 * a + 1, 3 * b] + La[2, i] * K[3 * a + 2, 3 * b]
                v1 = (
                    La[0, i] * K[3 * a, 3 * b + 1]
                    + La[1, i] * K[3 * a + 1, 3 * b + 1]
                    + La[2, i] * K[3 * a + 2, 3 * b + 1]
                )
                v2 = (
                    La[0, i] * K[3 * a, 3 * b + 2]
                    + La[1, i] * K[3 * a + 1, 3 * b + 2]
                    + La[2, i] * K[3 * a + 2, 3 * b + 2]
                )
                for j in range(3):
                    near[3 * a + i, 3 * b + j] = v0 * Lb[0, j] + v1 * Lb[1, j] + v2 * Lb[2, j]
        m = room.moment[k]
        _add_curvature(room.Q[k, a], m[3 * a], m[3 * a + 1], m[3 * a + 2], near, 3 * a)


@kernel
def _add_curvature(Q, u, v, w, near, at):
    """Add the second derivative of u q1 + v q2 + w q3 by the spin of Q to the block of `near` at `at`."""
    s1 = Q[0, 2]
    s2 = Q[1, 2]
    c = Q[2, 2]
    g, g1, g2 = tilt_factor(c)
    along = u * s1 + v * s2
    # a linear function h . d of the director has h d^T + d h^T over 2, less (h . d) I
    _add_linear(g * u, g * v, g1 * along, s1, s2, c, near, at)
    _add_linear(0.0, 0.5 * w, 0.0, Q[0, 0], Q[1, 0], Q[2, 0], near, at)
    _add_linear(-0.5 * w, 0.0, 0.0, Q[0, 1], Q[1, 1], Q[2, 1], near, at)
    dc = (s2, -s1, 0.0)
    ds = (-v * c, u * c, v * s1 - u * s2)
    for i in range(3):
        for j in range(3):
            near[at + i, at + j] += g1 * (dc[i] * ds[j] + ds[i] * dc[j]) + g2 * along * dc[i] * dc[j]


@kernel
def _add_linear(a, b, c, x, y, z, out, at):
    """Add the second derivative of (a, b, c) . v by the spin of v = (x, y, z) to the block of `out` at `at`."""
    h = (a, b, c)
    v = (x, y, z)
    dot = a * x + b * y + c * z
    for i in range(3):
        for j in range(3):
            out[at + i, at + j] += 0.5 * (h[i] * v[j] + v[i] * h[j])
        out[at + i, at + i] -= dot


@kernel(inline=True)
def _both(H, r, s, value):
    """Add the second derivative of `value` times the product of two entries."""
    H[r, s] += value
    H[s, r] += value


@kernel
def _add_frame(U, J, g, H):
    """Add what the frame's turning to second order, and its order with the nodes' spins, give to the blocks of A.

    With m = -U^-1 a the tilt of the normal, a the last row of A, and phi = (A21 - A12) / t, the spin of Q is, for node a,
    p - (-m2, m1, phi) + (phi e3 x nu - phi e3 x p - nu x p) / 2 less second-order tilt and turn, nu = (-m2, m1, 0).
    """
    V = (U[2] / J, -U[1] / J, U[0] / J)
    t = U[0] + U[2]
    s0 = g[6] + g[9] + g[12]
    s1 = g[7] + g[10] + g[13]
    s2 = g[8] + g[11] + g[14]
    xi = (-V[0] * s1 + V[1] * s0, -V[1] * s1 + V[2] * s0)
    # m_i = M[i] . a
    M = ((-V[0], -V[1]), (-V[1], -V[2]))
    for j in range(2):
        for i in range(2):
            for c in range(2):
                _both(H, 2 * i + j, 4 + c, -xi[j] * M[i][c])
        # turn of second order, (m1 a2 - m2 a1) / 2 t
        _both(H, 5, 4 + j, -0.5 * s2 / t * M[0][j])
        _both(H, 4, 4 + j, 0.5 * s2 / t * M[1][j])
    p = 1.0 / t
    for c in (0, 3):
        _both(H, 2, c, s2 / t * p)
        _both(H, 1, c, -s2 / t * p)
    for j in range(2):
        value = -0.5 * p * (s0 * M[0][j] + s1 * M[1][j])
        _both(H, 2, 4 + j, value)
        _both(H, 1, 4 + j, -value)
    for a in range(3):
        at = 6 + 3 * a
        u = g[at]
        v = g[at + 1]
        w = g[at + 2]
        H[2, at] -= 0.5 * p * v
        H[1, at] += 0.5 * p * v
        H[2, at + 1] += 0.5 * p * u
        H[1, at + 1] -= 0.5 * p * u
        for j in range(2):
            H[4 + j, at + 2] -= 0.5 * (u * M[0][j] + v * M[1][j])
            H[4 + j, at + 1] += 0.5 * w * M[1][j]
            H[4 + j, at] += 0.5 * w * M[0][j]


@kernel
def _transform(panels, e, x, turned, room, k, out):
    """Write the stiffness (18, 18) over positions and rotation vectors from the one in the frame."""
    B = room.map[k]
    half = room.half[k]
    H = room.bend[k]
    _fill_map(panels, e, turned, room.E[k], B)
    for r in range(15):
        for s in range(18):
            total = 0.0
            for c in range(15):
                total += H[r, c] * B[c, s]
            half[r, s] = total
    for r in range(18):
        for s in range(18):
            out[r, s] = 0.0
    for c in range(15):
        for r in range(18):
            for s in range(18):
                out[r, s] += B[c, r] * half[c, s]
    for a in range(3):
        _add_turning(panels, e, a, x, turned, room, k, out)
    for r in range(18):
        for s in range(r):
            mean = 0.5 * (out[r, s] + out[s, r])
            out[r, s] = mean
            out[s, r] = mean


@kernel
def _fill_map(panels, e, turned, E, B):
    """Write the derivative of A and the spins by positions (columns 0..8) and rotation vectors (9..17), (15, 18)."""
    for r in range(15):
        for s in range(18):
            B[r, s] = 0.0
    for a in range(3):
        v = panels.node[e, a]
        T = turned.spin[v]
        r = turned.arm[v]
        for c in range(3):
            # a turn by column c of T moves the mid-surface by T x arm
            y0 = T[1, c] * r[2] - T[2, c] * r[1]
            y1 = T[2, c] * r[0] - T[0, c] * r[2]
            y2 = T[0, c] * r[1] - T[1, c] * r[0]
            for i in range(3):
                moved = E[0, i] * y0 + E[1, i] * y1 + E[2, i] * y2
                for j in range(2):
                    B[2 * i + j, 3 * a + c] = E[c, i] * panels.slope[e, a, j]
                    B[2 * i + j, 9 + 3 * a + c] = moved * panels.slope[e, a, j]
                B[6 + 3 * a + i, 9 + 3 * a + c] = E[0, i] * T[0, c] + E[1, i] * T[1, c] + E[2, i] * T[2, c]


@kernel
def _add_turning(panels, e, a, x, turned, room, k, out):
    """Add what the second derivatives of node `a`'s rotation and arm give to its block of `out`."""
    E = room.E[k]
    g = room.slope[k]
    v = panels.node[e, a]
    f0 = panels.slope[e, a, 0] * g[0] + panels.slope[e, a, 1] * g[1]
    f1 = panels.slope[e, a, 0] * g[2] + panels.slope[e, a, 1] * g[3]
    f2 = panels.slope[e, a, 0] * g[4] + panels.slope[e, a, 1] * g[5]
    f = (
        E[0, 0] * f0 + E[0, 1] * f1 + E[0, 2] * f2,
        E[1, 0] * f0 + E[1, 1] * f1 + E[1, 2] * f2,
        E[2, 0] * f0 + E[2, 1] * f1 + E[2, 2] * f2,
    )
    m0, m1, m2 = _moment(E, g, a)
    r = turned.arm[v]
    m0 += r[1] * f[2] - r[2] * f[1]
    m1 += r[2] * f[0] - r[0] * f[2]
    m2 += r[0] * f[1] - r[1] * f[0]
    block = out[9 + 3 * a : 12 + 3 * a, 9 + 3 * a : 12 + 3 * a]
    add_spin_curvature(x[len(turned.arm) + v], m0, m1, m2, block)
    _add_arm(turned.spin[v], r, f, block)


@kernel
def _add_arm(T, r, f, out):
    """Add T^T ((f r^T + r f^T) / 2 - (f . r) I) T to `out` (3, 3)."""
    dot = f[0] * r[0] + f[1] * r[1] + f[2] * r[2]
    for i in range(3):
        ri = T[0, i] * r[0] + T[1, i] * r[1] + T[2, i] * r[2]
        fi = T[0, i] * f[0] + T[1, i] * f[1] + T[2, i] * f[2]
        for j in range(3):
            rj = T[0, j] * r[0] + T[1, j] * r[1] + T[2, j] * r[2]
            fj = T[0, j] * f[0] + T[1, j] * f[1] + T[2, j] * f[2]
            both = T[0, i] * T[0, j] + T[1, i] * T[1, j] + T[2, i] * T[2, j]
            out[i, j] += 0.5 * (fi * rj + ri * fj) - dot * both


@kernel(parallel=True)
def arm_curvatures(x, turned, arm, force, out):
    """Write the second derivative of force . R arm by each node's rotation vector into `out` (m, 3, 3).

    arm, force : (m, 3), the arms as turned
    """
    for a in prange(len(arm)):
        _arm_curvature(x[len(arm) + a], turned.spin[a], arm[a], force[a], out[a])


@kernel
def _arm_curvature(theta, T, r, f, out):
    """Write the second derivative of f . R r0 by `theta`, r = R r0, into `out` (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
    m0 = r[1] * f[2] - r[2] * f[1]
    m1 = r[2] * f[0] - r[0] * f[2]
    m2 = r[0] * f[1] - r[1] * f[0]
    add_spin_curvature(theta, m0, m1, m2, out)
    _add_arm(T, r, f, out)


@kernel
def _is_definite(A, L):
    """Return whether `A` plus a little on its diagonal has a Cholesky factor; `L` (at least as large) is overwritten."""
    n = len(A)
    trace = 0.0
    for i in range(n):
        trace += abs(A[i, i])
    for j in range(n):
        pivot = A[j, j] + 1e-12 * trace
        for c in range(j):
            pivot -= L[j, c] * L[j, c]
        if not pivot > 0.0:
            return False
        root = math.sqrt(pivot)
        L[j, j] = root
        for i in range(j + 1, n):
            total = A[i, j]
            for c in range(j):
                total -= L[i, c] * L[j, c]
            L[i, j] = total / root
    return True
