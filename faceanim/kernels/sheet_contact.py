"""How deep the vertices of one sheet of skin are in the gap kept before another sheet's triangles."""

from __future__ import annotations

import math

from faceanim.ground.jit import kernel
from faceanim.kernels.contact import DEEPEST, bound_triangles, nearest_triangle, triangle_side, vertex_normals


@kernel
def sheet_depths(x, sheets, ball, looks, depth, corner, weight, normal):
    """Write how much nearer than its gap each vertex is to the other sheet, and the point there that is nearest.

    The signed distance s is the exact distance to the triangles, negative behind; depth = gap - s. Its derivative is
    -n by the vertex and +w n by the corners, n = `normal`: what moves the nearest point along the sheet does not
    change the distance. Behind is what the interpolated vertex normals turn their back on. A vertex behind but rather
    beside, and one deeper than DEEPEST, has left the sheet: depth -infinity.
    x (n, 3), sheets: see `elements.sheet_contact.SheetTable`, ball (t, 4), looks (n, 3) scratch
    out: depth (c,) [mm], corner (c, 3) vertices of the triangle, weight (c, 3), normal (c, 3)
    """
    bound_triangles(x, sheets.corners, ball)
    vertex_normals(x, sheets.corners, looks)
    for c in range(len(sheets.pair_node)):
        depth[c] = -math.inf
        if sheets.pair_start[c] == sheets.pair_start[c + 1]:
            continue
        i = sheets.pair_node[c]
        first = sheets.pair_triangle[sheets.pair_start[c]]
        t, wa, wb, wc, _ = nearest_triangle(x, i, sheets, c, first, ball)
        j, k, l = sheets.corners[t, 0], sheets.corners[t, 1], sheets.corners[t, 2]
        dx, dy, dz, _, _, _, _ = triangle_side(x, i, j, k, l, wa, wb, wc)
        nx = wa * looks[j, 0] + wb * looks[k, 0] + wc * looks[l, 0]
        ny = wa * looks[j, 1] + wb * looks[k, 1] + wc * looks[l, 1]
        nz = wa * looks[j, 2] + wb * looks[k, 2] + wc * looks[l, 2]
        length = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz + 1e-300)
        s = (nx * dx + ny * dy + nz * dz) * length
        r = math.sqrt(dx * dx + dy * dy + dz * dz)
        if s < 0.0 and (r > DEEPEST or r * r > 2.0 * s * s):
            continue
        side = 1.0 if s >= 0.0 else -1.0
        depth[c] = sheets.pair_gap[c] - side * r
        if r > 1e-10:
            normal[c, 0], normal[c, 1], normal[c, 2] = side * dx / r, side * dy / r, side * dz / r
        else:
            normal[c, 0], normal[c, 1], normal[c, 2] = nx * length, ny * length, nz * length
        corner[c, 0], corner[c, 1], corner[c, 2] = j, k, l
        weight[c, 0], weight[c, 1], weight[c, 2] = wa, wb, wc
