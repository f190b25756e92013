"""Rasteriser: triangles to anti-aliased pixels, in three passes over bare arrays.

1. `vertex_pass` and `setup_pass`: vertex normals by gather, projection, culling, plane equations, horizontal bands.
2. `coverage_pass`: four rotated-grid samples a pixel, each with the depth and the name of the nearest triangle.
   Edges are integers in 1/256 pixel, so that neighbouring triangles neither overlap nor leave a gap.
3. `shade.shade_pass`: each pixel is shaded once for every surface seen in it, weighted by the samples covered.

Bands of rows are independent and visit their triangles in index order: the picture does not depend on the number of
threads. Camera space has x to the right, y up and z away from the eye; a pixel's ray is (rx, ry, 1), and the sums
w_i = E_i . ray of a triangle are its barycentric coordinates divided by depth, even if it crosses the near plane.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import get_thread_id  # type: ignore[attr-defined]

from faceanim.ground.jit import kernel, prange

BAND = 16
FEW = 30  # blocks: for triangles up to this size it pays to ask first whether they are hidden
CHUNK = 512
SUB = 256
HALF = SUB // 2
REACH = 96
FAR_PIXEL = float(1 << 20)
BEHIND = -(1 << 30)
LAST_NAME = (1 << 31) - 1
DEEPEST = float(1 << 30)
FINE = 12  # further bits of a depth number while it is stepped from pixel to pixel
STEEPEST = float(1 << 46)

# Offsets, in eighths of a pixel, of the 16 samples of four neighbouring pixels from the centre of the first one.
_RIGHT = np.array([8 * i + s for i in range(4) for s in (-1, 3, 1, -3)], dtype=np.int64)
_DOWN = np.array([s for i in range(4) for s in (-3, -1, 3, 1)], dtype=np.int64)


class Mesh(NamedTuple):
    """What does not change between frames; vertices and triangles of all items, one after the other.

    triangle : (t, 3)   item : (t,)   start : (n + 1,), incident : (3 t,) triangles of each vertex   owner : (n,) item
    uv : (t, 6) of the corners
    """

    triangle: np.ndarray
    item: np.ndarray
    start: np.ndarray
    incident: np.ndarray
    owner: np.ndarray
    uv: np.ndarray


class Frame(NamedTuple):
    """Buffers of one picture.

    facet : (t, 3) area-weighted normals [mm^2]   eye : (n, 3) camera space [mm]   screen : (n, 2) [1/256 pixel]
    vertex : (n, 8) normal, occlusion, linear colour, depth   plane : (t, 16) rows E_i and the P_ columns
    deep : (t, 8) depth number: gradient in x and y, value at pixel (0, 0), least, largest; side (1 front, -1 back)
    box : (t, 4) first and last pixel in x and y; empty if culled
    sample : (slots, BAND, ceil(w / 4), 16) four a pixel, 0 = none: depth number << 32 | LAST_NAME - triangle, so that
    the larger of two is the nearer, and of equals the first triangle
    nearest : (h, w) depth number of the nearest sample, 0 = none
    row_start : (bands + 1,)   row_list : triangles by band
    fragment : (h, N_WHOLE, 4 w) pixel, triangle and number of samples of each surface seen in each row, from left to
    right; `found` (h,) of them
    A depth number is DEEPEST * near / depth, a whole number up to DEEPEST.
    """

    facet: np.ndarray
    eye: np.ndarray
    screen: np.ndarray
    vertex: np.ndarray
    plane: np.ndarray
    deep: np.ndarray
    box: np.ndarray
    sample: np.ndarray
    nearest: np.ndarray
    row_start: np.ndarray
    row_list: np.ndarray
    fragment: np.ndarray
    found: np.ndarray


def _aligned(rows: int, columns: int, kind: type) -> np.ndarray:
    """Return zeros (rows, columns) that start at a cache line, so that rows of 32 or 64 bytes do not straddle two."""
    size = np.dtype(kind).itemsize
    raw: np.ndarray = np.zeros(rows * columns + 64 // size, kind)
    skip = (-raw.ctypes.data % 64) // size
    return raw[skip : skip + rows * columns].reshape(rows, columns)


def sample_buffer(slots: int, width: int) -> np.ndarray:
    """Return room for the samples of so many bands of a picture of that width [pixel]."""
    return np.zeros((slots, BAND, (width + 3) // 4, 16), np.int64)


def buffers(n: int, t: int, width: int, height: int, slots: int) -> Frame:
    """Return the buffers for n vertices, t triangles and a picture of that size [pixel].

    slots : bands whose samples are kept at a time: one a thread, or all bands if `coverage_pass` is to keep them
    """
    bands = -(-height // BAND)
    return Frame(
        facet=np.zeros((t, 3), np.float32),
        eye=np.zeros((n, 3)),
        screen=np.zeros((n, 2), np.int32),
        vertex=_aligned(n, 8, np.float32),
        plane=_aligned(t, 16, np.float32),
        deep=_aligned(t, 8, np.float64),
        box=np.zeros((t, 4), np.int32),
        sample=sample_buffer(slots, width),
        nearest=np.zeros((height, width), np.int32),
        row_start=np.zeros(bands + 1, np.int32),
        row_list=np.zeros(4 * t + 64, np.int32),
        fragment=np.zeros((height, N_WHOLE, 4 * width), np.int32),
        found=np.zeros(height, np.int32),
    )


def longer_list(frame: Frame) -> Frame:
    """Return `frame` with the triangle list that its last `band_pass` asked for, and room to spare."""
    return frame._replace(row_list=np.zeros(int(1.5 * frame.row_start[-1]), np.int32))


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


M_RED, M_GREEN, M_BLUE = 0, 1, 2
M_SOURCE = 3  # 0 uniform colour, 1 texture, 2 colour per vertex
M_TEXTURE = 4
M_SPECULAR = 5  # reflectance at normal incidence
M_ROUGH = 6  # squared roughness of the highlight
M_WRAP = 7  # 7, 8, 9: how far diffuse light wraps round, red, green, blue
M_SIDED = 10  # 0 front only, 1 both
M_BACK = 11  # brightness of the back side
M_SHADE_RADIUS = 12  # [mm] radius of the screen-space contact shade, 0 = none
M_SHADE = 13  # its strength
M_WIRE = 14  # line width [pixel], 0 = none
M_FLAT = 15  # 0 lit, 1 unlit
M_LAYER = 16
M_GLOW = 17  # 17, 18, 19: light that reaches closed places all the same, red, green, blue
M_MATTE = 20  # how much less the dark parts (hair on skin) shine
N_MATERIAL = 21

LIGHTS = 3
ENCODE = 8192
ENCODE_TOP = 2.0
"""The encoding table spans linear values [0, ENCODE_TOP)."""

P_MIP, P_NORMAL, P_SIDE = 9, 10, 13
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


@kernel(parallel=True)
def facet_pass(moved, mesh, points, frame):
    """Normals of the triangles of moved items, scaled by twice their area, in the frame of `points` (n, 3) [mm]."""
    triangle, item, facet = mesh.triangle, mesh.item, frame.facet
    for t in prange(triangle.shape[0]):
        if not moved[item[t]]:
            continue
        a, b, c = triangle[t, 0], triangle[t, 1], triangle[t, 2]
        ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        facet[t, 0] = uy * vz - uz * vy
        facet[t, 1] = uz * vx - ux * vz
        facet[t, 2] = ux * vy - uy * vx


@kernel
def project(camera, x, y, z):
    """Screen position [1/256 pixel, rounded] of a camera-space point; x is BEHIND if it lies before the near plane."""
    if z < camera[C_NEAR]:
        return np.int64(BEHIND), np.int64(0)
    f = camera[C_FOCAL] / z
    sx = min(max(camera[C_X] + f * x, -FAR_PIXEL), FAR_PIXEL)
    sy = min(max(camera[C_Y] - f * y, -FAR_PIXEL), FAR_PIXEL)
    return np.int64(np.floor(sx * SUB + 0.5)), np.int64(np.floor(sy * SUB + 0.5))


@kernel(parallel=True)
def vertex_pass(moved, mesh, points, camera, frame):
    """Normals, places in camera space and on the screen of moved items' vertices; `points` (n, 3) must be finite."""
    start, incident, owner, facet = mesh.start, mesh.incident, mesh.owner, frame.facet
    eye, screen, vertex = frame.eye, frame.screen, frame.vertex
    for i in prange(points.shape[0]):
        if not moved[owner[i]]:
            continue
        nx, ny, nz = 0.0, 0.0, 0.0
        for k in range(start[i], start[i + 1]):
            t = incident[k]
            nx += facet[t, 0]
            ny += facet[t, 1]
            nz += facet[t, 2]
        scale = 1.0 / np.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-30))
        dx = points[i, 0] - camera[C_POSITION]
        dy = points[i, 1] - camera[C_POSITION + 1]
        dz = points[i, 2] - camera[C_POSITION + 2]
        for r in range(3):
            vertex[i, r] = scale * (camera[3 * r] * nx + camera[3 * r + 1] * ny + camera[3 * r + 2] * nz)
            eye[i, r] = camera[3 * r] * dx + camera[3 * r + 1] * dy + camera[3 * r + 2] * dz
        vertex[i, 7] = eye[i, 2]
        screen[i, 0], screen[i, 1] = project(camera, eye[i, 0], eye[i, 1], eye[i, 2])


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


@kernel
def _planes(camera, eye, a, b, c, t, plane, deep):
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
    deep[t, 3] = max(unit / max(az, bz, cz), float(1 << FINE))
    deep[t, 4] = unit / max(min(az, bz, cz), camera[C_NEAR])
    return det


@kernel
def _mip(uv, t, width, height, area):
    """Mip level at which one texel of triangle t covers about one pixel; area [pixel^2]."""
    ux, uy = uv[t, 2] - uv[t, 0], uv[t, 3] - uv[t, 1]
    vx, vy = uv[t, 4] - uv[t, 0], uv[t, 5] - uv[t, 1]
    texels = abs(ux * vy - uy * vx) * width * height
    return 0.5 * np.log2(max(texels, 1e-12) / max(area, 1e-3))


@kernel
def _holds_sample(left, right, top, bottom):
    """Whether a box, relative to the corner of a pixel [1/256 pixel], holds one of the pixel's four samples."""
    a, b, c, d = HALF - REACH, HALF - REACH // 3, HALF + REACH // 3, HALF + REACH
    return (
        (left <= b <= right and top <= a <= bottom)
        or (left <= d <= right and top <= b <= bottom)
        or (left <= c <= right and top <= d <= bottom)
        or (left <= a <= right and top <= c <= bottom)
    )


@kernel
def _set_up(
    first, last, layer, moved, camera, triangle, item, uv, eye, screen, facet, plane, deep, box, material, level
):
    """`setup_pass` for triangles first..last-1."""
    width, height = int(2.0 * camera[C_X]), int(2.0 * camera[C_Y])
    for t in range(first, last):
        m = item[t]
        if not moved[m]:
            continue
        box[t, 2], box[t, 3] = 1, 0
        a, b, c = triangle[t, 0], triangle[t, 1], triangle[t, 2]
        if material[m, M_LAYER] != layer:
            continue
        x0, y0 = np.int64(screen[a, 0]), np.int64(screen[a, 1])
        x1, y1 = np.int64(screen[b, 0]), np.int64(screen[b, 1])
        x2, y2 = np.int64(screen[c, 0]), np.int64(screen[c, 1])
        x3, y3 = x2, y2
        if min(x0, x1, x2) == BEHIND:
            if max(x0, x1, x2) == BEHIND:
                continue
            x0, y0, x1, y1, x2, y2, x3, y3 = _clip(camera, eye, screen, a, b, c)
        # Twice the area on the screen, whose y points down, so that a front has a negative sign.
        area = (x2 - x0) * (y3 - y1) - (x3 - x1) * (y2 - y0)
        if area == 0 or (area > 0 and material[m, M_SIDED] == 0.0):
            continue
        lo_x = max((min(x0, x1, x2, x3) - HALF - REACH + SUB - 1) >> 8, 0)
        hi_x = min((max(x0, x1, x2, x3) - HALF + REACH) >> 8, width - 1)
        lo_y = max((min(y0, y1, y2, y3) - HALF - REACH + SUB - 1) >> 8, 0)
        hi_y = min((max(y0, y1, y2, y3) - HALF + REACH) >> 8, height - 1)
        if lo_x > hi_x or lo_y > hi_y:
            continue
        if lo_x == hi_x and lo_y == hi_y:
            left, right, top, bottom = (
                min(x0, x1, x2, x3),
                max(x0, x1, x2, x3),
                min(y0, y1, y2, y3),
                max(y0, y1, y2, y3),
            )
            if not _holds_sample(left - SUB * lo_x, right - SUB * lo_x, top - SUB * lo_y, bottom - SUB * lo_y):
                continue
        if _planes(camera, eye, a, b, c, t, plane, deep) == 0.0:
            continue
        nx, ny, nz = facet[t, 0], facet[t, 1], facet[t, 2]
        scale = 1.0 / np.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-30))
        plane[t, P_NORMAL], plane[t, P_NORMAL + 1], plane[t, P_NORMAL + 2] = scale * nx, scale * ny, scale * nz
        plane[t, P_SIDE] = deep[t, 5] = 1.0 if area < 0 else -1.0
        if material[m, M_SOURCE] == 1.0:
            k = int(material[m, M_TEXTURE])
            plane[t, P_MIP] = _mip(uv, t, level[k, 0, 1], level[k, 0, 2], 0.5 * abs(area) / (SUB * SUB))
        box[t, 0], box[t, 1], box[t, 2], box[t, 3] = lo_x, hi_x, lo_y, hi_y


@kernel(parallel=True)
def setup_pass(moved, mesh, camera, layer, frame, paint):
    """Cull the triangles of moved items in one layer; fill planes, mip levels and boxes of those that may be seen."""
    triangle, item, uv, eye, screen, facet = mesh.triangle, mesh.item, mesh.uv, frame.eye, frame.screen, frame.facet
    plane, deep, box, material, level = frame.plane, frame.deep, frame.box, paint.material, paint.level
    chunks = (triangle.shape[0] + CHUNK - 1) // CHUNK
    for k in prange(chunks):
        last = min((k + 1) * CHUNK, triangle.shape[0])
        _set_up(
            k * CHUNK,
            last,
            layer,
            moved,
            camera,
            triangle,
            item,
            uv,
            eye,
            screen,
            facet,
            plane,
            deep,
            box,
            material,
            level,
        )


@kernel
def band_pass(frame):
    """Sort visible triangles into bands of rows, by index within a band; return the length the list needs."""
    box, row_start, row_list = frame.box, frame.row_start, frame.row_list
    bands = row_start.shape[0] - 1
    for k in range(bands + 1):
        row_start[k] = 0
    for t in range(box.shape[0]):
        if box[t, 3] >= box[t, 2]:
            for k in range(box[t, 2] // BAND, box[t, 3] // BAND + 1):
                row_start[k + 1] += 1
    for k in range(bands):
        row_start[k + 1] += row_start[k]
    need = row_start[bands]
    if need > row_list.shape[0]:
        return need
    for t in range(box.shape[0]):
        if box[t, 3] >= box[t, 2]:
            for k in range(box[t, 2] // BAND, box[t, 3] // BAND + 1):
                row_list[row_start[k]] = t
                row_start[k] += 1
    for k in range(bands, 0, -1):
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
def _hidden(lo_u, hi_u, lo_y, hi_y, base, most, sample):
    """Whether every sample of these blocks already shows something nearer than the depth number `most` (fine)."""
    key = (most >> FINE) << 32
    for y in range(lo_y, hi_y + 1):
        for u in range(lo_u, hi_u + 1):
            least = sample[y - base, u, 0]
            for q in range(1, 16):
                s = sample[y - base, u, q]
                least = s if s < least else least
            if least <= key + LAST_NAME:
                return False
    return True


@kernel
def _cover(x0, y0, x1, y1, x2, y2, lo_x, hi_x, lo_y, hi_y, z, gx, gy, least, most, name, base, sample):
    """Write the samples of one screen triangle (positive orientation) that are nearer than what is there.

    z : depth number at the centre of pixel (lo_x, lo_y), gx, gy its steps   name : LAST_NAME - triangle
    base : first row of `sample`
    Four pixels, 16 samples, are tested at a time; the larger of old and new sample stays.
    """
    lo_x &= ~3
    a0, b0 = (y1 - y0) * SUB, (x0 - x1) * SUB
    a1, b1 = (y2 - y1) * SUB, (x1 - x2) * SUB
    a2, b2 = (y0 - y2) * SUB, (x2 - x0) * SUB
    i0, j0, i1, j1, i2, j2, ix, iy = a0 >> 3, b0 >> 3, a1 >> 3, b1 >> 3, a2 >> 3, b2 >> 3, gx >> 3, gy >> 3
    m0, m1, m2 = _largest(i0, j0), _largest(i1, j1), _largest(i2, j2)
    px, py = lo_x * SUB + HALF, lo_y * SUB + HALF
    r0, r1, r2 = _edge(x0, y0, x1, y1, px, py), _edge(x1, y1, x2, y2, px, py), _edge(x2, y2, x0, y0, px, py)
    a0, a1, a2, gx = 4 * a0, 4 * a1, 4 * a2, 4 * gx
    for y in range(lo_y, hi_y + 1):
        e0, e1, e2, d = r0, r1, r2, z
        for u in range(lo_x >> 2, (hi_x >> 2) + 1):
            if ((e0 + m0) | (e1 + m1) | (e2 + m2)) >= 0:
                for q in range(16):
                    right, down = _RIGHT[q], _DOWN[q]
                    e = (e0 + i0 * right + j0 * down) | (e1 + i1 * right + j1 * down) | (e2 + i2 * right + j2 * down)
                    near = d + ix * right + iy * down
                    near = near if near > least else least
                    near = near if near < most else most
                    key = ((near >> FINE) << 32) | name
                    key = key if e >= 0 else 0
                    old = sample[y - base, u, q]
                    sample[y - base, u, q] = key if key > old else old
            e0 += a0
            e1 += a1
            e2 += a2
            d += gx
        r0 += b0
        r1 += b1
        r2 += b2
        z += gy


@kernel(inline=True)
def _triangle(sample):
    return LAST_NAME - (sample & LAST_NAME)


@kernel
def _alike(si, sj, item, plane):
    """Whether two samples of a pixel may share one colour."""
    t, k = _triangle(si), _triangle(sj)
    near = (abs((si >> 32) - (sj >> 32)) <= SAME_DEPTH * (si >> 32)) & (item[t] == item[k])
    turn = plane[t, P_NORMAL] * plane[k, P_NORMAL] + plane[t, P_NORMAL + 1] * plane[k, P_NORMAL + 1]
    return near & (turn + plane[t, P_NORMAL + 2] * plane[k, P_NORMAL + 2] >= SAME_TURN)


@kernel
def _list_row(width, sample, item, plane, whole):
    """List the fragments of one row of samples (w / 4, 16), from left to right; return how many there are."""
    n = 0
    for x in range(width):
        u, q = x >> 2, 4 * (x & 3)
        s0, s1, s2, s3 = sample[u, q], sample[u, q + 1], sample[u, q + 2], sample[u, q + 3]
        if (s0 | s1 | s2 | s3) == 0:
            continue
        low, high = min(s0, s1, s2, s3), max(s0, s1, s2, s3)
        if low > 0 and ((high >> 32) - (low >> 32)) << 10 <= high >> 32:
            # Nearly always: samples close together on one item. One branch that is easy to foresee costs least.
            m = item[_triangle(s0)]
            if (m == item[_triangle(s1)]) & (m == item[_triangle(s2)]) & (m == item[_triangle(s3)]):
                whole[W_PIXEL, n], whole[W_TRIANGLE, n], whole[W_SAMPLES, n] = x, _triangle(s0), 4
                n += 1
                continue
        done = 0
        for i in range(4):
            si = sample[u, q + i]
            if si == 0 or (done >> i) & 1:
                continue
            count = 1
            for j in range(i + 1, 4):
                sj = sample[u, q + j]
                if sj > 0 and not (done >> j) & 1 and _alike(si, sj, item, plane):
                    count += 1
                    done |= 1 << j
            whole[W_PIXEL, n], whole[W_TRIANGLE, n], whole[W_SAMPLES, n] = x, _triangle(si), count
            n += 1
    return n


@kernel
def _cover_band(band, height, triangle, eye, screen, box, deep, row_start, row_list, camera, sample):
    """Clear one band of rows and draw its triangles into it."""
    first = band * BAND
    last = min(first + BAND, height) - 1
    sample[:] = 0
    for k in range(row_start[band], row_start[band + 1]):
        t = row_list[k]
        a, b, c = triangle[t, 0], triangle[t, 1], triangle[t, 2]
        x0, y0 = np.int64(screen[a, 0]), np.int64(screen[a, 1])
        x1, y1 = np.int64(screen[b, 0]), np.int64(screen[b, 1])
        x2, y2 = np.int64(screen[c, 0]), np.int64(screen[c, 1])
        x3, y3 = x2, y2
        if min(x0, x1, x2) == BEHIND:
            x0, y0, x1, y1, x2, y2, x3, y3 = _clip(camera, eye, screen, a, b, c)
        if deep[t, 5] < 0.0:
            x1, y1, x3, y3 = x3, y3, x1, y1
        lo_x, hi_x = np.int64(box[t, 0]), np.int64(box[t, 1])
        lo_y, hi_y = max(np.int64(box[t, 2]), first), min(np.int64(box[t, 3]), last)
        gx, gy, least, most = np.int64(deep[t, 0]), np.int64(deep[t, 1]), np.int64(deep[t, 3]), np.int64(deep[t, 4])
        z = np.int64(deep[t, 2] + deep[t, 0] * ((lo_x & ~3) + 0.5) + deep[t, 1] * (lo_y + 0.5))
        name = np.int64(LAST_NAME - t)
        lo_u, hi_u = lo_x >> 2, hi_x >> 2
        if (hi_u - lo_u + 1) * (hi_y - lo_y + 1) <= FEW and _hidden(lo_u, hi_u, lo_y, hi_y, first, most, sample):
            continue
        if (x0 != x1 or y0 != y1) and (x1 != x2 or y1 != y2):
            _cover(x0, y0, x1, y1, x2, y2, lo_x, hi_x, lo_y, hi_y, z, gx, gy, least, most, name, first, sample)
        if x3 != x2 or y3 != y2:
            _cover(x0, y0, x2, y2, x3, y3, lo_x, hi_x, lo_y, hi_y, z, gx, gy, least, most, name, first, sample)


@kernel
def _list_band(band, item, plane, sample, fragment, found, nearest):
    """List the fragments of one band of rows and note the nearest depth of each pixel."""
    height, width = nearest.shape
    first = band * BAND
    for y in range(first, min(first + BAND, height)):
        found[y] = _list_row(width, sample[y - first], item, plane, fragment[y])
        for x in range(width):
            u, q = x >> 2, 4 * (x & 3)
            s = sample[y - first]
            nearest[y, x] = max(s[u, q], s[u, q + 1], s[u, q + 2], s[u, q + 3]) >> 32


@kernel(parallel=True)
def coverage_pass(order, listed, mesh, camera, frame):
    """Find the nearest triangle of every sample, band by band; `order` (bands,) deals the bands out to the threads.

    listed : list fragments and nearest depths, samples live in the slot of the thread; else keep them, band b in slot b
    """
    triangle, eye, screen, box, deep = mesh.triangle, frame.eye, frame.screen, frame.box, frame.deep
    row_start, row_list, sample, height = frame.row_start, frame.row_list, frame.sample, int(2.0 * camera[C_Y])
    item, plane, fragment, found, nearest = mesh.item, frame.plane, frame.fragment, frame.found, frame.nearest
    for k in prange(order.shape[0]):
        b = order[k]
        room = sample[get_thread_id() if listed else b]
        _cover_band(b, height, triangle, eye, screen, box, deep, row_start, row_list, camera, room)
        if listed:
            _list_band(b, item, plane, room, fragment, found, nearest)
