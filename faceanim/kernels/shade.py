"""Shading: from the samples of the rasteriser to sRGB bytes, one evaluation per pixel and surface seen in it.

Light is linear: three directional lights with wrapped diffuse reflection (each colour has its own width, red the
widest, as light that entered skin comes out redder), a microfacet highlight, and a sky and ground ambient term darkened
by occlusion. Occlusion is stored per vertex; eyes, teeth and tongue add a contact shade taken from the depth samples.

A row of pixels is worked off in stages over a small table of its fragments: interpolate their attributes, look up the
texture and the shadow, light them (vector instructions), add them up. `whole` is the row of `Frame.fragment`.
"""

from __future__ import annotations

import numpy as np

from faceanim.ground.jit import kernel, prange
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
    M_BLUE,
    M_FLAT,
    M_GLOW,
    M_GREEN,
    M_MATTE,
    M_RED,
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
A_NX, A_NY, A_NZ, A_OPEN, A_RED, A_GREEN, A_BLUE, A_MIP, A_DEPTH, A_LIT = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
A_TEXTURE, A_OUT, N_NUMBER = 10, 13, 16

_0, _1, _2, _4 = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(4.0)
_DECODE, _TEN, _SHIFT1, _SHIFT2 = np.float32(1023.0**-2), np.uint32(1023), np.uint32(10), np.uint32(20)
_HALF, _TINY, _EDGE = np.float32(0.5), np.float32(1e-12), np.float32(0.1)
_REDDEN, _FIVE, _LEAST = np.float32(0.8), np.float32(5.0), np.float32(1e-30)
_SHADED, _BOUNCE, _RIM = np.float32(0.22), np.float32(0.8), np.float32(0.35)

store0, store1, store2 = STORE[0], STORE[1], STORE[2]


# -------------------------------------------------------------------------------------------------- 1. attributes


@kernel
def _attribute_row(n, ry, centre, focal, triangle, item, uv, vertex, plane, row, whole, number):
    """Interpolate normal, occlusion and colour (or texture position) of the n fragments of a row, all in float32."""
    for i in range(n):
        t = whole[W_TRIANGLE, i]
        m = item[t]
        rx = (np.float32(whole[W_PIXEL, i]) + _HALF - centre) / focal
        # A pixel centre beside a triangle that covers only some samples takes the value of the nearest corner or edge.
        w0 = max(plane[t, 0] * rx + plane[t, 1] * ry + plane[t, 2], _0)
        w1 = max(plane[t, 3] * rx + plane[t, 4] * ry + plane[t, 5], _0)
        w2 = max(plane[t, 6] * rx + plane[t, 7] * ry + plane[t, 8], _0)
        total = _1 / max(w0 + w1 + w2, _LEAST)
        w0, w1, w2 = w0 * total, w1 * total, w2 * total
        a, b, c = triangle[t, 0], triangle[t, 1], triangle[t, 2]
        side = plane[t, P_SIDE]
        number[A_NX, i] = side * (w0 * vertex[a, 0] + w1 * vertex[b, 0] + w2 * vertex[c, 0])
        number[A_NY, i] = side * (w0 * vertex[a, 1] + w1 * vertex[b, 1] + w2 * vertex[c, 1])
        number[A_NZ, i] = side * (w0 * vertex[a, 2] + w1 * vertex[b, 2] + w2 * vertex[c, 2])
        open_ = w0 * vertex[a, 3] + w1 * vertex[b, 3] + w2 * vertex[c, 3]
        number[A_OPEN, i] = open_ if side > _0 else open_ * row[m, M_BACK]
        number[A_DEPTH, i] = w0 * vertex[a, 7] + w1 * vertex[b, 7] + w2 * vertex[c, 7]
        number[A_LIT, i] = _1
        source = row[m, M_SOURCE]
        if source == _1:
            number[A_RED, i] = w0 * uv[t, 0] + w1 * uv[t, 2] + w2 * uv[t, 4]
            number[A_GREEN, i] = w0 * uv[t, 1] + w1 * uv[t, 3] + w2 * uv[t, 5]
            number[A_MIP, i] = plane[t, P_MIP]
        elif source == _2:
            number[A_RED, i] = w0 * vertex[a, 4] + w1 * vertex[b, 4] + w2 * vertex[c, 4]
            number[A_GREEN, i] = w0 * vertex[a, 5] + w1 * vertex[b, 5] + w2 * vertex[c, 5]
            number[A_BLUE, i] = w0 * vertex[a, 6] + w1 * vertex[b, 6] + w2 * vertex[c, 6]
        else:
            number[A_RED, i] = row[m, M_RED]
            number[A_GREEN, i] = row[m, M_GREEN]
            number[A_BLUE, i] = row[m, M_BLUE]


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
    """Linear colour of fragments first..last-1 from one texture, mixed between the two mip levels next to A_MIP.

    table : where the texture's first level is described in `level`   top : its last level
    """
    cap = number.shape[1]
    for i in range(first, last):
        u, v, mip = load(number, A_RED * cap + i), load(number, A_GREEN * cap + i), load(number, A_MIP * cap + i)
        mip = mip if mip > _0 else _0
        mip = mip if mip < top else top
        low = np.int32(mip)
        part = mip - np.float32(low)
        at = table + 3 * low
        r0, g0, b0 = _bilinear(texel, level, at, u, v)
        r1, g1, b1 = _bilinear(texel, level, at + (3 if part > _0 else 0), u, v)
        store0(number, A_TEXTURE * cap + i, (r0 + part * (r1 - r0)) * _DECODE)
        store1(number, (A_TEXTURE + 1) * cap + i, (g0 + part * (g1 - g0)) * _DECODE)
        store2(number, (A_TEXTURE + 2) * cap + i, (b0 + part * (b1 - b0)) * _DECODE)


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
    (
        """Light fragments first..last-1, all of the material `row`, their colour from column `colour` on.

    light : (3, 6), ambient : (3, 3), all float32
    """
        ""
    )
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
    lamp, shiny, matte = _1 - flat, _1 if f0 > _0 else _0, row[M_MATTE]
    for i in range(first, last):
        nx, ny, nz = load(number, A_NX * cap + i), load(number, A_NY * cap + i), load(number, A_NZ * cap + i)
        square = nx * nx + ny * ny + nz * nz
        s = _1 / np.sqrt(square if square > _TINY else _TINY)
        nx, ny, nz = nx * s, ny * s, nz * s
        x = (np.float32(load(whole, W_PIXEL * cap + i)) + _HALF - centre) / focal
        vz = -_1 / np.sqrt(x * x + ry * ry + _1)
        vx, vy = x * vz, ry * vz
        open_ = load(number, A_OPEN * cap + i)
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
    return table[min(max(int(value * (ENCODE / ENCODE_TOP)), 0), ENCODE - 1)]


@kernel
def _resolve_row(n, back, table, whole, number, row):
    """Write a row of bytes (w, 3): fragments weighted by their samples, over the linear colour `back` (3,)."""
    b0, b1, b2 = _encode(table, back[0]), _encode(table, back[1]), _encode(table, back[2])
    i = 0
    for x in range(row.shape[0]):
        red, green, blue, rest = 0.0, 0.0, 0.0, 4
        while i < n and whole[W_PIXEL, i] == x:
            k = whole[W_SAMPLES, i]
            red += k * number[A_OUT, i]
            green += k * number[A_OUT + 1, i]
            blue += k * number[A_OUT + 2, i]
            rest -= k
            i += 1
        if rest == 4:
            row[x, 0], row[x, 1], row[x, 2] = b0, b1, b2
        else:
            row[x, 0] = _encode(table, 0.25 * (red + rest * back[0]))
            row[x, 1] = _encode(table, 0.25 * (green + rest * back[1]))
            row[x, 2] = _encode(table, 0.25 * (blue + rest * back[2]))


@kernel
def _blend_row(n, opacity, table, whole, number, row):
    """Lay fragments over the bytes already in a row, with `opacity` [0, 1] where they cover the whole pixel."""
    for i in range(n):
        x, part = whole[W_PIXEL, i], 0.25 * opacity * whole[W_SAMPLES, i]
        for c in range(3):
            old = np.float64(row[x, c])
            row[x, c] = int(old + part * (np.float64(_encode(table, number[A_OUT + c, i])) - old) + 0.5)


@kernel
def _shade_band(band, opacity, mesh, camera, frame, paint, shadow, step, number, out):
    """Colour one band of rows; over the background, or over `out` if opacity is not negative."""
    triangle, item, plane, material = mesh.triangle, mesh.item, frame.plane, paint.material
    row32, table = paint.material32, paint.encode
    centre, focal = np.float32(camera[C_X]), np.float32(camera[C_FOCAL])
    for y in range(band * BAND, min((band + 1) * BAND, out.shape[0])):
        ry = (camera[C_Y] - y - 0.5) / camera[C_FOCAL]
        height = np.float32(ry)
        n, whole = frame.found[y], frame.fragment[y]
        _attribute_row(n, height, centre, focal, triangle, item, mesh.uv, frame.vertex, plane, row32, whole, number)
        first = 0
        while first < n:
            m, last = item[whole[W_TRIANGLE, first]], first + 1
            while last < n and item[whole[W_TRIANGLE, last]] == m:
                last += 1
            colour, row = A_RED, material[m]
            if row[M_SHADE_RADIUS] > 0.0:
                _contact_run(first, last, y, camera, row, step, frame.nearest, whole, number)
            if row[M_SOURCE] == 1.0:
                k = int(row[M_TEXTURE])
                top, colour = np.float32(paint.level_count[k] - 1), A_TEXTURE
                _texture_run(first, last, paint.texel, paint.level, 3 * paint.level.shape[1] * k, top, number)
            light, ambient = paint.light, paint.ambient
            if shadow.bias > 0.0 and opacity < 0.0:
                to_light, bias = shadow.to_light, np.float32(shadow.bias)
                places = (W_PIXEL, A_DEPTH, A_LIT)
                shadow_run(first, last, height, centre, focal, to_light, bias, places, whole, number, shadow.moment)
            _light_run(first, last, colour, height, centre, focal, light, ambient, row32[m], whole, number)
            if row[M_WIRE] > 0.0:
                _wire_run(first, last, row[M_WIRE], ry, camera, plane, whole, number)
            first = last
        if opacity >= 0.0:
            _blend_row(n, opacity, table, whole, number, out[y])
        else:
            _resolve_row(n, paint.background[y], table, whole, number, out[y])


@kernel(parallel=True)
def shade_pass(order, opacity, mesh, camera, frame, paint, shadow, step, number, out):
    """Write the picture `out` (h, w, 3) sRGB bytes; bands are dealt out as in `coverage_pass`.

    opacity : in [0, 1] blends over what `out` holds, negative draws over the background
    shadow : of the key light, bias 0 = none   step : (taps, 3) of the contact shade
    number : (bands, N_NUMBER, 4 w) work space
    """
    for k in prange(order.shape[0]):
        b = order[k]
        _shade_band(b, opacity, mesh, camera, frame, paint, shadow, step, number[b], out)
