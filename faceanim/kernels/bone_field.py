"""A signed distance in the tetrahedra of a lattice around a closed surface: positive inside (Algorithm 1, eqs 7-9).

The lattice stands on multiples of its spacing. Each cube is six tetrahedra along one main diagonal, and neighbouring
cubes are mirror images, so that a field over a mirror symmetric surface is mirror symmetric.
"""

from __future__ import annotations

import math

from faceanim.ground.jit import kernel
from faceanim.kernels.distance_field import triangle_distance2

FAR = -1
DEEP = -2
"""Marks of lattice nodes outside the envelope: on the outer side, on the inner side."""
OUTSIDE, WITHIN, BURIED = 0, 1, 2
"""Where a point is: beyond the envelope or in its outer border, in the envelope, behind it."""
LINEAR, MEAN, SPLINE, NEAREST = 0, 1, 2, 3
"""How the nodes' distances are read between them; see `sample`."""
MOST_RINGS = 12
"""So many times the search for the nearest triangle goes on to the triangles around it."""


@kernel
def splat(corners, low, high, first, spacing, squared, nearest):
    """Lower the squared distance of every node in the box of a triangle to that of the triangle, and note which it is.

    corners (t, 3, 3);  low, high (t, 3) [mm], the boxes;  first (3,), the lattice index of node (0, 0, 0)
    out: squared (nx, ny, nz) [mm^2], infinite at first;  nearest (nx, ny, nz)
    """
    nx, ny, nz = squared.shape
    for t in range(len(corners)):
        i0 = max(0, math.ceil(low[t, 0] / spacing) - first[0])
        j0 = max(0, math.ceil(low[t, 1] / spacing) - first[1])
        k0 = max(0, math.ceil(low[t, 2] / spacing) - first[2])
        i1 = min(nx, math.floor(high[t, 0] / spacing) - first[0] + 1)
        j1 = min(ny, math.floor(high[t, 1] / spacing) - first[1] + 1)
        k1 = min(nz, math.floor(high[t, 2] / spacing) - first[2] + 1)
        for i in range(i0, i1):
            x = (first[0] + i) * spacing
            for j in range(j0, j1):
                y = (first[1] + j) * spacing
                for k in range(k0, k1):
                    d = triangle_distance2(x, y, (first[2] + k) * spacing, corners, t)
                    if d < squared[i, j, k]:
                        squared[i, j, k] = d
                        nearest[i, j, k] = t


@kernel
def inward(px, py, pz, corners, t, face, edge, vertex):
    """Return whether a point whose nearest triangle is `t` lies inside, its distance [mm] and the way from there to it.

    By the angle-weighted pseudo-normal of the face, edge or corner that holds the nearest point (Baerentzen & Aanaes
    2005): face (t, 3), edge (t, 3, 3) opposite each corner, vertex (t, 3, 3).
    """
    ux = corners[t, 1, 0] - corners[t, 0, 0]
    uy = corners[t, 1, 1] - corners[t, 0, 1]
    uz = corners[t, 1, 2] - corners[t, 0, 2]
    vx = corners[t, 2, 0] - corners[t, 0, 0]
    vy = corners[t, 2, 1] - corners[t, 0, 1]
    vz = corners[t, 2, 2] - corners[t, 0, 2]
    wx, wy, wz = px - corners[t, 0, 0], py - corners[t, 0, 1], pz - corners[t, 0, 2]
    uu = ux * ux + uy * uy + uz * uz
    vv = vx * vx + vy * vy + vz * vz
    uv = ux * vx + uy * vy + uz * vz
    uw = ux * wx + uy * wy + uz * wz
    vw = vx * wx + vy * wy + vz * wz
    det = uu * vv - uv * uv
    s = (vv * uw - uv * vw) / det
    r = (uu * vw - uv * uw) / det
    nx, ny, nz = face[t, 0], face[t, 1], face[t, 2]
    if not (s >= 0.0 and r >= 0.0 and s + r <= 1.0):
        best = math.inf
        for k in range(3):
            if k == 0:
                e = min(max((vw - uw + uu - uv) / (uu + vv - 2.0 * uv), 0.0), 1.0)
                a, b = 1.0 - e, e
            elif k == 1:
                e = min(max(vw / vv, 0.0), 1.0)
                a, b = 0.0, e
            else:
                e = min(max(uw / uu, 0.0), 1.0)
                a, b = e, 0.0
            dx = wx - a * ux - b * vx
            dy = wy - a * uy - b * vy
            dz = wz - a * uz - b * vz
            d = dx * dx + dy * dy + dz * dz
            if d < best:
                best = d
                s, r = a, b
                nx, ny, nz = edge[t, k, 0], edge[t, k, 1], edge[t, k, 2]
                corner = -1
                if e == 0.0:
                    corner = 1 if k == 0 else 0
                elif e == 1.0:
                    corner = 1 if k == 2 else 2
                if corner >= 0:
                    nx, ny, nz = vertex[t, corner, 0], vertex[t, corner, 1], vertex[t, corner, 2]
    dx = wx - s * ux - r * vx
    dy = wy - s * uy - r * vy
    dz = wz - s * uz - r * vz
    return nx * dx + ny * dy + nz * dz < 0.0, math.sqrt(dx * dx + dy * dy + dz * dz), dx, dy, dz


@kernel
def winding(x, y, z, corners):
    """Return how often a closed surface winds around a point: its solid angle over 4 pi (van Oosterom & Strackee 1983)."""
    total = 0.0
    for t in range(len(corners)):
        ax, ay, az = corners[t, 0, 0] - x, corners[t, 0, 1] - y, corners[t, 0, 2] - z
        bx, by, bz = corners[t, 1, 0] - x, corners[t, 1, 1] - y, corners[t, 1, 2] - z
        cx, cy, cz = corners[t, 2, 0] - x, corners[t, 2, 1] - y, corners[t, 2, 2] - z
        a = math.sqrt(ax * ax + ay * ay + az * az)
        b = math.sqrt(bx * bx + by * by + bz * bz)
        c = math.sqrt(cx * cx + cy * cy + cz * cz)
        triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        rest = a * b * c + (ax * bx + ay * by + az * bz) * c
        rest += (bx * cx + by * cy + bz * cz) * a + (cx * ax + cy * ay + cz * az) * b
        total += math.atan2(triple, rest)
    return total / (2.0 * math.pi)


@kernel
def enclose(squared, nearest, vote, corners, face, edge, vertex, first, spacing, inner, outer, slot):
    """Number the nodes no deeper than `inner` and no farther outside than `outer` [mm]; return how many there are.

    The side is told by pseudo-normals, which fail where a surface is folded onto itself; where they disagree with
    `vote` (nx, ny, nz), the mean winding number along the lattice's lines, that decides. Also returns how often.
    out: slot (nx, ny, nz), the number, or FAR or DEEP for the others; along every line these are on the side of the
    last numbered node, which is right because the envelope is at least one spacing thick on either side.
    """
    nx, ny, nz = slot.shape
    count, mended = 0, 0
    for i in range(nx):
        for j in range(ny):
            side = FAR
            for k in range(nz):
                slot[i, j, k] = side
                if squared[i, j, k] < math.inf:
                    x, y, z = (first[0] + i) * spacing, (first[1] + j) * spacing, (first[2] + k) * spacing
                    inside, d, _, _, _ = inward(x, y, z, corners, nearest[i, j, k], face, edge, vertex)
                    if inside != (vote[i, j, k] > 0.5) and d > 1e-9:
                        inside = not inside
                        mended += 1
                    side = DEEP if inside else FAR
                    slot[i, j, k] = side
                    if d <= (inner if inside else outer):
                        slot[i, j, k] = count
                        count += 1
                        squared[i, j, k] = d if inside else -d
    return count, mended


@kernel
def collect(slot, squared, nearest, depth, triangle):
    """Write what the grids (nx, ny, nz) hold for the numbered nodes to `depth` (m,) [mm] and `triangle` (m,)."""
    nx, ny, nz = slot.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if slot[i, j, k] >= 0:
                    depth[slot[i, j, k]] = squared[i, j, k]
                    triangle[slot[i, j, k]] = nearest[i, j, k]


@kernel(inline=True)
def order_of(a, b, c):
    """Return the axes with the largest, middle and smallest of three numbers."""
    if a >= b:
        if b >= c:
            return 0, 1, 2
        return (0, 2, 1) if a >= c else (2, 0, 1)
    if a >= c:
        return 1, 0, 2
    return (1, 2, 0) if b >= c else (2, 1, 0)


@kernel
def tet_nodes(slot, cell, flip, p, q, r, node):
    """Write the numbers of the corners of the tetrahedron that goes along the axes p, q, r to `node` (4,).

    cell (3,), the cube;  flip (3,), 1 on the axes along which it is mirrored
    """
    i = cell[0] + flip[0]
    j = cell[1] + flip[1]
    k = cell[2] + flip[2]
    node[0] = slot[i, j, k]
    for step in range(3):
        axis = p if step == 0 else (q if step == 1 else r)
        if axis == 0:
            i += 1 - 2 * flip[0]
        elif axis == 1:
            j += 1 - 2 * flip[1]
        else:
            k += 1 - 2 * flip[2]
        node[step + 1] = slot[i, j, k]


@kernel
def node_gradients(slot, depth, first, spacing, cell, flip, node, gradient):
    """Write the unit mean of the gradients of the whole tetrahedra at every node to `gradient` (m, 3), 0 at first.

    cell (3,), flip (3,), node (4,) are scratch. All tetrahedra have the same volume.
    """
    nx, ny, nz = slot.shape
    for i in range(nx - 1):
        for j in range(ny - 1):
            for k in range(nz - 1):
                cell[0], cell[1], cell[2] = i, j, k
                for d in range(3):
                    flip[d] = (first[d] + cell[d]) & 1
                for p in range(3):
                    for side in range(2):
                        q, r = (p + 1) % 3, (p + 2) % 3
                        if side:
                            q, r = r, q
                        tet_nodes(slot, cell, flip, p, q, r, node)
                        if node[0] < 0 or node[1] < 0 or node[2] < 0 or node[3] < 0:
                            continue
                        for a in range(4):
                            gradient[node[a], p] += (1 - 2 * flip[p]) * (depth[node[1]] - depth[node[0]])
                            gradient[node[a], q] += (1 - 2 * flip[q]) * (depth[node[2]] - depth[node[1]])
                            gradient[node[a], r] += (1 - 2 * flip[r]) * (depth[node[3]] - depth[node[2]])
    for m in range(len(depth)):
        length = math.sqrt(gradient[m, 0] ** 2 + gradient[m, 1] ** 2 + gradient[m, 2] ** 2)
        if length > 0.0:
            for d in range(3):
                gradient[m, d] /= length


@kernel
def tetrahedra(slot, first, cell, flip, node, write, out):
    """Return how many tetrahedra have all four corners numbered; with `write` 1 also their corners, `out` (e, 4)."""
    nx, ny, nz = slot.shape
    count = 0
    for i in range(nx - 1):
        for j in range(ny - 1):
            for k in range(nz - 1):
                cell[0], cell[1], cell[2] = i, j, k
                odd = 0
                for d in range(3):
                    flip[d] = (first[d] + cell[d]) & 1
                    odd += flip[d]
                for p in range(3):
                    for side in range(2):
                        q, r = (p + 1) % 3, (p + 2) % 3
                        if side:
                            q, r = r, q
                        tet_nodes(slot, cell, flip, p, q, r, node)
                        if node[0] < 0 or node[1] < 0 or node[2] < 0 or node[3] < 0:
                            continue
                        if write:
                            turned = (side + odd) & 1
                            out[count, 0] = node[0]
                            out[count, 1] = node[1]
                            out[count, 2] = node[3] if turned else node[2]
                            out[count, 3] = node[2] if turned else node[3]
                        count += 1
    return count


@kernel
def spline_coefficients(slot, depth, coefficient):
    """Write the coefficients (m,) whose quadratic B-spline passes the nodes' depths to third order.

    c = d - (1/8) sum over axes of the second difference, for the axes along which both neighbours are numbered.
    """
    nx, ny, nz = slot.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                m = slot[i, j, k]
                if m < 0:
                    continue
                coefficient[m] = depth[m]
                for d in range(3):
                    a = (i, j, k)[d]
                    if a == 0 or a == slot.shape[d] - 1:
                        continue
                    low = slot[i - (d == 0), j - (d == 1), k - (d == 2)]
                    high = slot[i + (d == 0), j + (d == 1), k + (d == 2)]
                    if low >= 0 and high >= 0:
                        coefficient[m] -= 0.125 * (depth[low] - 2.0 * depth[m] + depth[high])


@kernel(inline=True)
def bell(t, a):
    """Return the quadratic B-spline of node `a` (-1, 0, 1) at `t` in [-1/2, 1/2], and its slope."""
    if a == 0:
        return 0.75 - t * t, -2.0 * t
    s = 0.5 + a * t
    return 0.5 * s * s, a * s


@kernel
def sample_spline(table, ux, uy, uz, out):
    """Return where the lattice point (ux, uy, uz) is; write the spline's depth and gradient there to `out` (4,)."""
    i0, j0, k0 = int(ux + 0.5), int(uy + 0.5), int(uz + 0.5)
    nx, ny, nz = table.slot.shape
    if not (i0 >= 1 and j0 >= 1 and k0 >= 1 and i0 < nx - 1 and j0 < ny - 1 and k0 < nz - 1):
        return OUTSIDE
    value, gx, gy, gz = 0.0, 0.0, 0.0, 0.0
    for i in range(-1, 2):
        wx, sx = bell(ux - i0, i)
        for j in range(-1, 2):
            wy, sy = bell(uy - j0, j)
            for k in range(-1, 2):
                m = table.slot[i0 + i, j0 + j, k0 + k]
                if m < 0:
                    return BURIED if m == DEEP else OUTSIDE
                wz, sz = bell(uz - k0, k)
                c = table.coefficient[m]
                value += wx * wy * wz * c
                gx += sx * wy * wz * c
                gy += wx * sy * wz * c
                gz += wx * wy * sz * c
    out[0] = value
    out[1] = gx / table.spacing[0]
    out[2] = gy / table.spacing[0]
    out[3] = gz / table.spacing[0]
    return WITHIN


@kernel
def sample_nearest(table, x, y, z, cell, linear, out):
    """Write the exact depth below the triangles around those nearest to the cube's corners, and the direction, to `out`.

    From the best of these triangles on, all that share a corner with it are tried, until none is nearer.
    linear : [mm] depth between the nodes, which tells the side when it is more than half a spacing
    """
    least = math.inf
    best = 0
    for a in range(8):
        m = table.slot[cell[0] + (a & 1), cell[1] + (a >> 1 & 1), cell[2] + (a >> 2)]
        if m >= 0:
            d = triangle_distance2(x, y, z, table.corners, table.triangle[m])
            if d < least:
                least = d
                best = table.triangle[m]
    for _ in range(MOST_RINGS):
        middle = best
        for q in range(table.ring_start[middle], table.ring_start[middle + 1]):
            d = triangle_distance2(x, y, z, table.corners, table.ring[q])
            if d < least:
                least = d
                best = table.ring[q]
        if best == middle:
            break
    inside, d, dx, dy, dz = inward(x, y, z, table.corners, best, table.face, table.edge, table.vertex)
    if abs(linear) > 0.5 * table.spacing[0]:
        inside = linear > 0.0
    out[0] = d if inside else -d
    if d > 1e-9:
        size = 1.0 / out[0]
        out[1], out[2], out[3] = size * dx, size * dy, size * dz
    else:
        out[1], out[2], out[3] = -table.face[best, 0], -table.face[best, 1], -table.face[best, 2]


@kernel
def sample(table, x, y, z, how, cell, flip, node, out):
    """Return where a point of the bone's rest frame is; write depth and gradient there to `out` (4,) if it is WITHIN.

    LINEAR : eqs 7-9, d = sum_a l_a d_a in a tetrahedron, its gradient constant there
    MEAN : the same depth, but the direction is the unit mean of the nodes' mean gradients, which does not jump
    SPLINE : the quadratic B-spline over the lattice's nodes, with its exact gradient, which is continuous
    NEAREST : the exact distance to the triangles near those that are nearest to the corners of the cube
    cell (3,), flip (3,), node (4,) are scratch.
    """
    h = table.spacing[0]
    ux, uy, uz = x / h - table.first[0], y / h - table.first[1], z / h - table.first[2]
    nx, ny, nz = table.slot.shape
    if not (ux >= 0.0 and uy >= 0.0 and uz >= 0.0 and ux < nx - 1 and uy < ny - 1 and uz < nz - 1):
        return OUTSIDE
    if how == SPLINE:
        return sample_spline(table, ux, uy, uz, out)
    cell[0], cell[1], cell[2] = int(ux), int(uy), int(uz)
    for d in range(3):
        flip[d] = (table.first[d] + cell[d]) & 1
    fx, fy, fz = ux - cell[0], uy - cell[1], uz - cell[2]
    fx = 1.0 - fx if flip[0] else fx
    fy = 1.0 - fy if flip[1] else fy
    fz = 1.0 - fz if flip[2] else fz
    p, q, r = order_of(fx, fy, fz)
    tet_nodes(table.slot, cell, flip, p, q, r, node)
    if node[0] < 0 or node[1] < 0 or node[2] < 0 or node[3] < 0:
        return BURIED if node[0] == DEEP or node[1] == DEEP or node[2] == DEEP or node[3] == DEEP else OUTSIDE
    fp = fx if p == 0 else (fy if p == 1 else fz)
    fq = fx if q == 0 else (fy if q == 1 else fz)
    fr = fx if r == 0 else (fy if r == 1 else fz)
    d0, d1, d2, d3 = table.depth[node[0]], table.depth[node[1]], table.depth[node[2]], table.depth[node[3]]
    out[0] = (1.0 - fp) * d0 + (fp - fq) * d1 + (fq - fr) * d2 + fr * d3
    if how == NEAREST:
        sample_nearest(table, x, y, z, cell, out[0], out)
        return WITHIN
    if how == LINEAR:
        out[1 + p] = (1 - 2 * flip[p]) * (d1 - d0) / h
        out[1 + q] = (1 - 2 * flip[q]) * (d2 - d1) / h
        out[1 + r] = (1 - 2 * flip[r]) * (d3 - d2) / h
        return WITHIN
    length = 0.0
    for d in range(3):
        g = table.gradient
        mean = (1.0 - fp) * g[node[0], d] + (fp - fq) * g[node[1], d]
        out[1 + d] = mean + (fq - fr) * g[node[2], d] + fr * g[node[3], d]
        length += out[1 + d] ** 2
    for d in range(3):
        out[1 + d] /= math.sqrt(length + 1e-300)
    return WITHIN


@kernel
def point_depths(table, points, nearest, cell, flip, node, read, out):
    """Write the signed distance of `points` (n, 3) to their nearest triangles (n,), positive inside, to `out` (n,) [mm].

    Where the pseudo-normals and the lattice disagree about the side, the winding number decides. cell (3,), flip (3,),
    node (4,), read (4,) are scratch.
    """
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        inside, d, _, _, _ = inward(x, y, z, table.corners, nearest[i], table.face, table.edge, table.vertex)
        state = sample(table, x, y, z, LINEAR, cell, flip, node, read)
        if (read[0] > 0.0 if state == WITHIN else state == BURIED) != inside:
            inside = winding(x, y, z, table.corners) > 0.5
        out[i] = d if inside else -d


@kernel
def sample_points(table, points, how, cell, flip, node, out, state):
    """Sample the field at `points` (n, 3) of its rest frame: depth and gradient to `out` (n, 4), place to `state` (n,)."""
    for i in range(len(points)):
        state[i] = sample(table, points[i, 0], points[i, 1], points[i, 2], how, cell, flip, node, out[i])
