"""Shading: from the samples of the rasteriser to sRGB bytes, one evaluation per pixel and surface seen in it.

Light is linear: three directional lights with wrapped diffuse reflection (each colour has its own width, red the
widest, as light that entered skin comes out redder), a microfacet highlight, and a sky and ground ambient term darkened
by occlusion. Occlusion is stored per vertex; eyes, teeth and tongue add a contact shade taken from the depth samples.

A row of pixels is worked off in stages over a small table of its fragments: interpolate their attributes, look up the
texture and the shadow, light them (vector instructions), add them up. `whole` is the row of `Seen.fragment`.
"""

from __future__ import annotations

import numpy as np
from numba import get_thread_id  # type: ignore[attr-defined]

from faceanim.ground.jit import kernel, prange
from faceanim.kernels.lanes import LANES, mix8
from faceanim.kernels.memory import STORE, load
from faceanim.kernels.raster import (
    BAND,
    C_FOCAL,
    C_NEAR,
    C_X,
    C_Y,
    DEEPEST,
    ENCODE,
    ENCODE_TOP,
    M_BACK,
    M_FLAT,
    M_GLOW,
    M_MATTE,
    M_ROUGH,
    M_SHADE,
    M_SHADE_RADIUS,
    M_SOURCE,
    M_SPECULAR,
    M_TEXTURE,
    M_WIRE,
    M_WRAP,
    P_MIP,
    P_SIDE,
    W_PIXEL,
    W_SAMPLES,
    W_TRIANGLE,
)
from faceanim.kernels.shadow import shadow_run

# Rows of the table of attributes.
A_NX, A_NY, A_NZ, A_OPEN, A_RED, A_GREEN, A_BLUE, A_DEPTH = 0, 1, 2, 3, 4, 5, 6, 7
A_MIP, A_SIDE, A_LIT, A_TEXTURE, A_OUT, N_NUMBER = 8, 9, 10, 11, 14, 17

_0, _1, _2, _4 = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(4.0)
_DECODE, _TEN, _SHIFT1, _SHIFT2 = np.float32(1023.0**-2), np.uint32(1023), np.uint32(10), np.uint32(20)
_HALF, _TINY, _EDGE = np.float32(0.5), np.float32(1e-12), np.float32(0.1)
_REDDEN, _FIVE, _LEAST = np.float32(0.8), np.float32(5.0), np.float32(1e-30)
_CODES = np.float32(ENCODE / ENCODE_TOP)
_SHADED, _BOUNCE, _RIM = np.float32(0.22), np.float32(0.8), np.float32(0.35)

store0, store1, store2 = STORE[0], STORE[1], STORE[2]


# -------------------------------------------------------------------------------------------------- 1. attributes


@kernel
def _attribute_row(n, ry, centre, focal, triangle, vertex, plane, whole, number):
    """Interpolate what the vertices carry at the n fragments of a row, all in float32."""
    cap, step, columns = number.shape[1], _1 / focal, plane.shape[1]
    for i in range(n):
        t = load(whole, W_TRIANGLE * cap + i)
        p = columns * t
        rx = (np.float32(load(whole, W_PIXEL * cap + i)) + _HALF - centre) * step
        # A pixel centre beside a triangle that covers only some samples takes the value of the nearest corner or edge.
        w0 = max(load(plane, p) * rx + load(plane, p + 1) * ry + load(plane, p + 2), _0)
        w1 = max(load(plane, p + 3) * rx + load(plane, p + 4) * ry + load(plane, p + 5), _0)
        w2 = max(load(plane, p + 6) * rx + load(plane, p + 7) * ry + load(plane, p + 8), _0)
        total = _1 / max(w0 + w1 + w2, _LEAST)
        w0, w1, w2 = w0 * total, w1 * total, w2 * total
        a, b, c = LANES * load(triangle, 3 * t), LANES * load(triangle, 3 * t + 1), LANES * load(triangle, 3 * t + 2)
        mix8(number, i, cap, vertex, a, b, c, w0, w1, w2)
        store0(number, A_MIP * cap + i, load(plane, p + P_MIP))
        store0(number, A_SIDE * cap + i, load(plane, p + P_SIDE))
        store0(number, A_LIT * cap + i, _1)


@kernel
def _contact_run(first, last, y, camera, row, step, nearest, whole, number):
    """Darken fragments first..last-1 of the material `row` that nearer surfaces shade, those above counting most.

    `step` (taps, 3): offsets in units of the shade radius (y up) and weight.
    """
    height, width, unit = nearest.shape[0], nearest.shape[1], DEEPEST * camera[C_NEAR]
    for i in range(first, last):
        x, z = whole[W_PIXEL, i], number[A_DEPTH, i] + 0.0
        radius = row[M_SHADE_RADIUS] * camera[C_FOCAL] / z
        shade = 0.0
        for k in range(step.shape[0]):
            tx = min(max(int(x + radius * step[k, 0] + 0.5), 0), width - 1)
            ty = min(max(int(y - radius * step[k, 1] + 0.5), 0), height - 1)
            if nearest[ty, tx] > 0:
                shade += step[k, 2] * min(max(0.6 * (z - unit / nearest[ty, tx] - 0.25), 0.0), 1.0)
        number[A_OPEN, i] *= max(1.0 - row[M_SHADE] * shade, 0.0)


# ----------------------------------------------------------------------------------------------------- 2. texture


@kernel(inline=True)
def _corner(texel, i, weight):
    """Contribution of texel i: three 10-bit square roots of linear light in one word."""
    word = load(texel, i)
    red, green, blue = np.float32(word & _TEN), np.float32((word >> _SHIFT1) & _TEN), np.float32(word >> _SHIFT2)
    return weight * red * red, weight * green * green, weight * blue * blue


@kernel(inline=True)
def _bilinear(texel, level, at, u, v):
    """Linear colour (times 1023^2) of the mip level described at `at` in `level`; v up, clamped at the border."""
    first, width, height = load(level, at), load(level, at + 1), load(level, at + 2)
    w, h = np.float32(width), np.float32(height)
    x, y = u * w - _HALF, (_1 - v) * h - _HALF
    x, y = x if x > _0 else _0, y if y > _0 else _0
    x, y = x if x < w - _1 else w - _1, y if y < h - _1 else h - _1
    ix, iy = np.int32(x), np.int32(y)
    fx, fy = x - np.float32(ix), y - np.float32(iy)
    i = first + iy * width + ix
    right = 1 if ix + 1 < width else 0
    down = width if iy + 1 < height else 0
    r0, g0, b0 = _corner(texel, i, (_1 - fx) * (_1 - fy))
    r1, g1, b1 = _corner(texel, i + right, fx * (_1 - fy))
    r2, g2, b2 = _corner(texel, i + down, (_1 - fx) * fy)
    r3, g3, b3 = _corner(texel, i + down + right, fx * fy)
    return r0 + r1 + r2 + r3, g0 + g1 + g2 + g3, b0 + b1 + b2 + b3


@kernel
def _texture_run(first, last, texel, level, table, top, number):
    """Linear colour of fragments first..last-1 from one texture, at the mip level next to A_MIP.

    table : where the texture's first level is described in `level`   top : its last level
    """
    cap = number.shape[1]
    for i in range(first, last):
        u, v, mip = load(number, A_RED * cap + i), load(number, A_GREEN * cap + i), load(number, A_MIP * cap + i)
        mip = mip if mip > _0 else _0
        mip = mip if mip < top else top
        red, green, blue = _bilinear(texel, level, table + 3 * np.int32(mip + _HALF), u, v)
        store0(number, A_TEXTURE * cap + i, red * _DECODE)
        store1(number, (A_TEXTURE + 1) * cap + i, green * _DECODE)
        store2(number, (A_TEXTURE + 2) * cap + i, blue * _DECODE)


# ------------------------------------------------------------------------------------------------------- 3. light


@kernel(inline=True)
def _wrapped(facing, wrap, reach):
    """Wrapped cosine, smooth at its end; reach = 1 / (1 + wrap)."""
    c = (facing + wrap) * reach
    c = c if c > _0 else _0
    return c * (_1 + wrap * (c - _1))


@kernel(inline=True)
def _shine(nx, ny, nz, vx, vy, vz, lx, ly, lz, facing, rough, f0):
    """Microfacet highlight (GGX, Schlick's Fresnel term) times the cosine of the light and pi."""
    hx, hy, hz = lx + vx, ly + vy, lz + vz
    square = hx * hx + hy * hy + hz * hz
    s = _1 / np.sqrt(square if square > _TINY else _TINY)
    ndh = (nx * hx + ny * hy + nz * hz) * s
    ldh = (lx * hx + ly * hy + lz * hz) * s
    ldh = ldh if ldh > _EDGE else _EDGE
    a2 = rough * rough
    q = ndh * ndh * (a2 - _1) + _1
    g = _1 - ldh
    g2 = g * g
    fresnel = f0 + (_1 - f0) * g2 * g2 * g
    lit = facing if facing > _0 else _0
    return a2 * fresnel * lit / (_4 * q * q * ldh * ldh * (rough + _HALF))


@kernel
def _light_run(first, last, colour, ry, centre, focal, light, ambient, row, whole, number):
    """Light fragments first..last-1, all of the material `row`, their colour from column `colour` on.

    light : (3, 6), ambient : (3, 3), all float32
    """
    cap = number.shape[1]
    f0, rough, flat = row[M_SPECULAR], row[M_ROUGH], row[M_FLAT]
    wr, wg, wb = row[M_WRAP], row[M_WRAP + 1], row[M_WRAP + 2]
    sr, sg, sb = _1 / (_1 + wr), _1 / (_1 + wg), _1 / (_1 + wb)
    kx, ky, kz, kr, kg, kb = light[0, 0], light[0, 1], light[0, 2], light[0, 3], light[0, 4], light[0, 5]
    fx, fy, fz, fr, fg, fb = light[1, 0], light[1, 1], light[1, 2], light[1, 3], light[1, 4], light[1, 5]
    rx, r_y, rz, rr, rg, rb = light[2, 0], light[2, 1], light[2, 2], light[2, 3], light[2, 4], light[2, 5]
    ar, ag, ab = ambient[0, 0] - ambient[1, 0], ambient[0, 1] - ambient[1, 1], ambient[0, 2] - ambient[1, 2]
    gr, gg, gb = ambient[1, 0], ambient[1, 1], ambient[1, 2]
    br, bg, bb = row[M_GLOW], row[M_GLOW + 1], row[M_GLOW + 2]
    mr, mg, mb = ambient[2, 0], ambient[2, 1], ambient[2, 2]
    lamp, shiny, matte, back = _1 - flat, _1 if f0 > _0 else _0, row[M_MATTE], row[M_BACK]
    for i in range(first, last):
        nx, ny, nz = load(number, A_NX * cap + i), load(number, A_NY * cap + i), load(number, A_NZ * cap + i)
        square = nx * nx + ny * ny + nz * nz
        side = load(number, A_SIDE * cap + i)
        s = side / np.sqrt(square if square > _TINY else _TINY)
        nx, ny, nz = nx * s, ny * s, nz * s
        x = (np.float32(load(whole, W_PIXEL * cap + i)) + _HALF - centre) / focal
        vz = -_1 / np.sqrt(x * x + ry * ry + _1)
        vx, vy = x * vz, ry * vz
        open_ = load(number, A_OPEN * cap + i) * (_1 if side > _0 else back)
        red, green = load(number, colour * cap + i), load(number, (colour + 1) * cap + i)
        blue = load(number, (colour + 2) * cap + i)
        fk = nx * kx + ny * ky + nz * kz
        ff = nx * fx + ny * fy + nz * fz
        fl = nx * rx + ny * r_y + nz * rz
        pk = _shine(nx, ny, nz, vx, vy, vz, kx, ky, kz, fk, rough, f0) * shiny
        pf = _shine(nx, ny, nz, vx, vy, vz, fx, fy, fz, ff, rough, f0) * shiny
        pl = _shine(nx, ny, nz, vx, vy, vz, rx, r_y, rz, fl, rough, f0) * shiny
        # The shadow leaves alone the light that seeps round from the lit side, and reddens at its rim.
        lit = load(number, A_LIT * cap + i)
        edge = _4 * (fk - _EDGE)
        edge = edge if edge > _0 else _0
        edge = edge if edge < _1 else _1
        lit = _1 - edge * (_1 - lit)
        warm = lit * (_1 + _REDDEN * wr * (_1 - lit))
        dr = kr * warm * _wrapped(fk, wr, sr) + fr * _wrapped(ff, wr, sr) + rr * _wrapped(fl, wr, sr)
        dg = kg * lit * _wrapped(fk, wg, sg) + fg * _wrapped(ff, wg, sg) + rg * _wrapped(fl, wg, sg)
        db = kb * lit * _wrapped(fk, wb, sb) + fb * _wrapped(ff, wb, sb) + rb * _wrapped(fl, wb, sb)
        # Light that bounces inside a crevice keeps the colour of its walls, and some glows through them.
        up, shut, direct = _HALF + _HALF * ny, _BOUNCE * (_1 - open_), _SHADED + (_1 - _SHADED) * open_
        dr = (direct + br * shut) * dr + (open_ / (_1 - red * shut) + br * shut) * (gr + up * ar)
        dg = (direct + bg * shut) * dg + (open_ / (_1 - green * shut) + bg * shut) * (gg + up * ag)
        db = (direct + bb * shut) * db + (open_ / (_1 - blue * shut) + bb * shut) * (gb + up * ab)
        dr, dg, db = flat + lamp * dr, flat + lamp * dg, flat + lamp * db
        ahead = nx * vx + ny * vy + nz * vz
        graze = _1 - (ahead if ahead > _0 else _0)
        graze = graze * graze
        gleam = green * _FIVE
        gleam = shiny - shiny * matte * (_1 - (gleam if gleam < _1 else _1))
        mirror = gleam * lamp * open_ * (f0 + (_1 - rough) * _RIM * graze * graze * graze)
        direct = direct * lamp * gleam
        pk = pk * lit
        store0(number, A_OUT * cap + i, red * dr + direct * (kr * pk + fr * pf + rr * pl) + mirror * mr)
        store1(number, (A_OUT + 1) * cap + i, green * dg + direct * (kg * pk + fg * pf + rg * pl) + mirror * mg)
        store2(number, (A_OUT + 2) * cap + i, blue * db + direct * (kb * pk + fb * pf + rb * pl) + mirror * mb)


@kernel
def _wire_run(first, last, width, ry, camera, plane, whole, number):
    """Darken fragments near the edges of their triangle: lines `width` [pixel] wide, soft by half a pixel."""
    for i in range(first, last):
        t = whole[W_TRIANGLE, i]
        rx = (whole[W_PIXEL, i] + 0.5 - camera[C_X]) / camera[C_FOCAL]
        near = 1e9
        for k in range(3):
            px, py = plane[t, 3 * k] + 0.0, plane[t, 3 * k + 1] + 0.0
            w = px * rx + py * ry + plane[t, 3 * k + 2]
            near = min(near, abs(w) * camera[C_FOCAL] / np.sqrt(px * px + py * py + 1e-30))
        keep = 1.0 - 0.75 * min(max(0.5 * width + 0.5 - near, 0.0), 1.0)
        for c in range(A_OUT, A_OUT + 3):
            number[c, i] *= keep


# ------------------------------------------------------------------------------------------------------ 4. adding


@kernel(inline=True)
def _encode(table, value):
    """The sRGB byte of linear light."""
    at = np.int32(value * _CODES)
    at = at if at > 0 else np.int32(0)
    return load(table, at if at < ENCODE else np.int32(ENCODE - 1))


@kernel(inline=True)
def _encoded(table, red, green, blue):
    """Three sRGB bytes in one word, red lowest."""
    return _encode(table, red) | _encode(table, green) << 8 | _encode(table, blue) << 16


@kernel
def _encode_row(n, table, whole, number):
    """Put the colours of the n fragments of a row as bytes in place of their triangles."""
    cap = number.shape[1]
    for i in range(n):
        red, green, blue = (
            load(number, A_OUT * cap + i),
            load(number, (A_OUT + 1) * cap + i),
            load(number, (A_OUT + 2) * cap + i),
        )
        store0(whole, W_TRIANGLE * cap + i, _encoded(table, red, green, blue))


@kernel(inline=True)
def _fill(first, last, word, row):
    """Set the pixels first..last-1 of a row to one colour."""
    red, green, blue = np.uint8(word & 255), np.uint8((word >> 8) & 255), np.uint8(word >> 16)
    for x in range(first, last):
        row[x, 0], row[x, 1], row[x, 2] = red, green, blue


@kernel
def _resolve_row(n, back, table, whole, number, row):
    """Write a row of bytes (w, 3): fragments weighted by their samples, over the linear colour `back` (3,)."""
    r0, g0, b0 = np.float32(back[0]), np.float32(back[1]), np.float32(back[2])
    empty = _encoded(table, r0, g0, b0)
    i, end = 0, np.int64(0)
    while i < n:
        x = np.int64(whole[W_PIXEL, i])
        _fill(end, x, empty, row)
        end = x + 1
        if whole[W_SAMPLES, i] == 4:
            _fill(x, end, np.int64(whole[W_TRIANGLE, i]), row)
            i += 1
            continue
        red, green, blue, rest = _0, _0, _0, _1
        while i < n and whole[W_PIXEL, i] == x:
            part = np.float32(0.25) * np.float32(whole[W_SAMPLES, i])
            red += part * number[A_OUT, i]
            green += part * number[A_OUT + 1, i]
            blue += part * number[A_OUT + 2, i]
            rest -= part
            i += 1
        _fill(x, end, _encoded(table, red + rest * r0, green + rest * g0, blue + rest * b0), row)
    _fill(end, row.shape[0], empty, row)


@kernel
def _blend_row(n, opacity, table, whole, number, row):
    """Lay fragments over the bytes already in a row, with `opacity` [0, 1] where they cover the whole pixel."""
    for i in range(n):
        x, part = whole[W_PIXEL, i], 0.25 * opacity * whole[W_SAMPLES, i]
        for c in range(3):
            old = np.float64(row[x, c])
            row[x, c] = int(old + part * (np.float64(_encode(table, number[A_OUT + c, i])) - old) + 0.5)


@kernel
def _shade_band(band, opacity, mesh, camera, vertex, plane, seen, paint, shadow, step, number, out):
    """Colour one band of rows; over the background, or over `out` if opacity is not negative."""
    triangle, item, material = mesh.triangle, mesh.item, paint.material
    row32, table, bias = paint.material32, paint.encode, np.float32(shadow.bias)
    centre, focal = np.float32(camera[C_X]), np.float32(camera[C_FOCAL])
    for y in range(band * BAND, min((band + 1) * BAND, out.shape[0])):
        ry = (camera[C_Y] - y - 0.5) / camera[C_FOCAL]
        height = np.float32(ry)
        n, whole = seen.found[y], seen.fragment[y]
        _attribute_row(n, height, centre, focal, triangle, vertex, plane, whole, number)
        first = np.int64(0)  # as a literal it would be compiled for twice
        while first < n:
            m, last = item[whole[W_TRIANGLE, first]], first + 1
            while last < n and item[whole[W_TRIANGLE, last]] == m:
                last += 1
            colour, row = A_RED, material[m]
            if row[M_SHADE_RADIUS] > 0.0:
                _contact_run(first, last, y, camera, row, step, seen.nearest, whole, number)
            if row[M_SOURCE] == 1.0:
                k = int(row[M_TEXTURE])
                top, colour = np.float32(paint.level_count[k] - 1), A_TEXTURE
                _texture_run(first, last, paint.texel, paint.level, 3 * paint.level.shape[1] * k, top, number)
            light, ambient = paint.light, paint.ambient
            if bias > _0 and opacity < 0.0:
                places = (W_PIXEL, A_DEPTH, A_LIT)
                shadow_run(
                    first, last, height, centre, focal, shadow.to_light, bias, places, whole, number, shadow.moment
                )
            _light_run(first, last, colour, height, centre, focal, light, ambient, row32[m], whole, number)
            if row[M_WIRE] > 0.0:
                _wire_run(first, last, row[M_WIRE], ry, camera, plane, whole, number)
            first = last
        if opacity >= 0.0:
            _blend_row(n, opacity, table, whole, number, out[y])
        else:
            _encode_row(n, table, whole, number)
            _resolve_row(n, paint.background[y], table, whole, number, out[y])


@kernel(parallel=True)
def shade_pass(order, opacity, mesh, camera, vertex, plane, seen, paint, shadow, step, number, out):
    """Write the picture `out` (h, w, 3) sRGB bytes; bands are dealt out as in `coverage_pass`.

    opacity : in [0, 1] blends over what `out` holds, negative draws over the background
    shadow : of the key light, bias 0 = none   step : (taps, 3) of the contact shade
    number : (slots, N_NUMBER, row_length) work space of each thread
    """
    for k in prange(order.shape[0]):
        b = order[k]
        _shade_band(b, opacity, mesh, camera, vertex, plane, seen, paint, shadow, step, number[get_thread_id()], out)
