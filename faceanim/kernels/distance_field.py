"""Distances between points and triangles, and crossings of grid lines with a surface."""

from __future__ import annotations

import math

from faceanim.ground.jit import kernel


@kernel(inline=False)
def triangle_distance2(p0, p1, p2, corners, t):
    """Return the squared distance [mm^2] of the point (p0, p1, p2) to triangle t of `corners` (t, 3, 3).

    Closest point by Voronoi region of the triangle: vertex, edge or face.
    """
    a0, a1, a2 = corners[t, 0, 0], corners[t, 0, 1], corners[t, 0, 2]
    u0, u1, u2 = corners[t, 1, 0] - a0, corners[t, 1, 1] - a1, corners[t, 1, 2] - a2
    v0, v1, v2 = corners[t, 2, 0] - a0, corners[t, 2, 1] - a1, corners[t, 2, 2] - a2
    w0, w1, w2 = p0 - a0, p1 - a1, p2 - a2
    uu = u0 * u0 + u1 * u1 + u2 * u2
    vv = v0 * v0 + v1 * v1 + v2 * v2
    uv = u0 * v0 + u1 * v1 + u2 * v2
    uw = u0 * w0 + u1 * w1 + u2 * w2
    vw = v0 * w0 + v1 * w1 + v2 * w2
    s, r = 0.0, 0.0
    det = uu * vv - uv * uv
    inside = False
    if det > 1e-14 * uu * vv:
        s = (vv * uw - uv * vw) / det
        r = (uu * vw - uv * uw) / det
        inside = s >= 0.0 and r >= 0.0 and s + r <= 1.0
    if inside:
        d0, d1, d2 = w0 - s * u0 - r * v0, w1 - s * u1 - r * v1, w2 - s * u2 - r * v2
        return d0 * d0 + d1 * d1 + d2 * d2
    best = math.inf
    for edge in range(3):
        if edge == 0:
            e = min(max(uw / uu if uu > 0.0 else 0.0, 0.0), 1.0)
            s, r = e, 0.0
        elif edge == 1:
            e = min(max(vw / vv if vv > 0.0 else 0.0, 0.0), 1.0)
            s, r = 0.0, e
        else:
            length2 = uu + vv - 2.0 * uv
            e = min(max((vw - uw + uu - uv) / length2 if length2 > 0.0 else 0.0, 0.0), 1.0)
            s, r = 1.0 - e, e
        d0, d1, d2 = w0 - s * u0 - r * v0, w1 - s * u1 - r * v1, w2 - s * u2 - r * v2
        best = min(best, d0 * d0 + d1 * d1 + d2 * d2)
    return best


@kernel
def nearest_triangle(points, corners, centres, radii, bound, distance, triangle):
    """Write the distance [mm] of each point to the nearest triangle, and that triangle's index.

    points (n, 3), corners (t, 3, 3), centres (t, 3) and radii (t,) of balls that hold the triangles,
    bound (n,) [mm]: an upper bound of the distance, for culling; out: distance (n,), triangle (n,)
    """
    for i in range(points.shape[0]):
        p0, p1, p2 = points[i, 0], points[i, 1], points[i, 2]
        best = bound[i] * 1.000001 + 1e-9
        best2 = best * best
        found = -1
        for t in range(corners.shape[0]):
            d0, d1, d2 = p0 - centres[t, 0], p1 - centres[t, 1], p2 - centres[t, 2]
            reach = best + radii[t]
            if d0 * d0 + d1 * d1 + d2 * d2 > reach * reach:
                continue
            d = triangle_distance2(p0, p1, p2, corners, t)
            if d < best2:
                best2 = d
                best = math.sqrt(d)
                found = t
        distance[i] = best
        triangle[i] = found


@kernel
def splat_distance(corners, origin, spacing, band, out2):
    """Lower out2 (nx, ny, nz) [mm^2] to the squared distance to every triangle within `band` [mm] of a sample."""
    nx, ny, nz = out2.shape
    for t in range(corners.shape[0]):
        i0, i1 = _reach(corners, t, 0, origin, spacing, band, nx)
        j0, j1 = _reach(corners, t, 1, origin, spacing, band, ny)
        k0, k1 = _reach(corners, t, 2, origin, spacing, band, nz)
        for i in range(i0, i1):
            x = origin[0] + i * spacing
            for j in range(j0, j1):
                y = origin[1] + j * spacing
                for k in range(k0, k1):
                    d = triangle_distance2(x, y, origin[2] + k * spacing, corners, t)
                    if d < out2[i, j, k]:
                        out2[i, j, k] = d


@kernel
def _reach(corners, t, axis, origin, spacing, band, count):
    low = min(corners[t, 0, axis], corners[t, 1, axis], corners[t, 2, axis]) - band - origin[axis]
    high = max(corners[t, 0, axis], corners[t, 1, axis], corners[t, 2, axis]) + band - origin[axis]
    return max(0, math.ceil(low / spacing)), min(count, math.floor(high / spacing) + 1)


@kernel
def count_crossings(corners, axis, origin, spacing, out):
    """Add to `out` the signed crossings of the grid lines along `axis` with the triangles.

    A line that enters the surface at s adds +1 to the first sample behind s, one that leaves it adds -1; the running
    sum along the axis is then the winding number as that line sees it. out : (na, nb, nc), `axis` first, then the
    next two in cyclic order.
    """
    b, c = (axis + 1) % 3, (axis + 2) % 3
    na, nb, nc = out.shape
    for t in range(corners.shape[0]):
        j0, j1 = _reach(corners, t, b, origin, spacing, 0.0, nb)
        k0, k1 = _reach(corners, t, c, origin, spacing, 0.0, nc)
        ub, uc = corners[t, 1, b] - corners[t, 0, b], corners[t, 1, c] - corners[t, 0, c]
        vb, vc = corners[t, 2, b] - corners[t, 0, b], corners[t, 2, c] - corners[t, 0, c]
        det = ub * vc - uc * vb
        if det == 0.0:
            continue
        for j in range(j0, j1):
            wb = origin[b] + j * spacing - corners[t, 0, b]
            for k in range(k0, k1):
                wc = origin[c] + k * spacing - corners[t, 0, c]
                s = (wb * vc - wc * vb) / det
                r = (ub * wc - uc * wb) / det
                if s < 0.0 or r < 0.0 or s + r > 1.0:
                    continue
                height = corners[t, 0, axis]
                height += s * (corners[t, 1, axis] - corners[t, 0, axis])
                height += r * (corners[t, 2, axis] - corners[t, 0, axis])
                i = max(0, math.ceil((height - origin[axis]) / spacing))
                if i < na:
                    out[i, j, k] += -1 if det > 0.0 else 1
