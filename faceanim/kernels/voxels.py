"""Which part of a tetrahedron lies in which cube, what is inside a surface, and where triangles cut each other."""

from __future__ import annotations

import math

import numpy as np

from faceanim.ground.jit import kernel

EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]], dtype=np.int32)
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]], dtype=np.int32)
_DEPTH = 16


@kernel
def _below(stack, level, top, axis, bound, sign):
    """Replace the tetrahedron `top` of `stack` by up to three that fill its part with sign (x - bound) <= 0.

    Returns the number of tetrahedra on the stack; `level` of the new ones is one higher.
    """
    inside = np.zeros(4, dtype=np.int64)
    outside = np.zeros(4, dtype=np.int64)
    a = 0
    b = 0
    for k in range(4):
        if sign * (stack[top, k, axis] - bound) <= 0.0:
            inside[a] = k
            a += 1
        else:
            outside[b] = k
            b += 1
    plane = level[top] + 1
    if a == 4:
        level[top] = plane
        return top + 1
    if a == 0:
        return top
    old = stack[top].copy()
    cut = np.zeros((4, 3))
    n = 0
    for p in range(a):
        for q in range(b):
            x = old[inside[p]]
            y = old[outside[q]]
            t = (bound - x[axis]) / (y[axis] - x[axis])
            for d in range(3):
                cut[n, d] = x[d] + t * (y[d] - x[d])
            n += 1
    if a == 1:
        _put(stack, level, top, plane, old[inside[0]], cut[0], cut[1], cut[2])
        return top + 1
    if a == 3:
        p0, p1, p2 = old[inside[0]], old[inside[1]], old[inside[2]]
        _put(stack, level, top, plane, p0, p1, p2, cut[2])
        _put(stack, level, top + 1, plane, p0, p1, cut[1], cut[2])
        _put(stack, level, top + 2, plane, p0, cut[0], cut[1], cut[2])
        return top + 3
    p0, p1 = old[inside[0]], old[inside[1]]  # a prism with the triangles p0 cut0 cut1 and p1 cut2 cut3
    _put(stack, level, top, plane, p0, cut[0], cut[1], cut[3])
    _put(stack, level, top + 1, plane, p0, cut[0], cut[2], cut[3])
    _put(stack, level, top + 2, plane, p0, p1, cut[2], cut[3])
    return top + 3


@kernel
def _put(stack, level, at, plane, a, b, c, d):
    for k in range(3):
        stack[at, 0, k] = a[k]
        stack[at, 1, k] = b[k]
        stack[at, 2, k] = c[k]
        stack[at, 3, k] = d[k]
    level[at] = plane


@kernel
def _volume(p):
    ax, ay, az = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
    bx, by, bz = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    cx, cy, cz = p[3, 0] - p[0, 0], p[3, 1] - p[0, 1], p[3, 2] - p[0, 2]
    return abs(ax * (by * cz - bz * cy) - ay * (bx * cz - bz * cx) + az * (bx * cy - by * cx)) / 6.0


@kernel
def volume_in_box(tet, low, high, stack, level):
    """Return the volume of the part of `tet` (4, 3) in the box from `low` to `high`, by cutting at its six planes."""
    stack[0] = tet
    level[0] = 0
    top = 1
    total = 0.0
    while top > 0:
        top -= 1
        plane = level[top]
        if plane == 6:
            total += _volume(stack[top])
        elif plane < 3:
            top = _below(stack, level, top, plane, high[plane], 1.0)
        else:
            top = _below(stack, level, top, plane - 3, low[plane - 3], -1.0)
    return total


@kernel
def _apart(p, count, half, x, y, z):
    """Return whether the axis (x, y, z) separates the first `count` points of `p` from the box |x_d| <= half."""
    least = np.inf
    most = -np.inf
    for k in range(count):
        s = p[k, 0] * x + p[k, 1] * y + p[k, 2] * z
        least = min(least, s)
        most = max(most, s)
    reach = half * (abs(x) + abs(y) + abs(z))
    return least > reach or most < -reach


@kernel
def touches(p, count, half):
    """Return whether the hull of the first `count` (1 to 3) points of `p` (3, 3) meets the box |x_d| <= half."""
    if (
        _apart(p, count, half, 1.0, 0.0, 0.0)
        or _apart(p, count, half, 0.0, 1.0, 0.0)
        or _apart(p, count, half, 0.0, 0.0, 1.0)
    ):
        return False
    for a in range(count):
        b = (a + 1) % count
        ex, ey, ez = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
        if (
            _apart(p, count, half, 0.0, -ez, ey)
            or _apart(p, count, half, ez, 0.0, -ex)
            or _apart(p, count, half, -ey, ex, 0.0)
        ):
            return False
    if count < 3:
        return True
    ax, ay, az = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
    bx, by, bz = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    return not _apart(p, 3, half, ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


@kernel
def cut_tets(corner, first, last, low, side, tet, place, volume, touch):
    """List the cubes `first[e]`..`last[e]` of every tetrahedron `corner` (e, 4, 3), with the volume in each.

    tet, place, volume (k,), (k, 3), (k,) : one row for each pair   touch (k, 14) : which of its 4 corners, 6 edges and
    4 faces meet the closed cube
    """
    stack = np.zeros((_DEPTH, 4, 3))
    level = np.zeros(_DEPTH, dtype=np.int64)
    lower = np.zeros(3)
    upper = np.zeros(3)
    p = np.zeros((3, 3))
    centre = np.zeros(3)
    half = 0.5 * side * (1.0 + 1e-6)
    row = 0
    for e in range(len(corner)):
        for i in range(first[e, 0], last[e, 0] + 1):
            for j in range(first[e, 1], last[e, 1] + 1):
                for k in range(first[e, 2], last[e, 2] + 1):
                    tet[row] = e
                    place[row, 0], place[row, 1], place[row, 2] = i, j, k
                    for d in range(3):
                        lower[d] = low[d] + side * place[row, d]
                        upper[d] = lower[d] + side
                        centre[d] = lower[d] + 0.5 * side
                    volume[row] = volume_in_box(corner[e], lower, upper, stack, level)
                    for a in range(4):
                        p[0] = corner[e, a] - centre
                        touch[row, a] = touches(p, 1, half)
                    for a in range(6):
                        p[0] = corner[e, EDGES[a, 0]] - centre
                        p[1] = corner[e, EDGES[a, 1]] - centre
                        touch[row, 4 + a] = touches(p, 2, half)
                    for a in range(4):
                        for c in range(3):
                            p[c] = corner[e, FACES[a, c]] - centre
                        touch[row, 10 + a] = touches(p, 3, half)
                    row += 1


@kernel
def winding(points, triangles, x, y, z):
    """Return how often the surface winds around (x, y, z): 1 inside, 0 outside (Van Oosterom & Strackee 1983, Eq. 8)."""
    total = 0.0
    for t in range(len(triangles)):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, az = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
        bx, by, bz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
        cx, cy, cz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
        a = math.sqrt(ax * ax + ay * ay + az * az)
        b = math.sqrt(bx * bx + by * by + bz * bz)
        c = math.sqrt(cx * cx + cy * cy + cz * cz)
        det = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        ab = ax * bx + ay * by + az * bz
        bc = bx * cx + by * cy + bz * cz
        ca = cx * ax + cy * ay + cz * az
        total += math.atan2(det, a * b * c + ab * c + bc * a + ca * b)
    return total / (2.0 * math.pi)


@kernel
def fill_by_winding(points, triangles, low, side, index, offset, fill):
    """Write the share of the samples `offset` (s, 3) of every cube `index` (c, 3) that are inside the surface."""
    for c in range(len(index)):
        inside = 0
        for s in range(len(offset)):
            x = low[0] + side * (index[c, 0] + offset[s, 0])
            y = low[1] + side * (index[c, 1] + offset[s, 1])
            z = low[2] + side * (index[c, 2] + offset[s, 2])
            if winding(points, triangles, x, y, z) > 0.5:
                inside += 1
        fill[c] = inside / len(offset)


@kernel
def _pierces(p, q, a, b, c):
    """Return whether the segment p-q passes through the triangle a, b, c, touching left out."""
    e1 = b - a
    e2 = c - a
    nx = e1[1] * e2[2] - e1[2] * e2[1]
    ny = e1[2] * e2[0] - e1[0] * e2[2]
    nz = e1[0] * e2[1] - e1[1] * e2[0]
    u = p - a
    w = q - a
    su = u[0] * nx + u[1] * ny + u[2] * nz
    sw = w[0] * nx + w[1] * ny + w[2] * nz
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    eps = 1e-9 * size * math.sqrt(size)
    if not ((su > eps and sw < -eps) or (su < -eps and sw > eps)):
        return False
    t = su / (su - sw)
    r = u + t * (w - u)
    d11 = (e1 * e1).sum()
    d12 = (e1 * e2).sum()
    d22 = (e2 * e2).sum()
    r1 = (r * e1).sum()
    r2 = (r * e2).sum()
    det = d11 * d22 - d12 * d12
    s = (d22 * r1 - d12 * r2) / det
    v = (d11 * r2 - d12 * r1) / det
    return s > 1e-9 and v > 1e-9 and s + v < 1.0 - 1e-9


@kernel
def first_crossing(corner, triangles, pair):
    """Write the first two triangles of `corner` (t, 3, 3) that cut each other into `pair` (2,); return whether any do.

    Triangles with a common vertex may touch there; an edge of one through the inside of the other is a crossing.
    """
    t = len(corner)
    low = np.empty((t, 3))
    high = np.empty((t, 3))
    for i in range(t):
        for d in range(3):
            low[i, d] = min(corner[i, 0, d], corner[i, 1, d], corner[i, 2, d])
            high[i, d] = max(corner[i, 0, d], corner[i, 1, d], corner[i, 2, d])
    order = np.argsort(low[:, 0])
    for a in range(t):
        i = order[a]
        for b in range(a + 1, t):
            j = order[b]
            if low[j, 0] > high[i, 0]:
                break
            if low[i, 1] > high[j, 1] or low[j, 1] > high[i, 1] or low[i, 2] > high[j, 2] or low[j, 2] > high[i, 2]:
                continue
            for k in range(3):
                m = (k + 1) % 3
                if _pierces(corner[i, k], corner[i, m], corner[j, 0], corner[j, 1], corner[j, 2]) or _pierces(
                    corner[j, k], corner[j, m], corner[i, 0], corner[i, 1], corner[i, 2]
                ):
                    pair[0], pair[1] = min(i, j), max(i, j)
                    return True
    return False
