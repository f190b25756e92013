"""A lattice of springs, with hexahedra and ties in it, under explicit steps.

A tie pulls a weighted sum of nodes to a target: stiffness * (target - sum_a weight_a x_a), shared out by the weights,
so that forces and torques of the tie balance; it never divides by its length, which is zero at rest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faceanim.ground.jit import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


class LatticeSprings(NamedTuple):
    """Springs i-j (s,): stiffness [mN/mm], rest length and the lengths between which it is linear [mm].

    ramp : [-] factor on the stiffness outside `low`..`high`
    """

    i: Ints
    j: Ints
    stiffness: Floats
    rest: Floats
    low: Floats
    high: Floats
    ramp: float


class LatticeTies(NamedTuple):
    """Ties: node, weight (t, 9), unused ones with weight 0; stiffness (t,) [mN/mm]."""

    node: Ints
    weight: Floats
    stiffness: Floats


class LatticeSlaves(NamedTuple):
    """Nodes `node` (s,) that are the weighted sums of `master`[start:start + 1] with `weight`."""

    node: Ints
    start: Ints
    master: Ints
    weight: Floats


class LatticeHexes(NamedTuple):
    """Cubes that turn with their nodes: corner (c, 8), stiffness (c, 24, 24) [mN/mm], side (c,) [mm]."""

    corner: Ints
    stiffness: Floats
    side: Floats


class LatticeCells(NamedTuple):
    """The cubes whose volume is watched: corner (c, 8), side (c,) [mm]."""

    corner: Ints
    side: Floats


class LatticeBarrier(NamedTuple):
    """What keeps these cubes from turning inside out.

    A corner whose Jacobian J is below `least` has the energy `strength` (c,) [uJ] * (least - J)^2 / 2: none near rest,
    finite for an inverted one. near (c,): the first `listed[0]` are the cubes that `barrier_force` looks at, see `watch`
    """

    strength: Floats
    least: float
    near: Ints
    listed: Ints


class LatticeTables(NamedTuple):
    """All that acts on the nodes."""

    springs: LatticeSprings
    ties: LatticeTies
    slaves: LatticeSlaves
    hexes: LatticeHexes
    cells: LatticeCells
    barrier: LatticeBarrier


SIGNS = np.array(
    [[-1, -1, -1], [-1, -1, 1], [-1, 1, -1], [-1, 1, 1], [1, -1, -1], [1, -1, 1], [1, 1, -1], [1, 1, 1]],
    dtype=np.float64,
)
"""Where the corners of a cube lie, in half sides."""


@kernel(inline=True)
def spring_force(x, springs, force):
    """Add the forces of `springs` at `x` (n, 3) to `force` (n, 3)."""
    for e in range(len(springs.i)):
        i = np.uint64(springs.i[e])  # unsigned: no check for indices that count from the end
        j = np.uint64(springs.j[e])
        dx = x[j, 0] - x[i, 0]
        dy = x[j, 1] - x[i, 1]
        dz = x[j, 2] - x[i, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz + 1e-300)
        stretch = length - springs.rest[e]
        if length < springs.low[e]:
            stretch += (springs.ramp - 1.0) * (length - springs.low[e])
        elif length > springs.high[e]:
            stretch += (springs.ramp - 1.0) * (length - springs.high[e])
        f = springs.stiffness[e] * stretch / length
        force[i, 0] += f * dx
        force[i, 1] += f * dy
        force[i, 2] += f * dz
        force[j, 0] -= f * dx
        force[j, 1] -= f * dy
        force[j, 2] -= f * dz


@kernel
def spring_energy(x, springs):
    """Return the energy of `springs` [uJ]."""
    total = 0.0
    for e in range(len(springs.i)):
        i = springs.i[e]
        j = springs.j[e]
        dx = x[j, 0] - x[i, 0]
        dy = x[j, 1] - x[i, 1]
        dz = x[j, 2] - x[i, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        s = length - springs.rest[e]
        beyond = max(springs.low[e] - length, length - springs.high[e], 0.0)
        total += 0.5 * springs.stiffness[e] * (s * s + (springs.ramp - 1.0) * beyond * beyond)
    return total


@kernel
def spring_blocks(x, springs, floor, block):
    """Write the Hessian block of every spring into `block` (s, 3, 3): k' n n^T + max(f / l, floor k) (I - n n^T)."""
    for e in range(len(springs.i)):
        i = springs.i[e]
        j = springs.j[e]
        dx = x[j, 0] - x[i, 0]
        dy = x[j, 1] - x[i, 1]
        dz = x[j, 2] - x[i, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz + 1e-300)
        k = springs.stiffness[e]
        slope = k
        pull = k * (length - springs.rest[e])
        if length < springs.low[e]:
            pull += k * (springs.ramp - 1.0) * (length - springs.low[e])
            slope *= springs.ramp
        elif length > springs.high[e]:
            pull += k * (springs.ramp - 1.0) * (length - springs.high[e])
            slope *= springs.ramp
        across = max(pull / length, floor * k)
        along = (slope - across) / (length * length)
        block[e, 0, 0] = across + along * dx * dx
        block[e, 1, 1] = across + along * dy * dy
        block[e, 2, 2] = across + along * dz * dz
        block[e, 0, 1] = block[e, 1, 0] = along * dx * dy
        block[e, 0, 2] = block[e, 2, 0] = along * dx * dz
        block[e, 1, 2] = block[e, 2, 1] = along * dy * dz


@kernel
def outside(x, springs, margin):
    """Return how many springs are outside their linear range narrowed by the share `margin` on both sides."""
    count = 0
    for e in range(len(springs.i)):
        i = springs.i[e]
        j = springs.j[e]
        dx = x[j, 0] - x[i, 0]
        dy = x[j, 1] - x[i, 1]
        dz = x[j, 2] - x[i, 2]
        square = dx * dx + dy * dy + dz * dz
        low = springs.low[e] + margin * (springs.rest[e] - springs.low[e])
        high = springs.high[e] - margin * (springs.high[e] - springs.rest[e])
        if square < low * low or square > high * high:
            count += 1
    return count


@kernel(inline=True)
def tie_force(x, ties, target, force):
    """Add the forces of `ties` to `target` (t, 3) to `force` (n, 3)."""
    for t in range(len(ties.stiffness)):
        gx, gy, gz = target[t, 0], target[t, 1], target[t, 2]
        for a in range(9):
            w = ties.weight[t, a]
            n = ties.node[t, a]
            gx -= w * x[n, 0]
            gy -= w * x[n, 1]
            gz -= w * x[n, 2]
        k = ties.stiffness[t]
        for a in range(9):
            w = k * ties.weight[t, a]
            n = ties.node[t, a]
            force[n, 0] += w * gx
            force[n, 1] += w * gy
            force[n, 2] += w * gz


@kernel
def tie_energy(x, ties, target):
    """Return the energy of `ties` [uJ]."""
    total = 0.0
    for t in range(len(ties.stiffness)):
        gx, gy, gz = target[t, 0], target[t, 1], target[t, 2]
        for a in range(9):
            w = ties.weight[t, a]
            n = ties.node[t, a]
            gx -= w * x[n, 0]
            gy -= w * x[n, 1]
            gz -= w * x[n, 2]
        total += 0.5 * ties.stiffness[t] * (gx * gx + gy * gy + gz * gz)
    return total


@kernel
def mean_gradient(x, corner, side, c, f):
    """Write the mean deformation gradient of cube `c` into `f` (3, 3)."""
    for a in range(3):
        for b in range(3):
            f[a, b] = 0.0
    for n in range(8):
        p = corner[c, n]
        for a in range(3):
            for b in range(3):
                f[a, b] += x[p, a] * SIGNS[n, b] / (4.0 * side[c])


@kernel
def _cofactor(m, out):
    for a in range(3):
        b = (a + 1) % 3
        c = (a + 2) % 3
        for d in range(3):
            e = (d + 1) % 3
            g = (d + 2) % 3
            out[a, d] = m[b, e] * m[c, g] - m[b, g] * m[c, e]
    return m[0, 0] * out[0, 0] + m[0, 1] * out[0, 1] + m[0, 2] * out[0, 2]


@kernel
def _turn(r, x, y, z):
    """Turn the columns of `r` by the rotation vector (x, y, z)."""
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-14:
        return
    s = math.sin(angle)
    c = math.cos(angle)
    x /= angle
    y /= angle
    z /= angle
    for d in range(3):
        u, v, w = r[0, d], r[1, d], r[2, d]
        along = (1.0 - c) * (x * u + y * v + z * w)
        r[0, d] = c * u + s * (y * w - z * v) + along * x
        r[1, d] = c * v + s * (z * u - x * w) + along * y
        r[2, d] = c * w + s * (x * v - y * u) + along * z


@kernel
def rotation_of(f, r, work):
    """Write the rotation nearest to `f` (3, 3) into `r` (3, 3): its polar factor (Higham 1986), proper even if inverted.

    Where `f` is turned inside out, the iteration of Mueller, Bender, Chentanez & Macklin (2016), from the identity.
    """
    det = _cofactor(f, work)
    size = 0.0
    for a in range(3):
        for b in range(3):
            r[a, b] = f[a, b]
            size += f[a, b] * f[a, b]
    if det > 1e-3 * size * math.sqrt(size) / 5.2:
        for _ in range(30):
            det = _cofactor(r, work)
            change = 0.0
            for a in range(3):
                for b in range(3):
                    new = 0.5 * (r[a, b] + work[a, b] / det)
                    change += (new - r[a, b]) ** 2
                    r[a, b] = new
            if change < 1e-28:
                break
        return
    for a in range(3):
        for b in range(3):
            r[a, b] = 1.0 if a == b else 0.0
    for _ in range(60):
        x = y = z = 0.0
        dot = 1e-9
        for d in range(3):
            x += r[1, d] * f[2, d] - r[2, d] * f[1, d]
            y += r[2, d] * f[0, d] - r[0, d] * f[2, d]
            z += r[0, d] * f[1, d] - r[1, d] * f[0, d]
            dot += r[0, d] * f[0, d] + r[1, d] * f[1, d] + r[2, d] * f[2, d]
        s = 1.0 / abs(dot)
        _turn(r, s * x, s * y, s * z)
        if s * s * (x * x + y * y + z * z) < 1e-24:
            break


@kernel
def _hex_local(x, hexes, c, r, work, u):
    """Write cube `c`'s displacement from its turned rest shape, in its own frame, into `u` (24,)."""
    mx = my = mz = 0.0
    for n in range(8):
        p = hexes.corner[c, n]
        mx += 0.125 * x[p, 0]
        my += 0.125 * x[p, 1]
        mz += 0.125 * x[p, 2]
    half = 0.5 * hexes.side[c]
    for n in range(8):
        p = hexes.corner[c, n]
        dx, dy, dz = x[p, 0] - mx, x[p, 1] - my, x[p, 2] - mz
        for d in range(3):
            u[3 * n + d] = r[0, d] * dx + r[1, d] * dy + r[2, d] * dz - half * SIGNS[n, d]


@kernel
def hex_force(x, hexes, force):
    """Add the exact gradient of `hex_energy`, negated, to `force` (n, 3); the rotation's own change is included."""
    f, r, work, s = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    u, g = np.empty(24), np.empty(24)
    for c in range(len(hexes.side)):
        mean_gradient(x, hexes.corner, hexes.side, c, f)
        rotation_of(f, r, work)
        _hex_local(x, hexes, c, r, work, u)
        tx = ty = tz = 0.0
        half = 0.5 * hexes.side[c]
        for a in range(24):
            total = 0.0
            for b in range(24):
                total += hexes.stiffness[c, a, b] * u[b]
            g[a] = total
        for n in range(8):  # torque of the elastic forces about the displaced corners
            px = u[3 * n] + half * SIGNS[n, 0]
            py = u[3 * n + 1] + half * SIGNS[n, 1]
            pz = u[3 * n + 2] + half * SIGNS[n, 2]
            tx += py * g[3 * n + 2] - pz * g[3 * n + 1]
            ty += pz * g[3 * n] - px * g[3 * n + 2]
            tz += px * g[3 * n + 1] - py * g[3 * n]
        trace = 0.0
        for a in range(3):
            for b in range(3):
                s[a, b] = -(r[0, a] * f[0, b] + r[1, a] * f[1, b] + r[2, a] * f[2, b])
            trace -= s[a, a]
        for a in range(3):
            s[a, a] += trace
        det = _cofactor(s, work)
        size = trace * trace * trace
        if abs(det) > 1e-6 * size:
            wx = (work[0, 0] * tx + work[0, 1] * ty + work[0, 2] * tz) / det
            wy = (work[1, 0] * tx + work[1, 1] * ty + work[1, 2] * tz) / det
            wz = (work[2, 0] * tx + work[2, 1] * ty + work[2, 2] * tz) / det
        else:
            wx = wy = wz = 0.0
        scale = 1.0 / (4.0 * hexes.side[c])
        for n in range(8):
            p = hexes.corner[c, n]
            ax, ay, az = scale * SIGNS[n, 0], scale * SIGNS[n, 1], scale * SIGNS[n, 2]
            lx = g[3 * n] - (wy * az - wz * ay)
            ly = g[3 * n + 1] - (wz * ax - wx * az)
            lz = g[3 * n + 2] - (wx * ay - wy * ax)
            for d in range(3):
                force[p, d] -= r[d, 0] * lx + r[d, 1] * ly + r[d, 2] * lz


@kernel
def hex_energy(x, hexes):
    """Return the energy of `hexes`, u^T K u / 2 with u = R^T (x - mean) - X, R the polar factor of the mean gradient."""
    f, r, work, u = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(24)
    total = 0.0
    for c in range(len(hexes.side)):
        mean_gradient(x, hexes.corner, hexes.side, c, f)
        rotation_of(f, r, work)
        _hex_local(x, hexes, c, r, work, u)
        for a in range(24):
            for b in range(24):
                total += 0.5 * u[a] * hexes.stiffness[c, a, b] * u[b]
    return total


@kernel
def hex_rotations(x, hexes, out):
    """Write the rotation of every cube into `out` (c, 3, 3)."""
    f, work = np.empty((3, 3)), np.empty((3, 3))
    for c in range(len(hexes.side)):
        mean_gradient(x, hexes.corner, hexes.side, c, f)
        rotation_of(f, out[c], work)


@kernel
def corner_volumes(x, cells, out):
    """Write the smallest of the eight corner Jacobians det(three edges) / side^3 of every cube into `out` (c,)."""
    for c in range(len(cells.side)):
        least = np.inf
        scale = 1.0 / cells.side[c] ** 3
        for n in range(8):
            p = cells.corner[c, n]
            a, b, d = cells.corner[c, n ^ 4], cells.corner[c, n ^ 2], cells.corner[c, n ^ 1]
            ax, ay, az = x[a, 0] - x[p, 0], x[a, 1] - x[p, 1], x[a, 2] - x[p, 2]
            bx, by, bz = x[b, 0] - x[p, 0], x[b, 1] - x[p, 1], x[b, 2] - x[p, 2]
            dx, dy, dz = x[d, 0] - x[p, 0], x[d, 1] - x[p, 1], x[d, 2] - x[p, 2]
            det = ax * (by * dz - bz * dy) + ay * (bz * dx - bx * dz) + az * (bx * dy - by * dx)
            sign = -SIGNS[n, 0] * SIGNS[n, 1] * SIGNS[n, 2]
            least = min(least, sign * det * scale)
        out[c] = least


@kernel
def watch(x, cells, barrier, margin, out):
    """Write `corner_volumes` into `out` (c,), and list the cubes below `barrier.least` + `margin` in `barrier.near`."""
    corner_volumes(x, cells, out)
    count = 0
    for c in range(len(cells.side)):
        if out[c] < barrier.least + margin and barrier.strength[c] > 0.0:
            barrier.near[count] = c
            count += 1
    barrier.listed[0] = count


@kernel(inline=True)
def _corner_slopes(x, cells, c, n, g):
    """Write dJ/dx of the three corners beside corner `n` of cube `c` (`n` ^ 4, ^ 2, ^ 1) into `g` (3, 3), return J."""
    p = cells.corner[c, n]
    scale = -SIGNS[n, 0] * SIGNS[n, 1] * SIGNS[n, 2] / cells.side[c] ** 3
    a, b, d = cells.corner[c, n ^ 4], cells.corner[c, n ^ 2], cells.corner[c, n ^ 1]
    ax, ay, az = x[a, 0] - x[p, 0], x[a, 1] - x[p, 1], x[a, 2] - x[p, 2]
    bx, by, bz = x[b, 0] - x[p, 0], x[b, 1] - x[p, 1], x[b, 2] - x[p, 2]
    dx, dy, dz = x[d, 0] - x[p, 0], x[d, 1] - x[p, 1], x[d, 2] - x[p, 2]
    g[0, 0] = scale * (by * dz - bz * dy)
    g[0, 1] = scale * (bz * dx - bx * dz)
    g[0, 2] = scale * (bx * dy - by * dx)
    g[1, 0] = scale * (dy * az - dz * ay)
    g[1, 1] = scale * (dz * ax - dx * az)
    g[1, 2] = scale * (dx * ay - dy * ax)
    g[2, 0] = scale * (ay * bz - az * by)
    g[2, 1] = scale * (az * bx - ax * bz)
    g[2, 2] = scale * (ax * by - ay * bx)
    return ax * g[0, 0] + ay * g[0, 1] + az * g[0, 2]


@kernel
def barrier_force(x, cells, barrier, force):
    """Add the forces of the corners below `barrier.least` in the cubes `barrier.near` to `force` (n, 3)."""
    g = np.empty((3, 3))
    for k in range(barrier.listed[0]):
        c = barrier.near[k]
        for n in range(8):
            short = barrier.least - _corner_slopes(x, cells, c, n, g)
            if short > 0.0:
                f = barrier.strength[c] * short
                p = cells.corner[c, n]
                for e in range(3):
                    q = cells.corner[c, n ^ (4 >> e)]
                    for d in range(3):
                        force[q, d] += f * g[e, d]
                        force[p, d] -= f * g[e, d]


@kernel
def barrier_energy(x, cells, barrier):
    """Return the energy of all corners below `barrier.least` [uJ]."""
    g = np.empty((3, 3))
    total = 0.0
    for c in range(len(cells.side)):
        for n in range(8):
            short = max(barrier.least - _corner_slopes(x, cells, c, n, g), 0.0)
            total += 0.5 * barrier.strength[c] * short * short
    return total


@kernel
def barrier_slopes(x, cells, barrier, node, slope, weight):
    """Write of every corner of `barrier.near`: nodes (k, 4), dJ/dx (k, 4, 3), and the barrier or 0 if it has none (k,)."""
    g = np.empty((3, 3))
    for k in range(barrier.listed[0]):
        c = barrier.near[k]
        for n in range(8):
            row = 8 * k + n
            weight[row] = barrier.strength[c] if _corner_slopes(x, cells, c, n, g) < barrier.least else 0.0
            node[row, 3] = cells.corner[c, n]
            for d in range(3):
                slope[row, 3, d] = -g[0, d] - g[1, d] - g[2, d]
            for e in range(3):
                node[row, e] = cells.corner[c, n ^ (4 >> e)]
                for d in range(3):
                    slope[row, e, d] = g[e, d]


@kernel
def reach(x, v, force, inverse_mass, dt, cells, out):
    """Write how far the farthest corner of every cube goes in `dt`, |v dt + f dt^2 / m| / side, into `out` (c,)."""
    for c in range(len(cells.side)):
        most = 0.0
        for n in range(8):
            p = cells.corner[c, n]
            s = dt * dt * inverse_mass[p]
            dx = v[p, 0] * dt + s * force[p, 0]
            dy = v[p, 1] * dt + s * force[p, 1]
            dz = v[p, 2] * dt + s * force[p, 2]
            most = max(most, dx * dx + dy * dy + dz * dz)
        out[c] = math.sqrt(most) / cells.side[c]


@kernel(inline=True)
def all_forces(x, load, tables, target, force):
    """Write load plus all inner forces into `force` (n, 3); those of slaves are moved to their masters."""
    for i in range(len(x)):
        force[i, 0] = load[i, 0]
        force[i, 1] = load[i, 1]
        force[i, 2] = load[i, 2]
    spring_force(x, tables.springs, force)
    if len(tables.ties.stiffness):
        tie_force(x, tables.ties, target, force)
    if len(tables.hexes.side):
        hex_force(x, tables.hexes, force)
    if tables.barrier.listed[0]:
        barrier_force(x, tables.cells, tables.barrier, force)
    slaves = tables.slaves
    for s in range(len(slaves.node)):
        n = slaves.node[s]
        for k in range(slaves.start[s], slaves.start[s + 1]):
            for d in range(3):
                force[slaves.master[k], d] += slaves.weight[k] * force[n, d]
        force[n, 0] = force[n, 1] = force[n, 2] = 0.0


@kernel(inline=True)
def follow(x, slaves):
    """Set the rows of `x` (n, 3) that are slaves to the weighted sums of their masters."""
    for s in range(len(slaves.node)):
        a = b = c = 0.0
        for k in range(slaves.start[s], slaves.start[s + 1]):
            m = slaves.master[k]
            a += slaves.weight[k] * x[m, 0]
            b += slaves.weight[k] * x[m, 1]
            c += slaves.weight[k] * x[m, 2]
        n = slaves.node[s]
        x[n, 0], x[n, 1], x[n, 2] = a, b, c


@kernel
def advance(
    x, v, load, tables, inverse_mass, carried, carried_move, target, target_move, dt, drag, limit, count, force
):
    """Take `count` steps of symplectic Euler in place: v' = (v + dt f / m) / (1 + drag dt), x' = x + dt v'.

    carried (p,) go on by `carried_move` (p, 3) in each step and the ties' `target` (t, 3) by `target_move`
    limit : largest movement of a node in one step [mm], inf = none
    """
    keep = 1.0 / (1.0 + drag * dt)
    cap = limit / dt
    for _ in range(count):
        all_forces(x, load, tables, target, force)
        for i in range(len(x)):
            s = dt * inverse_mass[i]
            a = keep * (v[i, 0] + s * force[i, 0])
            b = keep * (v[i, 1] + s * force[i, 1])
            c = keep * (v[i, 2] + s * force[i, 2])
            speed = a * a + b * b + c * c
            if speed > cap * cap:
                shrink = cap / math.sqrt(speed)
                a *= shrink
                b *= shrink
                c *= shrink
            v[i, 0], v[i, 1], v[i, 2] = a, b, c
            x[i, 0] += dt * a
            x[i, 1] += dt * b
            x[i, 2] += dt * c
        for p in range(len(carried)):
            i = carried[p]
            for d in range(3):
                x[i, d] += carried_move[p, d] - dt * v[i, d]
                v[i, d] = carried_move[p, d] / dt
        for t in range(len(target)):
            for d in range(3):
                target[t, d] += target_move[t, d]
        if len(tables.slaves.node):
            follow(x, tables.slaves)
            follow(v, tables.slaves)
