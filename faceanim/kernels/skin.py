"""Forces of springs and shear layer together, without stiffness bounds: the inner loop of the gradient schemes.

Per edge of a triangle the shear layer adds w d + b |d|^2 d, d = difference of the displacements u = x - anchor at its
ends (see `attachment`), w and b being this triangle's share.
"""

from __future__ import annotations

import numpy as np

from faceanim.ground.jit import kernel
from faceanim.kernels.memory import STORE, add4, copy3, load
from faceanim.kernels.spring_triangle import (
    BLOCK,
    binomials,
    collect_corners,
    corner_point,
    forces_along_edges,
    indicators,
    is_small_integer,
    spring_answers,
    triangle_shape,
)

_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7, _S8, _S9, _S10, _S11 = STORE[:12]
_SHIFT = 3
"""The displacements of the corners come after their three positions in the block's work space."""


@kernel(inline=True)
def _sheared(layer, slot, a, b):
    """Return the force of one edge's shear on its end `a`, given the displacements of both ends."""
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    w = load(layer.shear, slot) + load(layer.growth, slot) * (dx * dx + dy * dy + dz * dz)
    return w * dx, w * dy, w * dz


@kernel(inline=True)
def _block(springs, layer, corner, result, first, count, law, reaction):
    """Compute the forces on the corners of the `count` triangles of the block that starts at `first`."""
    total = springs.a.size
    for q in range(count):
        slot = first + q
        u, v, squares, reciprocals, t = triangle_shape(corner, q)
        tension, _, g, _ = spring_answers(springs, slot, squares, reciprocals, law)
        a, b, c = forces_along_edges(tension, g, t, reaction)
        p, s, r = (
            corner_point(corner, _SHIFT, q),
            corner_point(corner, _SHIFT + 1, q),
            corner_point(corner, _SHIFT + 2, q),
        )
        ux, uy, uz = _sheared(layer, slot, s, r)
        vx, vy, vz = _sheared(layer, total + slot, r, p)
        wx, wy, wz = _sheared(layer, 2 * total + slot, p, s)
        i, j, k = 4 * q, 4 * (BLOCK + q), 4 * (2 * BLOCK + q)
        _S0(result, i, a[0] * u[0] + a[1] * v[0] + wx - vx)
        _S1(result, i + 1, a[0] * u[1] + a[1] * v[1] + wy - vy)
        _S2(result, i + 2, a[0] * u[2] + a[1] * v[2] + wz - vz)
        _S3(result, i + 3, 0.0)
        _S4(result, j, b[0] * u[0] + b[1] * v[0] + ux - wx)
        _S5(result, j + 1, b[0] * u[1] + b[1] * v[1] + uy - wy)
        _S6(result, j + 2, b[0] * u[2] + b[1] * v[2] + uz - wz)
        _S7(result, j + 3, 0.0)
        _S8(result, k, c[0] * u[0] + c[1] * v[0] + vx - ux)
        _S9(result, k + 1, c[0] * u[1] + c[1] * v[1] + vy - uy)
        _S10(result, k + 2, c[0] * u[2] + c[1] * v[2] + vz - uz)
        _S11(result, k + 3, 0.0)


@kernel
def skin_force(x, shift, springs, layer, law, scratch, out):
    """Write the forces of springs and shear layer on every vertex into `out` (n, 4), zeros into its last column.

    x : (n, 3) [mm]   shift : (n, 3) x minus anchor [mm]   springs, layer, law : see `tables`
    scratch : `force_scratch(springs)`
    """
    total = springs.a.size
    smooth = is_small_integer(law.alpha, 0.0) and is_small_integer(law.beta, 1.0)
    reaction = 1.0 * law.reaction
    whole = (law.alpha, 1.0 / (law.s0 * law.s0), law.beta, binomials(law.alpha))
    powers = indicators(law.beta)
    corner = scratch.corner
    result = scratch.result
    for i in range(out.shape[0]):
        for d in range(4):
            out[i, d] = 0.0
    for first in range(0, total, BLOCK):
        count = min(BLOCK, total - first)
        collect_corners(x, springs, corner, first, count)
        for q in range(count):
            i = first + q
            copy3(corner, 3 * (_SHIFT * BLOCK + q), shift, 3 * np.intp(load(springs.a, i)))
            copy3(corner, 3 * ((_SHIFT + 1) * BLOCK + q), shift, 3 * np.intp(load(springs.b, i)))
            copy3(corner, 3 * ((_SHIFT + 2) * BLOCK + q), shift, 3 * np.intp(load(springs.c, i)))
        if smooth:
            _block(springs, layer, corner, result, first, count, (*whole, False, powers, False), reaction)
        else:
            _block(springs, layer, corner, result, first, count, (*whole, True, powers, True), reaction)
        for q in range(count):
            i = first + q
            add4(out, 4 * np.intp(load(springs.a, i)), result, 4 * q)
            add4(out, 4 * np.intp(load(springs.b, i)), result, 4 * (BLOCK + q))
            add4(out, 4 * np.intp(load(springs.c, i)), result, 4 * (2 * BLOCK + q))
