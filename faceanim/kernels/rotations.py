"""Rotations by rotation vectors: the exponential map, the spin it gives, and its second derivative.

R(theta) = cos |theta| I + a [theta]x + b theta theta^T turns by |theta| about theta. A small change of theta turns by the
spin T(theta) dtheta in addition, T = a I + b [theta]x + c theta theta^T, with a = sin |theta| / |theta|,
b = (1 - cos |theta|) / |theta|^2 and c = (1 - a) / |theta|^2. T is singular at |theta| = 2 pi.
Cardona & Geradin, A beam finite element non-linear theory with finite rotations, 1988.
"""

from __future__ import annotations

import math

from faceanim.ground.jit import kernel

TERMS = 11
"""Terms of the series that is used below one radian; they reach round-off."""


@kernel
def coefficients(s):
    """Return a, b, c and 2 da/ds, 2 db/ds, 2 dc/ds at s = |theta|^2."""
    if s > 1.0:
        angle = math.sqrt(s)
        a = math.sin(angle) / angle
        cosine = math.cos(angle)
        b = (1.0 - cosine) / s
        c = (1.0 - a) / s
        a1 = (cosine - a) / s
        return a, b, c, a1, (a - 2.0 * b) / s, -(a1 + 2.0 * c) / s
    a = 0.0
    b = 0.0
    c = 0.0
    a1 = 0.0
    b1 = 0.0
    c1 = 0.0
    power = 1.0
    before = 0.0
    factorial = 1.0
    for k in range(TERMS):
        ta = 1.0 / factorial
        tb = ta / (2 * k + 2)
        tc = tb / (2 * k + 3)
        a += power * ta
        b += power * tb
        c += power * tc
        # d/ds of (-s)^k is -k (-s)^(k-1)
        a1 -= 2.0 * k * before * ta
        b1 -= 2.0 * k * before * tb
        c1 -= 2.0 * k * before * tc
        before = power
        power *= -s
        factorial *= (2 * k + 2) * (2 * k + 3)
    return a, b, c, a1, b1, c1


@kernel
def turn(theta, R, T):
    """Write the rotation R and the spin matrix T, (3, 3) each, of the rotation vector `theta` (3,)."""
    x = theta[0]
    y = theta[1]
    z = theta[2]
    s = x * x + y * y + z * z
    a, b, c, _, _, _ = coefficients(s)
    for i in range(3):
        for j in range(3):
            R[i, j] = b * theta[i] * theta[j]
            T[i, j] = c * theta[i] * theta[j]
        R[i, i] += 1.0 - b * s
        T[i, i] += a
    R[0, 1] -= a * z
    R[0, 2] += a * y
    R[1, 0] += a * z
    R[1, 2] -= a * x
    R[2, 0] -= a * y
    R[2, 1] += a * x
    T[0, 1] -= b * z
    T[0, 2] += b * y
    T[1, 0] += b * z
    T[1, 2] -= b * x
    T[2, 0] -= b * y
    T[2, 1] += b * x


@kernel
def add_spin_curvature(theta, x, y, z, out):
    """Add to `out` (3, 3) the symmetric part of d(T^T m)/dtheta for the moment m = (x, y, z)."""
    u = theta[0]
    v = theta[1]
    w = theta[2]
    _, _, c, a1, b1, c1 = coefficients(u * u + v * v + w * w)
    along = u * x + v * y + w * z
    left = (
        a1 * x - b1 * (v * z - w * y) + c * x + c1 * along * u,
        a1 * y - b1 * (w * x - u * z) + c * y + c1 * along * v,
        a1 * z - b1 * (u * y - v * x) + c * z + c1 * along * w,
    )
    for i in range(3):
        for j in range(3):
            out[i, j] += 0.5 * (left[i] * theta[j] + theta[i] * left[j])
        out[i, i] += c * along
