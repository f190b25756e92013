"""Soft shadows of the key light: blurred moments of the depth seen from the light, and how much of it arrives.

The depth map holds mean and mean square of the depth; Chebyshev's inequality then bounds the part of the light that
passes at a given depth (variance shadow maps, Donnelly & Lauritzen 2006). Light falls in parallel rays. Pieces of the
caster are drawn into maps of their own, of which the nearest depth counts: their order does not matter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from faceanim.ground.jit import kernel
from faceanim.kernels.memory import STORE, load

STRIP = 16  # rows
BLUR = 2  # neighbours on each side over which moments are averaged


class Caster(NamedTuple):
    """What throws the shadow, seen from the light.

    Places in the map are (right [pixel], down [pixel], depth beyond the middle [mm]).
    triangle : (c, 3) vertices   casts : (items,)   to_map : (3, 4) from the head frame to the map
    spot : (n, 4) places of the vertices   depth : (pieces, s, s), `far` where nothing is
    """

    triangle: np.ndarray
    casts: np.ndarray
    to_map: np.ndarray
    spot: np.ndarray
    depth: np.ndarray
    far: float


class Depths(NamedTuple):
    """Depth of the caster's pieces, and the moments (s, s, 2) made of it; spare : (strips, 3, rows, columns)."""

    depth: np.ndarray
    moment: np.ndarray
    spare: np.ndarray
    far: float


class Shadow(NamedTuple):
    """What shading needs to know: moment (s, s, 2), to_light (12,) from camera space to the map, row by row.

    bias : [mm], 0 = no shadow
    """

    moment: np.ndarray
    to_light: np.ndarray
    bias: float


_0, _1, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_TAP, _BEYOND = np.float32((2 * BLUR + 1) ** -2), np.float32(25.0)
_LEAK, _GAIN, _RIM = np.float32(0.2), np.float32(1.25), np.float32(-1e-4)
store0 = STORE[0]


def spare_buffer(size: int) -> np.ndarray:
    """Return work space for a map of that size [pixel]."""
    return np.zeros((-(-size // STRIP), 3, STRIP + 2 * BLUR, size + 2 * BLUR), np.float32)


@kernel(inline=True)
def _cast_triangle(x0, y0, z0, x1, y1, z1, x2, y2, z2, depth):
    """Draw one triangle, given by its places in the map, into `depth` (s, s); back sides lie behind fronts."""
    ux, uy, uz, vx, vy, vz = x1 - x0, y1 - y0, z1 - z0, x2 - x0, y2 - y0, z2 - z0
    area = ux * vy - vx * uy
    if area >= _0:
        return
    top, s = np.float32(depth.shape[0] - 1), _1 / area
    lo_x, hi_x = np.int64(np.ceil(max(min(x0, x1, x2) - _HALF, _0))), np.int64(min(max(x0, x1, x2) - _HALF, top))
    lo_y, hi_y = np.int64(np.ceil(max(min(y0, y1, y2) - _HALF, _0))), np.int64(min(max(y0, y1, y2) - _HALF, top))
    gx, gy = s * (uz * vy - vz * uy), s * (vz * ux - uz * vx)
    for y in range(lo_y, hi_y + 1):
        py = np.float32(y) + _HALF - y0
        for x in range(lo_x, hi_x + 1):
            px = np.float32(x) + _HALF - x0
            l1, l2 = s * (px * vy - vx * py), s * (ux * py - px * uy)
            z = z0 + gx * px + gy * py
            if min(l1, l2, _1 - l1 - l2) >= _RIM and z < depth[y, x]:
                depth[y, x] = z


@kernel
def cast_piece(piece, caster):
    """Draw one piece of the caster, every so-manieth chunk of its triangles, into its own map."""
    triangle, spot, depth = caster.triangle, caster.spot, caster.depth[piece]
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            depth[y, x] = caster.far
    stride = 64 * caster.depth.shape[0]
    for first in range(64 * piece, triangle.shape[0], stride):
        for t in range(first, min(first + 64, triangle.shape[0])):
            a, b, c = triangle[t, 0], triangle[t, 1], triangle[t, 2]
            _cast_triangle(
                spot[a, 0],
                spot[a, 1],
                spot[a, 2],
                spot[b, 0],
                spot[b, 1],
                spot[b, 2],
                spot[c, 0],
                spot[c, 1],
                spot[c, 2],
                depth,
            )


@kernel
def _gather_row(y, far, depth, count, mean, square):
    """Along row y, 1, depth and its square of the nearest of all pieces, 0 where nothing is; repeated at both ends."""
    pieces, size = depth.shape[0], depth.shape[2]
    for x in range(size):
        mean[x + BLUR] = depth[0, y, x]
    for k in range(1, pieces):
        for x in range(size):
            mean[x + BLUR] = min(mean[x + BLUR], depth[k, y, x])
    for x in range(BLUR):
        mean[x], mean[size + BLUR + x] = mean[BLUR], mean[size + BLUR - 1]
    for x in range(size + 2 * BLUR):
        seen = _1 if mean[x] < far else _0
        count[x] = seen
        mean[x] *= seen
        square[x] = mean[x] * mean[x]


@kernel
def _blur_down(table):
    """In each table of rows (tables, rows, columns), sum rows j..j + 2 BLUR into row j, while so many are left."""
    for c in range(table.shape[0]):
        for j in range(table.shape[1] - 2 * BLUR):
            for x in range(table.shape[2]):
                total = table[c, j, x]
                for k in range(1, 2 * BLUR + 1):
                    total += table[c, j + k, x]
                table[c, j, x] = total


@kernel
def _blur_across(far, count, mean, square, moment):
    """Moments (s, 2) from sums over places x..x + 2 BLUR of a row; where nothing is counts as _BEYOND behind the rest.

    So an outline before nothing shades neither itself nor lets light through as one before a far wall would.
    """
    for x in range(moment.shape[0]):
        n, a, b = count[x], mean[x], square[x]
        for j in range(1, 2 * BLUR + 1):
            n += count[x + j]
            a += mean[x + j]
            b += square[x + j]
        share, empty = _1 / max(n, _1), _1 - n * _TAP
        beyond = a * share + _BEYOND
        moment[x, 0] = n * _TAP * a * share + empty * beyond if n > _0 else far
        moment[x, 1] = n * _TAP * b * share + empty * beyond * beyond if n > _0 else far * far


@kernel
def moment_strip(strip, depths):
    """Moments of one strip of rows; where nothing is there is no depths."""
    depth, moment, size, far = depths.depth, depths.moment, depths.moment.shape[0], np.float32(depths.far)
    count, mean, square = depths.spare[strip, 0], depths.spare[strip, 1], depths.spare[strip, 2]
    first, last = strip * STRIP, min((strip + 1) * STRIP, size)
    for j in range(STRIP + 2 * BLUR):
        _gather_row(min(max(first + j - BLUR, 0), size - 1), far, depth, count[j], mean[j], square[j])
    _blur_down(depths.spare[strip])
    for y in range(first, last):
        _blur_across(far, count[y - first], mean[y - first], square[y - first], moment[y])


@kernel
def shadow_run(first, last, ry, centre, focal, to_light, bias, places, whole, number, moment):
    """Part of the key light that reaches fragments first..last-1, into a row of `number`.

    to_light, bias : see `Shadow`   places : the rows of pixel (in `whole`), depth and result (in `number`)
    """
    cap, size = number.shape[1], moment.shape[1]
    pixel_at, depth_at, lit_at = places
    step, top = _1 / focal, np.float32(size - 2)
    # Along a row the ray (rx, ry, 1) changes in its first part only.
    xx, xc = to_light[0], to_light[1] * ry + to_light[2]
    yx, yc = to_light[4], to_light[5] * ry + to_light[6]
    zx, zc = to_light[8], to_light[9] * ry + to_light[10]
    xt, yt, zt = to_light[3] - _HALF, to_light[7] - _HALF, to_light[11] - bias
    for i in range(first, last):
        z = load(number, depth_at * cap + i)
        rx = (np.float32(load(whole, pixel_at * cap + i)) + _HALF - centre) * step
        px, py = xt + z * (xx * rx + xc), yt + z * (yx * rx + yc)
        px, py = px if px > _0 else _0, py if py > _0 else _0
        px, py = px if px < top else top, py if py < top else top
        ix, iy = np.int32(px), np.int32(py)
        fx, fy = px - np.float32(ix), py - np.float32(iy)
        at = 2 * (iy * size + ix)
        below = at + 2 * size
        w0, w1, w2, w3 = (_1 - fx) * (_1 - fy), fx * (_1 - fy), (_1 - fx) * fy, fx * fy
        mean = (
            w0 * load(moment, at) + w1 * load(moment, at + 2) + w2 * load(moment, below) + w3 * load(moment, below + 2)
        )
        at, below = at + 1, below + 1
        square = w0 * load(moment, at) + w1 * load(moment, at + 2)
        square = square + w2 * load(moment, below) + w3 * load(moment, below + 2)
        behind = zt + z * (zx * rx + zc) - mean
        behind = behind if behind > _0 else _0
        spread = square - mean * mean
        spread = spread if spread > _HALF else _HALF
        part = (spread / (spread + behind * behind) - _LEAK) * _GAIN
        store0(number, lit_at * cap + i, part if part > _0 else _0)
