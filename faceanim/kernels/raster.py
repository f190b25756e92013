"""Rasteriser: triangles to anti-aliased pixels, in three passes over bare arrays.

1. `place_pass` and `setup_pass`: vertex normals, projection, culling, plane equations, and the depth seen from the
   key light; `band_pass` then sorts the triangles into horizontal bands.
2. `coverage_pass`: four rotated-grid samples a pixel, each with the depth and the index of the nearest triangle.
   Edges are integers in 1/256 pixel, so that neighbouring triangles neither overlap nor leave a gap.
3. `shade.shade_pass`: each pixel is shaded once for every surface seen in it, weighted by the samples covered.

Bands of rows are independent and visit their triangles in a fixed order: the picture does not depend on the number of
threads. Camera space has x to the right, y up and z away from the eye; a pixel's ray is (rx, ry, 1), and the sums
w_i = E_i . ray of a triangle are its barycentric coordinates divided by depth, even if it crosses the near plane.
What is called for every triangle or pixel is inlined by force: handing over descriptors of arrays costs more than it does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import get_thread_id  # type: ignore[attr-defined]

from faceanim.ground.jit import kernel, prange
from faceanim.kernels.memory import load
from faceanim.kernels.shadow import cast_piece, moment_strip

BAND = 16
PIECES = 8  # tasks of the pass over triangles; each takes every eighth chunk
CHUNK = 128
SUB = 256
HALF = SUB // 2
REACH = 96
FAR_PIXEL = float(1 << 20)
BEHIND = -(1 << 30)
DEEPEST = float(1 << 30)
FINE = 12  # further bits of a depth number while it is stepped from pixel to pixel
STEEPEST = float(1 << 46)
TOP = (1 << 30) - 1
LONG = 24  # bits of an edge [1/256 pixel] up to which its side of a sample is exact
BLOCK = 16  # samples of four neighbouring pixels

# Offsets, in eighths of a pixel, of the samples of a block from the centre of its first pixel.
_RIGHT = np.array([8 * i + s for i in range(4) for s in (-1, 3, 1, -3)], dtype=np.int64)
_DOWN = np.array([s for i in range(4) for s in (-3, -1, 3, 1)], dtype=np.int64)


class Mesh(NamedTuple):
    """The triangles of all items, one after the other.

    triangle : (t, 3) vertices   item : (t,)   texels : (t,) log2 of the texture's area in the triangle [texel]
    """

    triangle: np.ndarray
    item: np.ndarray
    texels: np.ndarray


class Fans(NamedTuple):
    """What surrounds the vertices of all items; a point is one vertex for each of its places in the texture.

    owner : (n,) item of each vertex   origin : (n,) its point
    start : (n + 1,), edge : (k, 2) points of the opposite edges of the triangles around each vertex
    """

    owner: np.ndarray
    origin: np.ndarray
    start: np.ndarray
    edge: np.ndarray


class Placed(NamedTuple):
    """Vertices as the camera sees them.

    eye : (n, 3) camera space [mm]   screen : (n, 2) [1/256 pixel]
    vertex : (n, 8) normal, occlusion, linear colour or place in the texture, depth
    """

    eye: np.ndarray
    screen: np.ndarray
    vertex: np.ndarray


class Faces(NamedTuple):
    """Triangles as the camera sees them.

    plane : (t, 16) rows E_i and the P_ columns
    deep : (t, 4) fine depth number: gradient in x and y, value at pixel (0, 0)
    corner : (t, 8) x and y on the screen, four corners if the near plane cuts it, else the last one twice [1/256 pixel]
    box : (t, 8) first and last pixel in x and y, least and largest depth number
    rank : (t,) 0 not seen, else 1 drawn first or 2 drawn then, with the first and last band from bits 2 and 17 on
    A depth number is DEEPEST * near / depth, a whole number up to DEEPEST.
    """

    plane: np.ndarray
    deep: np.ndarray
    corner: np.ndarray
    box: np.ndarray
    rank: np.ndarray


class Bands(NamedTuple):
    """Triangles by band of rows and rank: `member` (k,), those of bin 2 band + rank - 1 from `start` (bins + 1,) on."""

    start: np.ndarray
    member: np.ndarray


class Samples(NamedTuple):
    """Work space in which a band is covered.

    sample : (slots, BAND, ceil(w / 4), 2 BLOCK) depth numbers (0 = none) and triangles of the samples of a block
    least : (slots, BAND, ceil(w / 4)) smallest depth number of a block   lane : (slots, 4, BLOCK)
    """

    sample: np.ndarray
    least: np.ndarray
    lane: np.ndarray


class Seen(NamedTuple):
    """What is seen in the picture.

    nearest : (h, w) depth number of the nearest sample, 0 = none
    fragment : (h, N_WHOLE, row_length) pixel, triangle and number of samples of each surface seen in each row, from
    left to right; `found` (h,) of them
    """

    nearest: np.ndarray
    fragment: np.ndarray
    found: np.ndarray


def _aligned(shape: tuple[int, ...], kind: type) -> np.ndarray:
    """Return zeros that start at a cache line, so that rows of 32 or 64 bytes do not straddle two."""
    size, count = np.dtype(kind).itemsize, int(np.prod(shape))
    raw: np.ndarray = np.zeros(count + 64 // size, kind)
    skip = (-raw.ctypes.data % 64) // size
    return raw[skip : skip + count].reshape(shape)


def row_length(width: int) -> int:
    """Return room for the fragments of a row of pixels: an odd number of cache lines, that tables spread in the cache."""
    return 16 * (width // 4 + 1 | 1)


def placed_buffers(n: int) -> Placed:
    """Return room for n vertices."""
    return Placed(np.zeros((n, 3)), np.zeros((n, 2), np.int32), _aligned((n, 8), np.float32))


def face_buffers(t: int) -> Faces:
    """Return room for t triangles."""
    return Faces(
        plane=_aligned((t, 16), np.float32),
        deep=_aligned((t, 4), np.float64),
        corner=_aligned((t, 8), np.int32),
        box=_aligned((t, 8), np.int32),
        rank=np.zeros(t, np.int32),
    )


def band_buffers(height: int, room: int) -> Bands:
    """Return lists of triangles for a picture of that height [pixel]; `band_pass` says how much room they need."""
    return Bands(np.zeros(2 * -(-height // BAND) + 1, np.int32), np.zeros(room, np.int32))


def sample_buffers(slots: int, width: int, lanes: int = 0) -> Samples:
    """Return room for so many bands of a picture of that width [pixel], covered by as many threads, or by `lanes`."""
    threads, blocks = lanes or slots, (width + 3) // 4
    return Samples(
        sample=_aligned((slots, BAND, blocks, 2 * BLOCK), np.int32),
        least=np.zeros((threads, BAND, blocks), np.int32),
        lane=_aligned((threads, 4, BLOCK), np.int32),
    )


def seen_buffers(width: int, height: int) -> Seen:
    """Return room for what is seen in a picture of that size [pixel]."""
    return Seen(
        nearest=np.zeros((height, width), np.int32),
        fragment=np.zeros((height, N_WHOLE, row_length(width)), np.int32),
        found=np.zeros(height, np.int32),
    )


class Paint(NamedTuple):
    """What gives colour.

    material : (m, N_MATERIAL), columns as the M_ constants, `material32` the same in float32
    light : (LIGHTS, 6) direction towards the light in camera space, linear colour   ambient : (3, 3) sky, ground,
    reflected surroundings (float32)   texel : (q,) words of all mip levels, 10 bits each of the square root of linear
    red (lowest), green, blue   level : (textures, levels, 3) first texel, width, height   level_count : (textures,)
    encode : (ENCODE,) linear to sRGB byte   background : (h, 3) linear
    """

    material: np.ndarray
    material32: np.ndarray
    light: np.ndarray
    ambient: np.ndarray
    texel: np.ndarray
    level: np.ndarray
    level_count: np.ndarray
    encode: np.ndarray
    background: np.ndarray


M_SOURCE = 0  # 0 uniform colour, 1 texture, 2 colour per vertex
M_TEXTURE = 1
M_SPECULAR = 2  # reflectance at normal incidence
M_ROUGH = 3  # squared roughness of the highlight
M_WRAP = 4  # 4, 5, 6: how far diffuse light wraps round, red, green, blue
M_SIDED = 7  # 0 front only, 1 both
M_BACK = 8  # brightness of the back side
M_SHADE_RADIUS = 9  # [mm] radius of the screen-space contact shade, 0 = none
M_SHADE = 10  # its strength
M_WIRE = 11  # line width [pixel], 0 = none
M_FLAT = 12  # 0 lit, 1 unlit
M_LAYER = 13
M_GLOW = 14  # 14, 15, 16: light that reaches closed places all the same, red, green, blue
M_MATTE = 17  # how much less the dark parts (hair on skin) shine
N_MATERIAL = 18

LIGHTS = 3
ENCODE = 8192
ENCODE_TOP = 2.0
"""The encoding table spans linear values [0, ENCODE_TOP)."""

P_MIP, P_SIDE = 9, 10
W_PIXEL, W_TRIANGLE, W_SAMPLES, N_WHOLE = 0, 1, 2, 3

# Samples of one item in one pixel share a colour if their depths differ by less than a part of 1/1024, or by less than
# SAME_DEPTH where the cosine between their triangles is above SAME_TURN.
SAME_DEPTH, SAME_TURN = 0.006, 0.8

# Camera numbers, one array: 9 rows of the rotation, 3 position, focal length [pixel], centre x, centre y, near [mm].
C_POSITION, C_FOCAL, C_X, C_Y, C_NEAR = 9, 12, 13, 14, 15
N_CAMERA = 16


# ---------------------------------------------------------------------------------------------------- vertices


@kernel
def carry(rest, pose, out):
    """Put points `rest` (n, 3), moved by `pose` (4, 4), into `out`."""
    for i in range(rest.shape[0]):
        x, y, z = rest[i, 0], rest[i, 1], rest[i, 2]
        for r in range(3):
            out[i, r] = pose[r, 0] * x + pose[r, 1] * y + pose[r, 2] * z + pose[r, 3]


@kernel(inline=True)
def project(camera, x, y, z):
    """Screen position [1/256 pixel, rounded] of a camera-space point; x is BEHIND if it lies before the near plane."""
    if z < camera[C_NEAR]:
        return np.int64(BEHIND), np.int64(0)
    f = camera[C_FOCAL] / z
    sx = min(max(camera[C_X] + f * x, -FAR_PIXEL), FAR_PIXEL)
    sy = min(max(camera[C_Y] - f * y, -FAR_PIXEL), FAR_PIXEL)
    return np.int64(np.floor(sx * SUB + 0.5)), np.int64(np.floor(sy * SUB + 0.5))


@kernel(inline=True)
def _normal(i, origin, start, edge, points):
    """Sum of the normals of the triangles around vertex i, scaled by twice their area [mm^2]."""
    p = origin[i]
    x, y, z = points[p, 0], points[p, 1], points[p, 2]
    nx, ny, nz = 0.0, 0.0, 0.0
    for k in range(start[i], start[i + 1]):
        b, c = edge[k, 0], edge[k, 1]
        ux, uy, uz = points[b, 0] - x, points[b, 1] - y, points[b, 2] - z
        vx, vy, vz = points[c, 0] - x, points[c, 1] - y, points[c, 2] - z
        nx += uy * vz - uz * vy
        ny += uz * vx - ux * vz
        nz += ux * vy - uy * vx
    return nx, ny, nz


@kernel
def place_pass(moved, fans, points, camera, placed, caster):
    """Normals and places in camera space, on the screen and in the shadow map of moved items' vertices.

    points : (p, 3) [mm], finite
    """
    start, edge, owner, origin = fans.start, fans.edge, fans.owner, fans.origin
    eye, screen, vertex = placed.eye, placed.screen, placed.vertex
    casts, to_map, spot = caster.casts, caster.to_map, caster.spot
    for i in range(owner.shape[0]):
        if not moved[owner[i]]:
            continue
        nx, ny, nz = _normal(i, origin, start, edge, points)
        scale = 1.0 / np.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-30))
        p = origin[i]
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        dx, dy, dz = x - camera[C_POSITION], y - camera[C_POSITION + 1], z - camera[C_POSITION + 2]
        for r in range(3):
            vertex[i, r] = scale * (camera[3 * r] * nx + camera[3 * r + 1] * ny + camera[3 * r + 2] * nz)
            eye[i, r] = camera[3 * r] * dx + camera[3 * r + 1] * dy + camera[3 * r + 2] * dz
        vertex[i, 7] = eye[i, 2]
        screen[i, 0], screen[i, 1] = project(camera, eye[i, 0], eye[i, 1], eye[i, 2])
        if casts[owner[i]]:
            for r in range(3):
                spot[i, r] = to_map[r, 0] * x + to_map[r, 1] * y + to_map[r, 2] * z + to_map[r, 3]


# ----------------------------------------------------------------------------------------------------- triangles


@kernel
def _crossing(camera, eye, i, j):
    """Screen position of the point where edge (i, j) meets the near plane."""
    near = camera[C_NEAR]
    s = (near - eye[i, 2]) / (eye[j, 2] - eye[i, 2])
    return project(camera, eye[i, 0] + s * (eye[j, 0] - eye[i, 0]), eye[i, 1] + s * (eye[j, 1] - eye[i, 1]), near)


@kernel
def _clip(camera, eye, screen, a, b, c):
    """Corners (3 or 4) on the screen of a triangle cut by the near plane, in the order of a, b, c."""
    near = camera[C_NEAR]
    ia, ib, ic = eye[a, 2] >= near, eye[b, 2] >= near, eye[c, 2] >= near
    if int(ia) + int(ib) + int(ic) == 1:
        while not ia:
            a, b, c = b, c, a
            ia, ib, ic = ib, ic, ia
        x1, y1 = _crossing(camera, eye, a, b)
        x2, y2 = _crossing(camera, eye, a, c)
        return np.int64(screen[a, 0]), np.int64(screen[a, 1]), x1, y1, x2, y2, x2, y2
    while ic:
        a, b, c = b, c, a
        ia, ib, ic = ib, ic, ia
    x2, y2 = _crossing(camera, eye, b, c)
    x3, y3 = _crossing(camera, eye, a, c)
    xa, ya = np.int64(screen[a, 0]), np.int64(screen[a, 1])
    return xa, ya, np.int64(screen[b, 0]), np.int64(screen[b, 1]), x2, y2, x3, y3


@kernel(inline=True)
def _corners(camera, eye, screen, a, b, c):
    """Corners on the screen of a triangle as (x0, y0, ..., x3, y3); the last two are one unless the near plane cuts it.

    A triangle wholly before the near plane has no extent.
    """
    x0, y0 = np.int64(screen[a, 0]), np.int64(screen[a, 1])
    x1, y1 = np.int64(screen[b, 0]), np.int64(screen[b, 1])
    x2, y2 = np.int64(screen[c, 0]), np.int64(screen[c, 1])
    x3, y3 = x2, y2
    if min(x0, x1, x2) == BEHIND:
        if max(x0, x1, x2) == BEHIND:
            return x0, y0, x0, y0, x0, y0, x0, y0
        x0, y0, x1, y1, x2, y2, x3, y3 = _clip(camera, eye, screen, a, b, c)
    return x0, y0, x1, y1, x2, y2, x3, y3


@kernel(inline=True)
def _planes(camera, eye, a, b, c, t, plane, deep, box):
    """Fill the plane equations of triangle t; return its determinant, zero if it is seen edge-on."""
    ax, ay, az = eye[a, 0], eye[a, 1], eye[a, 2]
    bx, by, bz = eye[b, 0], eye[b, 1], eye[b, 2]
    cx, cy, cz = eye[c, 0], eye[c, 1], eye[c, 2]
    e0x, e0y, e0z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    e1x, e1y, e1z = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    e2x, e2y, e2z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    det = ax * e0x + ay * e0y + az * e0z
    if det == 0.0:
        return 0.0
    s = 1.0 / det
    plane[t, 0], plane[t, 1], plane[t, 2] = s * e0x, s * e0y, s * e0z
    plane[t, 3], plane[t, 4], plane[t, 5] = s * e1x, s * e1y, s * e1z
    plane[t, 6], plane[t, 7], plane[t, 8] = s * e2x, s * e2y, s * e2z
    unit = (1 << FINE) * DEEPEST * camera[C_NEAR]
    gx = s * (e0x + e1x + e2x) * unit / camera[C_FOCAL]
    gy = -s * (e0y + e1y + e2y) * unit / camera[C_FOCAL]
    gx, gy = min(max(gx, -STEEPEST), STEEPEST), min(max(gy, -STEEPEST), STEEPEST)
    deep[t, 0], deep[t, 1] = 8.0 * np.floor(0.125 * gx), 8.0 * np.floor(0.125 * gy)
    deep[t, 2] = s * (e0z + e1z + e2z) * unit - gx * camera[C_X] - gy * camera[C_Y]
    unit = DEEPEST * camera[C_NEAR]
    box[t, 4], box[t, 5] = max(unit / max(az, bz, cz), 1.0), unit / max(min(az, bz, cz), camera[C_NEAR])
    return det


@kernel(inline=True)
def _holds_sample(left, right, top, bottom):
    """Whether a box, relative to the corner of a pixel [1/256 pixel], holds one of the pixel's four samples."""
    a, b, c, d = HALF - REACH, HALF - REACH // 3, HALF + REACH // 3, HALF + REACH
    return (
        (left <= b <= right and top <= a <= bottom)
        or (left <= d <= right and top <= b <= bottom)
        or (left <= c <= right and top <= d <= bottom)
        or (left <= a <= right and top <= c <= bottom)
    )


@kernel(inline=True)
def _box(x0, y0, x1, y1, x2, y2, x3, y3, width, height):
    """First and last pixel in x and y of which a sample may lie between these corners; empty if there is none."""
    left, right = min(x0, x1, x2, x3), max(x0, x1, x2, x3)
    top, bottom = min(y0, y1, y2, y3), max(y0, y1, y2, y3)
    lo_x, hi_x = max((left - HALF - REACH + SUB - 1) >> 8, 0), min((right - HALF + REACH) >> 8, width - 1)
    lo_y, hi_y = max((top - HALF - REACH + SUB - 1) >> 8, 0), min((bottom - HALF + REACH) >> 8, height - 1)
    if lo_x == hi_x and lo_y == hi_y:
        if not _holds_sample(left - SUB * lo_x, right - SUB * lo_x, top - SUB * lo_y, bottom - SUB * lo_y):
            return np.int64(1), np.int64(0), np.int64(1), np.int64(0)
    return np.int64(lo_x), np.int64(hi_x), np.int64(lo_y), np.int64(hi_y)


@kernel
def _set_up_piece(piece, layer, moved, camera, mesh, placed, faces, material):
    """`setup_pass` for every PIECES-th chunk of triangles."""
    triangle, item, texels = mesh.triangle, mesh.item, mesh.texels
    eye, screen, plane, deep = placed.eye, placed.screen, faces.plane, faces.deep
    corner, box, rank = faces.corner, faces.box, faces.rank
    width, height = int(2.0 * camera[C_X]), int(2.0 * camera[C_Y])
    for first in range(piece * CHUNK, triangle.shape[0], PIECES * CHUNK):
        for t in range(first, min(first + CHUNK, triangle.shape[0])):
            m = item[t]
            if not moved[m]:
                continue
            rank[t] = 0
            if material[m, M_LAYER] != layer:
                continue
            a, b, c = triangle[t, 0], triangle[t, 1], triangle[t, 2]
            x0, y0, x1, y1, x2, y2, x3, y3 = _corners(camera, eye, screen, a, b, c)
            # Twice the area on the screen, whose y points down, so that a front has a negative sign.
            area = (x2 - x0) * (y3 - y1) - (x3 - x1) * (y2 - y0)
            if area == 0 or (area > 0 and material[m, M_SIDED] == 0.0):
                continue
            lo_x, hi_x, lo_y, hi_y = _box(x0, y0, x1, y1, x2, y2, x3, y3, width, height)
            if lo_x > hi_x or lo_y > hi_y or _planes(camera, eye, a, b, c, t, plane, deep, box) == 0.0:
                continue
            plane[t, P_SIDE] = 1.0 if area < 0 else -1.0
            if material[m, M_SOURCE] == 1.0:
                plane[t, P_MIP] = 0.5 * (texels[t] - np.log2(max(0.5 * abs(area) / (SUB * SUB), 1e-3)))
            box[t, 0], box[t, 1], box[t, 2], box[t, 3] = lo_x, hi_x, lo_y, hi_y
            if area > 0:
                x1, y1, x3, y3 = x3, y3, x1, y1
            corner[t, 0], corner[t, 1], corner[t, 2], corner[t, 3] = x0, y0, x1, y1
            corner[t, 4], corner[t, 5], corner[t, 6], corner[t, 7] = x2, y2, x3, y3
            rank[t] = (1 if area < 0 and m == item[0] else 2) | lo_y // BAND << 2 | hi_y // BAND << 17


@kernel(parallel=True)
def setup_pass(layer, moved, camera, mesh, placed, faces, material, cast, caster):
    """Cull the triangles of moved items in one layer; fill planes, mip levels and boxes of those that may be seen.

    cast : whether to draw the depth seen from the key light as well
    """
    for piece in prange(PIECES):
        _set_up_piece(np.int64(piece), layer, moved, camera, mesh, placed, faces, material)
        if cast:
            cast_piece(np.int64(piece), caster)


@kernel
def band_pass(rank, bands):
    """Sort visible triangles by band of rows, rank and index; return the room that needs."""
    row_start, row_list = bands.start, bands.member
    bins = row_start.shape[0] - 1
    for k in range(bins + 1):
        row_start[k] = 0
    for t in range(rank.shape[0]):
        r = rank[t]
        if r > 0:
            for k in range((r >> 2) & 0x7FFF, (r >> 17) + 1):
                row_start[2 * k + (r & 3)] += 1
    for k in range(bins):
        row_start[k + 1] += row_start[k]
    need = row_start[bins]
    if need > row_list.shape[0]:
        return need
    for t in range(rank.shape[0]):
        r = rank[t]
        if r > 0:
            for k in range((r >> 2) & 0x7FFF, (r >> 17) + 1):
                at = 2 * k + (r & 3) - 1
                row_list[row_start[at]] = t
                row_start[at] += 1
    for k in range(bins, 0, -1):
        row_start[k] = row_start[k - 1]
    row_start[0] = 0
    return need


# ------------------------------------------------------------------------------------------------------ coverage


@kernel(inline=True)
def _edge(xa, ya, xb, yb, px, py):
    """Edge function of a -> b at (px, py), >= 0 to its left as seen on the screen; a tie goes to one side only."""
    dx, dy = xb - xa, yb - ya
    e = dy * (px - xa) - dx * (py - ya)
    return e if dy > 0 or (dy == 0 and dx > 0) else e - 1


@kernel(inline=True)
def _largest(a, b):
    """Largest step of a linear function over the 16 samples of a block; a, b: steps by an eighth of a pixel."""
    return max(-a - 3 * b, 3 * a - b, a + 3 * b, -3 * a + b) + max(24 * a, 0)


@kernel
def _least(lo, hi, sample, least):
    """Note the smallest depth number in each block lo..hi of a band, so that what lies behind can be left out."""
    for y in range(BAND):
        for u in range(lo, hi + 1):
            low = sample[y, u, 0]
            for q in range(1, BLOCK):
                s = sample[y, u, q]
                low = s if s < low else low
            least[y, u] = low


@kernel(inline=True)
def _hidden(lo, hi, first, last, most, least):
    """Whether nothing at most as near as the depth number `most` can be seen in these blocks."""
    for y in range(first, last + 1):
        for u in range(lo, hi + 1):
            if least[y, u] < most:
                return False
    return True


@kernel(inline=True)
def _fill_lanes(dx0, dy0, dx1, dy1, dx2, dy2, gx, gy, lane):
    """Change of edge functions and depth number from the start of a block to each of its samples; see `_cover`."""
    for q in range(BLOCK):
        right, down = _RIGHT[q], _DOWN[q]
        lane[0, q] = dy0 * right - dx0 * down
        lane[1, q] = dy1 * right - dx1 * down
        lane[2, q] = dy2 * right - dx2 * down
        lane[3, q] = min(max((gx * right + gy * down) >> FINE, -TOP), TOP)


@kernel(inline=True)
def _cover_block(e0, e1, e2, z, low, high, name, lane, row, u, sample):
    """Write the samples of block u of a row; edge functions and depth number hold at its start."""
    for q in range(BLOCK):
        s0, s1, s2 = np.int32(e0 + lane[0, q]), np.int32(e1 + lane[1, q]), np.int32(e2 + lane[2, q])
        near = np.int32(z + lane[3, q])
        near = near if near > low else low
        near = near if near < high else high
        near = near if (s0 | s1 | s2) >= 0 else np.int32(0)
        old, other = sample[row, u, q], sample[row, u, BLOCK + q]
        sample[row, u, BLOCK + q] = name if near > old else other
        sample[row, u, q] = near if near > old else old


@kernel(inline=True)
def _cover(x0, y0, x1, y1, x2, y2, lo_x, hi_x, lo_y, hi_y, z, gx, gy, least, most, t, base, lane, sample):
    """Write the samples of screen triangle t (positive orientation) that are nearer than what is there.

    z : fine depth number at the centre of pixel (lo_x & ~3, lo_y), gx, gy its steps   least, most : its limits
    base : first row of `sample`   lane : (4, BLOCK) work space
    Edge functions are whole numbers of 32 units between samples, so that floor(e / 32) tells their sides exactly; this
    lets a block be tested in 32-bit lanes. Edges longer than 2^LONG are rounded a little more.
    """
    lo_x &= ~3
    dx0, dy0, dx1, dy1, dx2, dy2 = x1 - x0, y1 - y0, x2 - x1, y2 - y1, x0 - x2, y0 - y2
    shift = 0
    while max(abs(dx0), abs(dy0), abs(dx1), abs(dy1), abs(dx2), abs(dy2)) >> shift >= 1 << LONG:
        shift += 1
    d0, d1, d2, d3, d4, d5 = dx0 >> shift, dy0 >> shift, dx1 >> shift, dy1 >> shift, dx2 >> shift, dy2 >> shift
    _fill_lanes(d0, d1, d2, d3, d4, d5, gx >> 3, gy >> 3, lane)
    m0, m1, m2 = _largest(dy0, -dx0), _largest(dy1, -dx1), _largest(dy2, -dx2)
    px, py = lo_x * SUB + HALF, lo_y * SUB + HALF
    r0, r1, r2 = _edge(x0, y0, x1, y1, px, py), _edge(x1, y1, x2, y2, px, py), _edge(x2, y2, x0, y0, px, py)
    r0, r1, r2 = r0 >> 5, r1 >> 5, r2 >> 5
    name = np.int32(t)
    for y in range(lo_y, hi_y + 1):
        e0, e1, e2, d, inside = r0, r1, r2, z, False
        for u in range(lo_x >> 2, (hi_x >> 2) + 1):
            if ((e0 + m0) | (e1 + m1) | (e2 + m2)) >= 0:
                f0, f1, f2 = (
                    np.int32(min(e0 >> shift, TOP)),
                    np.int32(min(e1 >> shift, TOP)),
                    np.int32(min(e2 >> shift, TOP)),
                )
                f3 = np.int32(min(max(d >> FINE, -TOP), TOP))
                _cover_block(f0, f1, f2, f3, least, most, name, lane, y - base, u, sample)
                inside = True
            elif inside:
                break
            e0 += 32 * dy0
            e1 += 32 * dy1
            e2 += 32 * dy2
            d += 4 * gx
        r0 -= 8 * dx0
        r1 -= 8 * dx1
        r2 -= 8 * dx2
        z += gy


@kernel
def _draw_bin(at, first, last, faces, bands, lane, least, sample):
    """Draw the triangles of a bin into the rows first..last; those of the second rank only where they may be seen."""
    corner, box, deep = faces.corner, faces.box, faces.deep
    for k in range(bands.start[at], bands.start[at + 1]):
        t = bands.member[k]
        lo_x, hi_x = np.int64(box[t, 0]), np.int64(box[t, 1])
        lo_y, hi_y = max(np.int64(box[t, 2]), first), min(np.int64(box[t, 3]), last)
        low, most = box[t, 4], box[t, 5]
        if at & 1 and _hidden(lo_x >> 2, hi_x >> 2, lo_y - first, hi_y - first, most, least):
            continue
        x0, y0, x1, y1 = np.int64(corner[t, 0]), np.int64(corner[t, 1]), np.int64(corner[t, 2]), np.int64(corner[t, 3])
        x2, y2, x3, y3 = np.int64(corner[t, 4]), np.int64(corner[t, 5]), np.int64(corner[t, 6]), np.int64(corner[t, 7])
        gx, gy = np.int64(deep[t, 0]), np.int64(deep[t, 1])
        z = np.int64(deep[t, 2] + deep[t, 0] * ((lo_x & ~3) + 0.5) + deep[t, 1] * (lo_y + 0.5))
        for _ in range(1 + int(x3 != x2 or y3 != y2)):
            if (x0 != x1 or y0 != y1) and (x1 != x2 or y1 != y2):
                _cover(x0, y0, x1, y1, x2, y2, lo_x, hi_x, lo_y, hi_y, z, gx, gy, low, most, t, first, lane, sample)
            x1, y1, x2, y2 = x2, y2, x3, y3


@kernel
def _cover_band(band, lo, hi, height, faces, bands, lane, least, sample):
    """Clear the blocks lo..hi of one band of rows and draw its triangles into it, those of the first rank first."""
    first = band * BAND
    last = min(first + BAND, height) - 1
    sample[:, lo : hi + 1] = 0
    _draw_bin(2 * band, first, last, faces, bands, lane, least, sample)
    _least(lo, hi, sample, least)
    _draw_bin(2 * band + 1, first, last, faces, bands, lane, least, sample)


@kernel(inline=True)
def _alike(zi, zj, t, k, item, plane):
    """Whether two samples of a pixel, of triangles t and k with depth numbers zi and zj, may share one colour."""
    if item[t] != item[k] or abs(zi - zj) > SAME_DEPTH * zi:
        return False
    # The rows E_i add up to the normal, divided by the distance of the triangle's plane.
    ax, bx = plane[t, 0] + plane[t, 3] + plane[t, 6], plane[k, 0] + plane[k, 3] + plane[k, 6]
    ay, by = plane[t, 1] + plane[t, 4] + plane[t, 7], plane[k, 1] + plane[k, 4] + plane[k, 7]
    az, bz = plane[t, 2] + plane[t, 5] + plane[t, 8], plane[k, 2] + plane[k, 5] + plane[k, 8]
    turn = plane[t, P_SIDE] * plane[k, P_SIDE] * (ax * bx + ay * by + az * bz)
    square = (ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz)
    return turn > 0.0 and turn * turn >= SAME_TURN * SAME_TURN * square


@kernel(inline=True)
def _split_pixel(x, n, sample, item, plane, whole):
    """Add the fragments of a pixel that shows several surfaces after the first n of a row; return how many there are."""
    at, done = 2 * BLOCK * (x >> 2) + 4 * (x & 3), 0
    for i in range(4):
        zi, ti = load(sample, at + i), load(sample, at + BLOCK + i)
        if zi == 0 or (done >> i) & 1:
            continue
        count = 1
        for j in range(i + 1, 4):
            zj, tj = load(sample, at + j), load(sample, at + BLOCK + j)
            if zj > 0 and not (done >> j) & 1 and _alike(zi, zj, ti, tj, item, plane):
                count += 1
                done |= 1 << j
        whole[W_PIXEL, n], whole[W_TRIANGLE, n], whole[W_SAMPLES, n] = x, ti, count
        n += 1
    return n


@kernel
def _list_row(lo, hi, sample, item, plane, whole, nearest):
    """List the fragments of blocks lo..hi of a row of samples, from left to right; return how many there are."""
    n = np.int64(0)  # as a literal it would be compiled for twice
    for x in range(nearest.shape[0]):
        nearest[x] = 0
    for x in range(4 * lo, min(4 * hi + 4, nearest.shape[0])):
        at = 2 * BLOCK * (x >> 2) + 4 * (x & 3)
        z0, z1, z2, z3 = load(sample, at), load(sample, at + 1), load(sample, at + 2), load(sample, at + 3)
        low, high = min(z0, z1, z2, z3), max(z0, z1, z2, z3)
        if high == 0:
            continue
        nearest[x] = high
        at += BLOCK
        t0, t1, t2, t3 = load(sample, at), load(sample, at + 1), load(sample, at + 2), load(sample, at + 3)
        # Nearly always: samples close together on one item. One branch that is easy to foresee costs least.
        if low > 0 and (high - low) << 10 <= high:
            m = load(item, t0)
            if (m == load(item, t1)) & (m == load(item, t2)) & (m == load(item, t3)):
                whole[W_PIXEL, n], whole[W_TRIANGLE, n], whole[W_SAMPLES, n] = x, t0, 4
                n += 1
                continue
        n = _split_pixel(x, n, sample, item, plane, whole)
    return n


@kernel
def _extent(band, row_start, row_list, box, width):
    """First and last block of four pixels that the triangles of a band may touch."""
    lo, hi = width, -1
    for k in range(row_start[2 * band], row_start[2 * band + 2]):
        lo, hi = min(lo, box[row_list[k], 0]), max(hi, box[row_list[k], 1])
    return lo >> 2, hi >> 2


@kernel
def _cover_and_list(band, slot, listed, item, faces, bands, samples, seen):
    """`coverage_pass` for one band, by the thread of that slot."""
    height, width = seen.nearest.shape
    sample = samples.sample[slot if listed else band]
    lo, hi = 0, sample.shape[1] - 1
    if listed:
        lo, hi = _extent(band, bands.start, bands.member, faces.box, width)
    _cover_band(band, lo, hi, height, faces, bands, samples.lane[slot], samples.least[slot], sample)
    if listed:
        plane, fragment, found, nearest = faces.plane, seen.fragment, seen.found, seen.nearest
        for y in range(band * BAND, min((band + 1) * BAND, height)):
            found[y] = _list_row(lo, hi, sample[y - band * BAND], item, plane, fragment[y], nearest[y])


@kernel(parallel=True)
def coverage_pass(order, listed, item, faces, bands, samples, seen, depths):
    """Find the nearest triangle of every sample, band by band, and blur the shadow's depth, strip by strip.

    order : (k,) deals out the work to the threads: bands, then strips of the shadow
    listed : list fragments and nearest depths, samples live in the slot of the thread; else keep them, band b in slot b
    """
    count = bands.start.shape[0] // 2
    for k in prange(order.shape[0]):
        b, slot = order[k], get_thread_id()
        if b >= count:
            moment_strip(b - count, depths)
        else:
            _cover_and_list(b, slot, listed, item, faces, bands, samples, seen)
