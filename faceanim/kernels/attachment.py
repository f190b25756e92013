"""Hypodermis: springs from skin vertices to anchors that the bones carry (see `body.Attachment`).

Energy of one tether of length s: k s0^2 / (2 (alpha + 1)) [(1 + (s/s0)^2)^(alpha + 1) - 1]; force and tangent are its
first and second derivatives. The shear layer couples the displacements u = x - anchor of neighbours i, j with the
energy w/2 d^2 + b/4 d^4 per edge, d = |u_i - u_j|: convex, and ever stiffer the more the skin would fold.
All kernels add to what `force` (n, 4) (three components and a stiffness bound) holds.
"""

from __future__ import annotations

import math

import numpy as np

from faceanim.ground.jit import kernel
from faceanim.kernels.linalg3 import add_identity, add_outer
from faceanim.kernels.memory import load


@kernel
def carry(tethers, pose, anchor):
    """Write where the bones of `pose` (n_bone, 4, 4) carry each vertex's rest position into `anchor` (n, 3) [mm]."""
    rest = tethers.rest
    for i in range(len(rest)):
        x = rest[i, 0]
        y = rest[i, 1]
        z = rest[i, 2]
        ax = 0.0
        ay = 0.0
        az = 0.0
        for b in range(pose.shape[0]):
            w = tethers.bone_weight[i, b]
            if w != 0.0:
                ax += w * (pose[b, 0, 0] * x + pose[b, 0, 1] * y + pose[b, 0, 2] * z + pose[b, 0, 3])
                ay += w * (pose[b, 1, 0] * x + pose[b, 1, 1] * y + pose[b, 1, 2] * z + pose[b, 1, 3])
                az += w * (pose[b, 2, 0] * x + pose[b, 2, 1] * y + pose[b, 2, 2] * z + pose[b, 2, 3])
        anchor[i, 0] = ax
        anchor[i, 1] = ay
        anchor[i, 2] = az


@kernel(inline=True)
def growth(q, alpha):
    """Return (1 + q)^alpha and its tangent form (1 + q)^(alpha - 1) (1 + (2 alpha + 1) q)."""
    if alpha == 1.0:
        return 1.0 + q, 1.0 + 3.0 * q
    if alpha == 0.0:
        return 1.0, 1.0
    p = 1.0 / math.sqrt(1.0 + q) if alpha == 0.5 else (1.0 + q) ** (alpha - 1.0)
    return p * (1.0 + q), p * (1.0 + (2.0 * alpha + 1.0) * q)


@kernel(inline=True)
def tether_pull(shift, i, tethers):
    """Return the force of the tether on vertex `i`, without the shear layer; shift : (n, 3) positions minus anchors."""
    dx = load(shift, 3 * i)
    dy = load(shift, 3 * i + 1)
    dz = load(shift, 3 * i + 2)
    q = (dx * dx + dy * dy + dz * dz) / (tethers.s0 * tethers.s0)
    secant, _ = growth(q, tethers.alpha)
    secant *= tethers.stiffness[i]
    return -secant * dx, -secant * dy, -secant * dz


@kernel(inline=True)
def tie(shift, i, tethers):
    """Return the force of tether and shear layer on vertex `i`, its bound of the stiffness and the tether's secant one.

    shift : (n, 3) positions minus anchors
    """
    dx = load(shift, 3 * i)
    dy = load(shift, 3 * i + 1)
    dz = load(shift, 3 * i + 2)
    q = (dx * dx + dy * dy + dz * dz) / (tethers.s0 * tethers.s0)
    secant, tangent = growth(q, tethers.alpha)
    secant *= tethers.stiffness[i]
    fx = -secant * dx
    fy = -secant * dy
    fz = -secant * dz
    bound = tethers.stiffness[i] * tangent
    for e in range(tethers.start[i], tethers.start[i + 1]):
        j = 3 * np.intp(load(tethers.neighbour, e))
        ux = dx - load(shift, j)
        uy = dy - load(shift, j + 1)
        uz = dz - load(shift, j + 2)
        growing = load(tethers.shear_growth, e) * (ux * ux + uy * uy + uz * uz)
        w = load(tethers.shear, e) + growing
        fx -= w * ux
        fy -= w * uy
        fz -= w * uz
        secant += w
        bound += w + 2.0 * growing
    return fx, fy, fz, bound, secant


@kernel
def find_shift(x, anchor, shift):
    """Write `x` minus `anchor` into `shift`, all (n, 3)."""
    for i in range(len(x)):
        for d in range(3):
            shift[i, d] = x[i, d] - anchor[i, d]


@kernel
def tether_force(shift, tethers, m, force):
    """Add the force on the first `m` vertices and the tangent stiffness along the tether to `force` (n, 4)."""
    for i in range(m):
        fx, fy, fz, k, _ = tie(shift, i, tethers)
        force[i, 0] += fx
        force[i, 1] += fy
        force[i, 2] += fz
        force[i, 3] += k


@kernel
def tether_energy(x, anchor, tethers, m):
    """Return the energy of the first `m` tethers and of the shear layer between their vertices and the rest [uJ]."""
    per = 1.0 / (tethers.s0 * tethers.s0)
    alpha = tethers.alpha
    total = 0.0
    for i in range(m):
        dx = x[i, 0] - anchor[i, 0]
        dy = x[i, 1] - anchor[i, 1]
        dz = x[i, 2] - anchor[i, 2]
        q = (dx * dx + dy * dy + dz * dz) * per
        if alpha == 1.0:
            total += tethers.stiffness[i] * q * (0.5 + 0.25 * q)
        else:
            total += tethers.stiffness[i] * ((1.0 + q) ** (alpha + 1.0) - 1.0) / (2.0 * (alpha + 1.0))
    total /= per
    for i in range(m):
        for e in range(tethers.start[i], tethers.start[i + 1]):
            j = tethers.neighbour[e]
            square = 0.0
            for d in range(3):
                square += (x[i, d] - anchor[i, d] - x[j, d] + anchor[j, d]) ** 2
            share = 0.5 if j < m else 1.0
            total += share * square * (0.5 * tethers.shear[e] + 0.25 * tethers.shear_growth[e] * square)
    return total


@kernel
def shear_coupling(x, anchor, pairs, shear, growth, coupling):
    """Add the shear layer's part of the Hessian, -(w + b d^2) I - 2 b u u^T, to the blocks `coupling` (e, 9) of `pairs`."""
    for e in range(len(pairs)):
        i, j = pairs[e]
        u = (
            x[i, 0] - anchor[i, 0] - x[j, 0] + anchor[j, 0],
            x[i, 1] - anchor[i, 1] - x[j, 1] + anchor[j, 1],
            x[i, 2] - anchor[i, 2] - x[j, 2] + anchor[j, 2],
        )
        even = shear[e] + growth[e] * (u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
        for r in range(3):
            coupling[e, 4 * r] -= even
            for c in range(3):
                coupling[e, 3 * r + c] -= 2.0 * growth[e] * u[r] * u[c]


@kernel
def tether_blocks(x, anchor, tethers, m, block):
    """Add the Hessian of the first `m` tethers and their shear layer, both positive, to the symmetric `block` (n, 6)."""
    per = 1.0 / (tethers.s0 * tethers.s0)
    for i in range(m):
        for e in range(tethers.start[i], tethers.start[i + 1]):
            j = tethers.neighbour[e]
            ux = x[i, 0] - anchor[i, 0] - x[j, 0] + anchor[j, 0]
            uy = x[i, 1] - anchor[i, 1] - x[j, 1] + anchor[j, 1]
            uz = x[i, 2] - anchor[i, 2] - x[j, 2] + anchor[j, 2]
            grow = tethers.shear_growth[e]
            add_identity(block, i, tethers.shear[e] + grow * (ux * ux + uy * uy + uz * uz))
            add_outer(block, i, 2.0 * grow, ux, uy, uz)
        k = tethers.stiffness[i]
        if k > 0.0:
            dx = x[i, 0] - anchor[i, 0]
            dy = x[i, 1] - anchor[i, 1]
            dz = x[i, 2] - anchor[i, 2]
            r2 = dx * dx + dy * dy + dz * dz
            secant, tangent = growth(r2 * per, tethers.alpha)
            add_identity(block, i, k * secant)
            if r2 > 0.0:
                add_outer(block, i, k * (tangent - secant) / r2, dx, dy, dz)
