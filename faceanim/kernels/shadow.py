"""Soft shadows of the key light: blurred moments of the depth seen from the light, and how much of it arrives.

The depth map holds mean and mean square of the depth; Chebyshev's inequality then bounds the part of the light that
passes at a given depth (variance shadow maps, Donnelly & Lauritzen 2006).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from faceanim.ground.jit import kernel, prange
from faceanim.kernels.memory import STORE, load
from faceanim.kernels.raster import BAND, C_NEAR, C_POSITION, DEEPEST, project

ROWS = 16


class Shadow(NamedTuple):
    """What shading needs to know of the key light's shadow.

    moment : (s, s, 2)   to_light : (16,) see `shadow_run`   bias : [mm], 0 = no shadow
    """

    moment: np.ndarray
    to_light: np.ndarray
    bias: float


_0, _1, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_LEAK, _GAIN = np.float32(0.2), np.float32(1.25)
store0 = STORE[0]


@kernel(parallel=True)
def light_view_pass(points, camera, eye, screen):
    """Vertices (n, 3) in the light's camera space and on its screen; the light stands far away."""
    for i in prange(points.shape[0]):
        dx = points[i, 0] - camera[C_POSITION]
        dy = points[i, 1] - camera[C_POSITION + 1]
        dz = points[i, 2] - camera[C_POSITION + 2]
        for r in range(3):
            eye[i, r] = camera[3 * r] * dx + camera[3 * r + 1] * dy + camera[3 * r + 2] * dz
        screen[i, 0], screen[i, 1] = project(camera, eye[i, 0], eye[i, 1], eye[i, 2])


@kernel
def _moments(first, last, camera, middle, far, sample, moment):
    unit = DEEPEST * camera[C_NEAR]
    for y in range(first, last):
        for x in range(moment.shape[1]):
            mean, square, q = 0.0, 0.0, 4 * (x & 3)
            for s in range(q, q + 4):
                name = sample[y // BAND, y % BAND, x >> 2, s]
                d = far if name == 0 else min(unit / (name >> 32) - middle, far)
                mean += 0.25 * d
                square += 0.25 * d * d
            moment[y, x, 0] = mean
            moment[y, x, 1] = square


@kernel
def _blur_across(first, last, reach, moment, out):
    """Mean over 2 reach + 1 neighbours along each row."""
    width, scale = moment.shape[1], 1.0 / (2 * reach + 1)
    for y in range(first, last):
        a, b = 0.0, 0.0
        for x in range(-reach, reach + 1):
            a += moment[y, max(x, 0), 0]
            b += moment[y, max(x, 0), 1]
        for x in range(width):
            out[y, x, 0] = scale * a
            out[y, x, 1] = scale * b
            old, new = max(x - reach, 0), min(x + reach + 1, width - 1)
            a += moment[y, new, 0] - moment[y, old, 0]
            b += moment[y, new, 1] - moment[y, old, 1]


@kernel
def _blur_down(first, last, reach, moment, out):
    """Mean over 2 reach + 1 neighbours along each column, rows first..last-1 of the result."""
    height, width, scale = moment.shape[0], moment.shape[1], 1.0 / (2 * reach + 1)
    for y in range(first, last):
        for x in range(width):
            out[y, x, 0] = 0.0
            out[y, x, 1] = 0.0
        for k in range(-reach, reach + 1):
            row = min(max(y + k, 0), height - 1)
            for x in range(width):
                out[y, x, 0] += moment[row, x, 0]
                out[y, x, 1] += moment[row, x, 1]
        for x in range(width):
            out[y, x, 0] *= scale
            out[y, x, 1] *= scale


@kernel(parallel=True)
def moment_pass(camera, middle, far, reach, sample, moment, spare):
    """Blurred `moment` (s, s, 2) of the depth beyond `middle` [mm], at most `far`; `spare` is work space alike."""
    size = moment.shape[0]
    bands = (size + ROWS - 1) // ROWS
    for k in prange(bands):
        first, last = k * ROWS, min((k + 1) * ROWS, size)
        _moments(first, last, camera, middle, far, sample, moment)
        _blur_across(first, last, reach, moment, spare)
    for k in prange(bands):
        _blur_down(k * ROWS, min((k + 1) * ROWS, size), reach, spare, moment)


@kernel
def shadow_run(first, last, ry, centre, focal, to_light, bias, places, whole, number, moment):
    """Part of the key light that reaches fragments first..last-1, into a row of `number`.

    to_light : (16,) from camera space to the light's: 9 rotation, 3 shift [mm], focal length and centre of the map
    [pixel], depth `middle` of the moments   bias : [mm]
    places : the rows of pixel (in `whole`), depth and result (in `number`)
    """
    cap, size = number.shape[1], moment.shape[1]
    pixel_at, depth_at, lit_at = places
    r00, r01, r02 = to_light[0], to_light[1], to_light[2]
    r10, r11, r12 = to_light[3], to_light[4], to_light[5]
    r20, r21, r22 = to_light[6], to_light[7], to_light[8]
    tx, ty, tz = to_light[9], to_light[10], to_light[11]
    length, half, middle, top = to_light[12], to_light[13], to_light[15], np.float32(size - 2)
    for i in range(first, last):
        z = load(number, depth_at * cap + i)
        x = z * ((np.float32(load(whole, pixel_at * cap + i)) + _HALF - centre) / focal)
        y = z * ry
        lz = r20 * x + r21 * y + r22 * z + tz
        scale = length / lz
        px = half + scale * (r00 * x + r01 * y + r02 * z + tx) - _HALF
        py = half - scale * (r10 * x + r11 * y + r12 * z + ty) - _HALF
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
        behind = lz - middle - bias - mean
        behind = behind if behind > _0 else _0
        spread = square - mean * mean
        spread = spread if spread > _HALF else _HALF
        part = (spread / (spread + behind * behind) - _LEAK) * _GAIN
        store0(number, lit_at * cap + i, part if part > _0 else _0)
