"""Muscle fibres (see `body.Muscles`): pulls towards a point, or along a direction, both with an energy.

PULL_TO_POINT : energy F sqrt(|d|^2 + eps^2), d = target - x      PULL_ALONG : energy -F target . x
"""

from __future__ import annotations

import math

from faceanim.ground.jit import kernel
from faceanim.kernels.linalg3 import add_identity, add_outer


@kernel(inline=True)
def turned(fibres, e, pose):
    """Return the point or direction of fibre `e`, turned as its bone is."""
    b = fibres.bone[e]
    x = fibres.point[e, 0]
    y = fibres.point[e, 1]
    z = fibres.point[e, 2]
    return (
        pose[b, 0, 0] * x + pose[b, 0, 1] * y + pose[b, 0, 2] * z,
        pose[b, 1, 0] * x + pose[b, 1, 1] * y + pose[b, 1, 2] * z,
        pose[b, 2, 0] * x + pose[b, 2, 1] * y + pose[b, 2, 2] * z,
    )


@kernel
def aim(fibres, activation, pose, moment):
    """Pack the fibres of the acting muscles into `moment`, with their points and directions in the head frame."""
    count = 0
    for i in range(len(moment.first) - 1):
        moment.first[i] = count
        for e in range(fibres.start[i], fibres.start[i + 1]):
            active = activation[fibres.muscle[e]]
            if active == 0.0:
                continue
            b = fibres.bone[e]
            aims = fibres.kind[e] == 0
            tx, ty, tz = turned(fibres, e, pose)
            moment.target[count, 0] = tx + pose[b, 0, 3] if aims else tx
            moment.target[count, 1] = ty + pose[b, 1, 3] if aims else ty
            moment.target[count, 2] = tz + pose[b, 2, 3] if aims else tz
            moment.pull[count] = active * fibres.strength[e]
            moment.softening[count] = fibres.softening[e] if aims else -1.0
            count += 1
    moment.first[len(moment.first) - 1] = count


@kernel(inline=True)
def pull_of(e, px, py, pz, moment):
    """Return the force of packed fibre `e` on a vertex at (px, py, pz), and its transverse stiffness F / r."""
    dx = moment.target[e, 0]
    dy = moment.target[e, 1]
    dz = moment.target[e, 2]
    f = moment.pull[e]
    k = 0.0
    eps = moment.softening[e]
    if eps >= 0.0:
        dx -= px
        dy -= py
        dz -= pz
        f /= math.sqrt(dx * dx + dy * dy + dz * dz + eps * eps)
        k = f
    return f * dx, f * dy, f * dz, k


@kernel
def fibre_force(x, moment, m, force):
    """Add the pulls on the first `m` vertices to `force` (n, 4), with F / sqrt(d^2 + eps^2) as their stiffness."""
    for i in range(m):
        for e in range(moment.first[i], moment.first[i + 1]):
            fx, fy, fz, k = pull_of(e, x[i, 0], x[i, 1], x[i, 2], moment)
            force[i, 0] += fx
            force[i, 1] += fy
            force[i, 2] += fz
            force[i, 3] += k


@kernel
def pull(fibres, activation, pose, x, force):
    """Add the pulls of all acting muscles on the vertices `x` (n, 3) to `force` (n, 3), without packing them first."""
    for i in range(len(x)):
        for e in range(fibres.start[i], fibres.start[i + 1]):
            active = activation[fibres.muscle[e]]
            if active == 0.0:
                continue
            dx, dy, dz = turned(fibres, e, pose)
            f = active * fibres.strength[e]
            if fibres.kind[e] == 0:
                b = fibres.bone[e]
                eps = fibres.softening[e]
                dx += pose[b, 0, 3] - x[i, 0]
                dy += pose[b, 1, 3] - x[i, 1]
                dz += pose[b, 2, 3] - x[i, 2]
                f /= math.sqrt(dx * dx + dy * dy + dz * dz + eps * eps)
            force[i, 0] += f * dx
            force[i, 1] += f * dy
            force[i, 2] += f * dz


@kernel
def pull_energy(fibres, activation, pose, x):
    """Return the energy of what `pull` does to the vertices `x` (n, 3) [uJ]."""
    total = 0.0
    for i in range(len(x)):
        for e in range(fibres.start[i], fibres.start[i + 1]):
            dx, dy, dz = turned(fibres, e, pose)
            f = activation[fibres.muscle[e]] * fibres.strength[e]
            if fibres.kind[e] == 0:
                b = fibres.bone[e]
                eps = fibres.softening[e]
                dx += pose[b, 0, 3] - x[i, 0]
                dy += pose[b, 1, 3] - x[i, 1]
                dz += pose[b, 2, 3] - x[i, 2]
                total += f * math.sqrt(dx * dx + dy * dy + dz * dz + eps * eps)
            else:
                total -= f * (dx * x[i, 0] + dy * x[i, 1] + dz * x[i, 2])
    return total


@kernel
def fibre_energy(x, moment, m):
    """Return the energy of the pulls on the first `m` vertices [uJ]."""
    total = 0.0
    for i in range(m):
        for e in range(moment.first[i], moment.first[i + 1]):
            dx = moment.target[e, 0]
            dy = moment.target[e, 1]
            dz = moment.target[e, 2]
            eps = moment.softening[e]
            if eps >= 0.0:
                dx -= x[i, 0]
                dy -= x[i, 1]
                dz -= x[i, 2]
                total += moment.pull[e] * math.sqrt(dx * dx + dy * dy + dz * dz + eps * eps)
            else:
                total -= moment.pull[e] * (dx * x[i, 0] + dy * x[i, 1] + dz * x[i, 2])
    return total


@kernel
def fibre_blocks(x, moment, m, block):
    """Add the Hessian of the pulls on the first `m` vertices, F (I - d d^T / r^2) / r, to the symmetric `block` (n, 6)."""
    for i in range(m):
        for e in range(moment.first[i], moment.first[i + 1]):
            eps = moment.softening[e]
            if eps >= 0.0:
                dx = moment.target[e, 0] - x[i, 0]
                dy = moment.target[e, 1] - x[i, 1]
                dz = moment.target[e, 2] - x[i, 2]
                r2 = dx * dx + dy * dy + dz * dz + eps * eps
                s = moment.pull[e] / math.sqrt(r2)
                add_identity(block, i, s)
                add_outer(block, i, -s / r2, dx, dy, dz)
