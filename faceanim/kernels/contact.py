"""Unilateral contact with bones, eyeballs and the other lip, in two moves.

`find` turns every contact that is near enough into a half space (a plane) at the current positions; the others work
on planes alone. At the positions where it was made, a plane has the value and the gradient of the true gap.
Penalty of depth p: energy P A (p^2 / 2 + p^4 / (4 s^2)), so stiffening that true penetration stays out of reach;
from p = 2 s on it goes on with the tangent reached, so that a deep start does not explode.
"""

from __future__ import annotations

import math

from faceanim.ground.jit import kernel
from faceanim.kernels.linalg3 import add_outer

STEEPEST = math.sqrt(3.0)
"""No trilinear interpolation of distances grows faster than this."""
OFF_GRID = 4.0
"""A vertex off a bone's grid counts as so far away [mm] when it is asked whether it may have come back."""
DEEPEST = 2.5
"""A vertex farther behind the other lip than this [mm] belongs to something else."""


@kernel
def sample_grid(grids, b, x, y, z):
    """Return the distance to bone `b` at a point of its rest frame and its gradient; a huge distance off the grid."""
    far = (1e30, 0.0, 0.0, 0.0)
    h = grids.spacing[b]
    u = (x - grids.origin[b, 0]) / h
    v = (y - grids.origin[b, 1]) / h
    w = (z - grids.origin[b, 2]) / h
    ny = grids.shape[b, 1]
    nz = grids.shape[b, 2]
    inside = u >= 0.0 and v >= 0.0 and w >= 0.0
    if not (inside and u < grids.shape[b, 0] - 1 and v < ny - 1 and w < nz - 1):
        return far
    i = int(u)
    j = int(v)
    k = int(w)
    u -= i
    v -= j
    w -= k
    at = grids.offset[b] + (i * ny + j) * nz + k
    g = grids.values
    up = ny * nz
    c000 = float(g[at])
    c001 = float(g[at + 1])
    c010 = float(g[at + nz])
    c011 = float(g[at + nz + 1])
    c100 = float(g[at + up])
    c101 = float(g[at + up + 1])
    c110 = float(g[at + up + nz])
    c111 = float(g[at + up + nz + 1])
    c00 = c000 + w * (c001 - c000)
    c01 = c010 + w * (c011 - c010)
    c10 = c100 + w * (c101 - c100)
    c11 = c110 + w * (c111 - c110)
    c0 = c00 + v * (c01 - c00)
    c1 = c10 + v * (c11 - c10)
    along_w = (1 - u) * ((1 - v) * (c001 - c000) + v * (c011 - c010))
    along_w += u * ((1 - v) * (c101 - c100) + v * (c111 - c110))
    along_u = c1 - c0
    if u < 1e-9 and i > 0:
        # On a layer of samples the two sides have a say, or the midline of a symmetric head would be pushed sideways.
        d0 = float(g[at - up]) * (1 - w) + float(g[at - up + 1]) * w
        d1 = float(g[at - up + nz]) * (1 - w) + float(g[at - up + nz + 1]) * w
        along_u = 0.5 * (c1 - (1 - v) * d0 - v * d1)
    along_v = (1 - u) * (c01 - c00) + u * (c11 - c10)
    return c0 + u * (c1 - c0), along_u / h, along_v / h, along_w / h


@kernel
def closest_on_triangle(x, i, a, b, c):
    """Return the squared distance from vertex `i` to triangle (a, b, c) and the barycentric weights of the nearest point."""
    ux = x[b, 0] - x[a, 0]
    uy = x[b, 1] - x[a, 1]
    uz = x[b, 2] - x[a, 2]
    vx = x[c, 0] - x[a, 0]
    vy = x[c, 1] - x[a, 1]
    vz = x[c, 2] - x[a, 2]
    px = x[i, 0] - x[a, 0]
    py = x[i, 1] - x[a, 1]
    pz = x[i, 2] - x[a, 2]
    uu = ux * ux + uy * uy + uz * uz
    uv = ux * vx + uy * vy + uz * vz
    vv = vx * vx + vy * vy + vz * vz
    pu = px * ux + py * uy + pz * uz
    pv = px * vx + py * vy + pz * vz
    pp = px * px + py * py + pz * pz
    det = uu * vv - uv * uv
    s = (vv * pu - uv * pv) / det
    t = (uu * pv - uv * pu) / det
    if not (s >= 0.0 and t >= 0.0 and s + t <= 1.0):
        # Outside the face: the nearest point of the three sides.
        s0 = min(1.0, max(0.0, pu / uu))
        t0 = min(1.0, max(0.0, pv / vv))
        r0 = min(1.0, max(0.0, (pv - pu + uu - uv) / (uu - 2.0 * uv + vv)))
        best = pp - 2.0 * s0 * pu + s0 * s0 * uu
        s = s0
        t = 0.0
        d = pp - 2.0 * t0 * pv + t0 * t0 * vv
        if d < best:
            best = d
            s = 0.0
            t = t0
        q = 1.0 - r0
        d = pp - 2.0 * (q * pu + r0 * pv) + q * q * uu + 2.0 * q * r0 * uv + r0 * r0 * vv
        if d < best:
            s = q
            t = r0
    distance = pp - 2.0 * (s * pu + t * pv) + s * s * uu + 2.0 * s * t * uv + t * t * vv
    return distance, 1.0 - s - t, s, t


@kernel(inline=True)
def cross_of(x, a, b, c):
    """Return the normal of triangle (a, b, c), twice its area long."""
    ux = x[b, 0] - x[a, 0]
    uy = x[b, 1] - x[a, 1]
    uz = x[b, 2] - x[a, 2]
    vx = x[c, 0] - x[a, 0]
    vy = x[c, 1] - x[a, 1]
    vz = x[c, 2] - x[a, 2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@kernel
def triangle_side(x, i, a, b, c, wa, wb, wc):
    """Return the vector from the point (wa, wb, wc) of triangle (a, b, c) to vertex `i`, and how far in front it is.

    (dx, dy, dz, s, nx, ny, nz): n is the triangle's unit normal, s = n . d.
    """
    nx, ny, nz = cross_of(x, a, b, c)
    length = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    nx *= length
    ny *= length
    nz *= length
    dx = x[i, 0] - wa * x[a, 0] - wb * x[b, 0] - wc * x[c, 0]
    dy = x[i, 1] - wa * x[a, 1] - wb * x[b, 1] - wc * x[c, 1]
    dz = x[i, 2] - wa * x[a, 2] - wb * x[b, 2] - wc * x[c, 2]
    return dx, dy, dz, nx * dx + ny * dy + nz * dz, nx, ny, nz


@kernel
def signed_gap(x, looks, i, a, b, c, wa, wb, wc):
    """Return the signed distance of vertex `i` from the point (wa, wb, wc) of triangle (a, b, c), and its direction.

    Positive in front. The sheet looks where its vertex normals `looks` (n, 3), interpolated, look: a vertex that slides
    over an edge feels no jump, and one on the plane of symmetry no push to the side. A vertex that is behind but rather
    beside the triangle than behind it has left the sheet over its border, and one deeper than `DEEPEST` is no contact:
    a huge distance is returned. One that is in front but rather beside is as far as the point is.
    """
    nx = wa * looks[a, 0] + wb * looks[b, 0] + wc * looks[c, 0]
    ny = wa * looks[a, 1] + wb * looks[b, 1] + wc * looks[c, 1]
    nz = wa * looks[a, 2] + wb * looks[b, 2] + wc * looks[c, 2]
    length = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    nx *= length
    ny *= length
    nz *= length
    dx = x[i, 0] - wa * x[a, 0] - wb * x[b, 0] - wc * x[c, 0]
    dy = x[i, 1] - wa * x[a, 1] - wb * x[b, 1] - wc * x[c, 1]
    dz = x[i, 2] - wa * x[a, 2] - wb * x[b, 2] - wc * x[c, 2]
    s = nx * dx + ny * dy + nz * dz
    r2 = dx * dx + dy * dy + dz * dz
    if r2 <= 2.0 * s * s or r2 < 1e-12:
        return 1e30 if s < -DEEPEST else s, nx, ny, nz
    if s < 0.0:
        return 1e30, nx, ny, nz
    r = math.sqrt(r2)
    return r, dx / r, dy / r, dz / r


@kernel
def vertex_normals(x, corners, looks):
    """Write the unit normals of the vertices of `corners` (t, 3), as far as these triangles go, into `looks` (n, 3)."""
    for t in range(len(corners)):
        for k in range(3):
            looks[corners[t, k], 0] = 0.0
            looks[corners[t, k], 1] = 0.0
            looks[corners[t, k], 2] = 0.0
    for t in range(len(corners)):
        nx, ny, nz = cross_of(x, corners[t, 0], corners[t, 1], corners[t, 2])
        for k in range(3):
            looks[corners[t, k], 0] += nx
            looks[corners[t, k], 1] += ny
            looks[corners[t, k], 2] += nz
    for t in range(len(corners)):
        for k in range(3):
            i = corners[t, k]
            length = 1.0 / math.sqrt(looks[i, 0] ** 2 + looks[i, 1] ** 2 + looks[i, 2] ** 2 + 1e-300)
            for d in range(3):
                looks[i, d] *= length


@kernel(inline=True)
def put_plane(planes, count, i, nx, ny, nz, offset, stiffness):
    """Write a plane against a rigid thing into row `count`."""
    planes.node[count, 0] = i
    planes.node[count, 1] = -1
    planes.normal[count, 0] = nx
    planes.normal[count, 1] = ny
    planes.normal[count, 2] = nz
    planes.offset[count] = offset
    planes.stiffness[count] = stiffness


@kernel
def find_bones(x, colliders, grids, pose, reach, count, planes):
    """Add the planes of vertices nearer than clearance + `reach` [mm] to a bone; return the new count.

    A vertex whose distance cannot have shrunk to that since it was last measured is passed over.
    """
    for c in range(len(colliders.bone_node)):
        b = colliders.bone[c]
        if grids.offset[b] < 0:
            continue
        i = colliders.bone_node[c]
        dx = x[i, 0] - pose[b, 0, 3]
        dy = x[i, 1] - pose[b, 1, 3]
        dz = x[i, 2] - pose[b, 2, 3]
        px = pose[b, 0, 0] * dx + pose[b, 1, 0] * dy + pose[b, 2, 0] * dz
        py = pose[b, 0, 1] * dx + pose[b, 1, 1] * dy + pose[b, 2, 1] * dz
        pz = pose[b, 0, 2] * dx + pose[b, 1, 2] * dy + pose[b, 2, 2] * dz
        seen = planes.seen[c]
        ux = px - seen[0]
        uy = py - seen[1]
        uz = pz - seen[2]
        spare = (seen[3] - colliders.bone_clearance[c] - reach) / STEEPEST
        if spare > 0.0 and ux * ux + uy * uy + uz * uz < spare * spare:
            continue
        d, gx, gy, gz = sample_grid(grids, b, px, py, pz)
        seen[0] = px
        seen[1] = py
        seen[2] = pz
        seen[3] = min(d, OFF_GRID)
        gap = d - colliders.bone_clearance[c]
        if gap < reach:
            nx = pose[b, 0, 0] * gx + pose[b, 0, 1] * gy + pose[b, 0, 2] * gz
            ny = pose[b, 1, 0] * gx + pose[b, 1, 1] * gy + pose[b, 1, 2] * gz
            nz = pose[b, 2, 0] * gx + pose[b, 2, 1] * gy + pose[b, 2, 2] * gz
            offset = nx * x[i, 0] + ny * x[i, 1] + nz * x[i, 2] - gap
            put_plane(planes, count, i, nx, ny, nz, offset, colliders.pressure * colliders.bone_area[c])
            count += 1
    return count


@kernel
def find_spheres(x, colliders, reach, count, planes):
    """Add the planes of vertices nearer than `reach` [mm] to a sphere (clearance included); return the new count."""
    for c in range(len(colliders.sphere_node)):
        i = colliders.sphere_node[c]
        dx = x[i, 0] - colliders.sphere[c, 0]
        dy = x[i, 1] - colliders.sphere[c, 1]
        dz = x[i, 2] - colliders.sphere[c, 2]
        r = math.sqrt(dx * dx + dy * dy + dz * dz)
        gap = r - colliders.sphere[c, 3]
        if gap < reach and r > 0.0:
            dx /= r
            dy /= r
            dz /= r
            offset = dx * x[i, 0] + dy * x[i, 1] + dz * x[i, 2] - gap
            put_plane(planes, count, i, dx, dy, dz, offset, colliders.pressure * colliders.sphere_area[c])
            count += 1
    return count


@kernel
def bound_triangles(x, corners, ball):
    """Write a bounding sphere (centre, radius) of each triangle of `corners` (t, 3) into `ball` (t, 4)."""
    for t in range(len(corners)):
        for d in range(3):
            ball[t, d] = (x[corners[t, 0], d] + x[corners[t, 1], d] + x[corners[t, 2], d]) / 3.0
        worst = 0.0
        for k in range(3):
            i = corners[t, k]
            dx = x[i, 0] - ball[t, 0]
            dy = x[i, 1] - ball[t, 1]
            dz = x[i, 2] - ball[t, 2]
            worst = max(worst, dx * dx + dy * dy + dz * dz)
        ball[t, 3] = math.sqrt(worst)


@kernel
def nearest_triangle(x, i, colliders, c, guess, ball):
    """Return the candidate of pair contact `c` nearest to vertex `i`, the nearest point's weights, and its distance.

    guess : a candidate to try first   ball : bounding spheres of the triangles
    Where several triangles share the nearest point (an edge, a corner), the one whose plane is farther off is taken,
    which makes the signed distance continuous.
    """
    corner = colliders.corners
    nearest = guess
    best, wa, wb, wc = closest_on_triangle(x, i, corner[guess, 0], corner[guess, 1], corner[guess, 2])
    reach = math.sqrt(max(best, 0.0)) * (1.0 + 1e-9) + 1e-9
    height = -1.0
    for q in range(colliders.pair_start[c], colliders.pair_start[c + 1]):
        t = colliders.pair_triangle[q]
        dx = x[i, 0] - ball[t, 0]
        dy = x[i, 1] - ball[t, 1]
        dz = x[i, 2] - ball[t, 2]
        far = reach + ball[t, 3]
        if dx * dx + dy * dy + dz * dz > far * far:
            continue
        j = corner[t, 0]
        k = corner[t, 1]
        l = corner[t, 2]
        d, ba, bb, bc = closest_on_triangle(x, i, j, k, l)
        d = max(d, 0.0)
        if math.sqrt(d) > reach:
            continue
        _, _, _, s, _, _, _ = triangle_side(x, i, j, k, l, ba, bb, bc)
        if math.sqrt(d) < reach - 2e-9 * (1.0 + reach) or abs(s) > height:
            height = abs(s)
            nearest = t
            wa = ba
            wb = bb
            wc = bc
            reach = min(reach, math.sqrt(d) * (1.0 + 1e-9) + 1e-9)
    return nearest, wa, wb, wc, reach


@kernel
def pair_gaps(x, colliders, ball, looks, gap):
    """Write the signed distance of each pair contact's vertex from the other side into `gap` (cp,) [mm]."""
    corner = colliders.corners
    bound_triangles(x, corner, ball)
    vertex_normals(x, corner, looks)
    for c in range(len(colliders.pair_node)):
        i = colliders.pair_node[c]
        first = colliders.pair_triangle[colliders.pair_start[c]]
        t, wa, wb, wc, _ = nearest_triangle(x, i, colliders, c, first, ball)
        gap[c], _, _, _ = signed_gap(x, looks, i, corner[t, 0], corner[t, 1], corner[t, 2], wa, wb, wc)


@kernel
def in_front(x, corners, i, triangles, share, touching, keep):
    """Mark in `keep` (k,) those of `triangles` (k,) that vertex `i` is in front of, or beside, or touches.

    Behind is: farther behind the plane than `share` of the distance, and farther off than `touching` [mm].
    """
    for q in range(len(triangles)):
        t = triangles[q]
        j = corners[t, 0]
        k = corners[t, 1]
        l = corners[t, 2]
        d, wa, wb, wc = closest_on_triangle(x, i, j, k, l)
        r = math.sqrt(max(d, 0.0))
        _, _, _, s, _, _, _ = triangle_side(x, i, j, k, l, wa, wb, wc)
        keep[q] = s >= -share * r or r < touching


@kernel
def farthest_move(x, before, colliders):
    """Return how far any vertex that takes part in a pair contact has moved since `before`, which is updated [mm]."""
    worst = 0.0
    for c in range(len(colliders.pair_node)):
        i = colliders.pair_node[c]
        move = (x[i, 0] - before[i, 0]) ** 2 + (x[i, 1] - before[i, 1]) ** 2 + (x[i, 2] - before[i, 2]) ** 2
        worst = max(worst, move)
    for t in range(len(colliders.corners)):
        for k in range(3):
            i = colliders.corners[t, k]
            move = (x[i, 0] - before[i, 0]) ** 2 + (x[i, 1] - before[i, 1]) ** 2 + (x[i, 2] - before[i, 2]) ** 2
            worst = max(worst, move)
    before[:] = x
    return math.sqrt(worst)


@kernel
def find_pairs(x, colliders, reach, count, planes):
    """Add the planes of vertices nearer than gap + `reach` [mm] to the other side's triangles; return the new count.

    A vertex whose distance cannot have shrunk to that since it was last measured is passed over.
    """
    if len(colliders.pair_node) == 0:
        return count
    moved = 2.0 * farthest_move(x, planes.before, colliders)
    bound_triangles(x, colliders.corners, planes.ball)
    vertex_normals(x, colliders.corners, planes.looks)
    for c in range(len(colliders.pair_node)):
        planes.apart[c] -= moved
        if planes.apart[c] > colliders.pair_gap[c] + reach:
            continue
        i = colliders.pair_node[c]
        t, wa, wb, wc, planes.apart[c] = nearest_triangle(x, i, colliders, c, planes.nearest[c], planes.ball)
        planes.nearest[c] = t
        planes.apart[c] -= 1e-6 * (1.0 + planes.apart[c])
        j = colliders.corners[t, 0]
        k = colliders.corners[t, 1]
        l = colliders.corners[t, 2]
        d, nx, ny, nz = signed_gap(x, planes.looks, i, j, k, l, wa, wb, wc)
        gap = d - colliders.pair_gap[c]
        if gap < reach:
            # The offset makes the plane's gap the true one here, also where the nearest point lies on a side.
            put_plane(planes, count, i, nx, ny, nz, 0.0, colliders.pressure * colliders.pair_area[c])
            planes.node[count, 1] = j
            planes.node[count, 2] = k
            planes.node[count, 3] = l
            planes.weight[count, 0] = wa
            planes.weight[count, 1] = wb
            planes.weight[count, 2] = wc
            planes.offset[count] = plane_gap(x, planes, count) - gap
            count += 1
    return count


@kernel
def find(x, colliders, grids, pose, reach, pair_reach, planes):
    """Write every contact nearer than `reach` [mm] beyond its clearance at positions `x` (n, 3) into `planes`.

    pair_reach : the same for lips and lids, whose search is the dearest
    """
    planes.count[1] = find_pairs(x, colliders, pair_reach, 0, planes)
    find_rigid(x, colliders, grids, pose, reach, planes)


@kernel
def find_rigid(x, colliders, grids, pose, reach, planes):
    """Find the contacts with bones and eyeballs anew, behind those of lips and lids, which stay as they are."""
    count = find_bones(x, colliders, grids, pose, reach, planes.count[1], planes)
    planes.count[0] = find_spheres(x, colliders, reach, count, planes)


@kernel
def hold_back(x, free, planes):
    """Move the first `free` vertices of `x` (n, 3) back out of the other lip or lid, as far as the known planes say.

    A guess that has gone through the other side would be taken for something behind it. Each side goes back half way.
    """
    for c in range(planes.count[1]):
        gap = plane_gap(x, planes, c)
        if gap < 0.0:
            for k in range(4):
                i = planes.node[c, k]
                if i < free:
                    w = 0.5 if k == 0 else -0.5 * planes.weight[c, k - 1]
                    for d in range(3):
                        x[i, d] -= w * gap * planes.normal[c, d]


@kernel
def plane_gap(x, planes, c):
    """Return the gap of plane `c` [mm]; negative = penetration."""
    i = planes.node[c, 0]
    dx = x[i, 0]
    dy = x[i, 1]
    dz = x[i, 2]
    if planes.node[c, 1] >= 0:
        for k in range(3):
            j = planes.node[c, k + 1]
            w = planes.weight[c, k]
            dx -= w * x[j, 0]
            dy -= w * x[j, 1]
            dz -= w * x[j, 2]
    return planes.normal[c, 0] * dx + planes.normal[c, 1] * dy + planes.normal[c, 2] * dz - planes.offset[c]


@kernel
def spread(planes, c, s, y):
    """Add s times the gradient of the gap of plane `c` to `y` (n, >= 3)."""
    nx = s * planes.normal[c, 0]
    ny = s * planes.normal[c, 1]
    nz = s * planes.normal[c, 2]
    i = planes.node[c, 0]
    y[i, 0] += nx
    y[i, 1] += ny
    y[i, 2] += nz
    if planes.node[c, 1] >= 0:
        for k in range(3):
            j = planes.node[c, k + 1]
            w = planes.weight[c, k]
            y[j, 0] -= w * nx
            y[j, 1] -= w * ny
            y[j, 2] -= w * nz


@kernel(inline=True)
def penalty(p, stiffening):
    """Return energy, force and tangent at depth `p` > 0 of a contact of unit stiffness."""
    limit = 2.0 * stiffening
    over = p - limit if p > limit else 0.0
    p -= over
    q = (p / stiffening) ** 2
    force = p * (1.0 + q)
    tangent = 1.0 + 3.0 * q
    energy = p * p * (0.5 + 0.25 * q) + over * (force + 0.5 * over * tangent)
    return energy, force + over * tangent, tangent


@kernel
def plane_force(x, planes, stiffening, force):
    """Add the penalty forces to `force` (n, 4), and their tangent stiffness to the stiffness bound of each vertex."""
    for c in range(planes.count[0]):
        p = -plane_gap(x, planes, c)
        if p > 0.0:
            _, f, k = penalty(p, stiffening)
            spread(planes, c, planes.stiffness[c] * f, force)
            k *= planes.stiffness[c]
            if planes.node[c, 1] >= 0:
                # (sum w z)^2 <= 2 sum |w| z^2: so bounded, contact never has the largest eigenvalue of a sweep
                k *= 2.0
                for j in range(3):
                    force[planes.node[c, j + 1], 3] += k * planes.weight[c, j]
            force[planes.node[c, 0], 3] += k


@kernel
def plane_energy(x, planes, stiffening):
    """Return the penalty energy [uJ]."""
    total = 0.0
    for c in range(planes.count[0]):
        p = -plane_gap(x, planes, c)
        if p > 0.0:
            energy, _, _ = penalty(p, stiffening)
            total += planes.stiffness[c] * energy
    return total


@kernel
def plane_tangent(x, planes, stiffening, tangent):
    """Write the second derivative of each plane's penalty by its depth into `tangent` (c,) [mN/mm]; 0 = no touch."""
    for c in range(planes.count[0]):
        p = -plane_gap(x, planes, c)
        tangent[c] = 0.0
        if p > 0.0:
            _, _, k = penalty(p, stiffening)
            tangent[c] = planes.stiffness[c] * k


@kernel
def plane_blocks(planes, tangent, bound, block):
    """Add the planes' diagonal blocks to `block` (n, 6): exact ones, or with `bound` 1 the bound for Jacobi sweeps."""
    for c in range(planes.count[0]):
        k = tangent[c]
        if k != 0.0:
            nx = planes.normal[c, 0]
            ny = planes.normal[c, 1]
            nz = planes.normal[c, 2]
            add_outer(block, planes.node[c, 0], k, nx, ny, nz)
            if planes.node[c, 1] >= 0:
                for j in range(3):
                    w = planes.weight[c, j]
                    add_outer(block, planes.node[c, j + 1], k * (w if bound else w * w), nx, ny, nz)


@kernel
def plane_product(v, planes, tangent, out):
    """Add the planes' Hessian times `v` (n, 3) to `out` (n, 3)."""
    for c in range(planes.count[0]):
        if tangent[c] != 0.0:
            spread(planes, c, tangent[c] * (plane_gap(v, planes, c) + planes.offset[c]), out)
