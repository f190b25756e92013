"""Elastic forces and energy of the skin springs of a whole surface; `spring_triangle` holds the formulas.

Triangles are worked on in blocks that stay in the first-level cache: copy the corners in, compute (vector
instructions), add the twelve results to the vertices. The sum at a vertex runs over triangles in ascending order, so
results are the same to the byte in every run.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faceanim.ground.jit import kernel
from faceanim.kernels.memory import STORE, add4, load, prefetch
from faceanim.kernels.spring_triangle import (
    BLOCK,
    binomials,
    collect_corners,
    forces_along_edges,
    growth_energy,
    indicators,
    is_small_integer,
    repulsion_energy,
    spring_answers,
    stiffness_bounds,
    triangle_shape,
)
from faceanim.kernels.tables import Springs

_PORTION = 16  # of a block, computed between two requests for tables that will be read one block later ...
_MANY = 32768  # ... where there are so many triangles that their tables come from main memory

# A kernel cannot index a tuple of functions.
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7, _S8, _S9, _S10, _S11 = STORE[:12]


class ForceScratch(NamedTuple):
    """Work space of the force kernels for one block of triangles.

    corner : (6, BLOCK, 3) the corners A, B, C [mm] and, for `skin_force`, their displacements, flat
    result : (3, BLOCK, 4) force [mN] and stiffness [mN/mm] of the corners, flat; for `elastic_gradient_blocks` the
        nine numbers of each corner as (3, BLOCK, 4), (3, BLOCK, 4), (3, BLOCK)
    """

    corner: NDArray[np.float64]
    result: NDArray[np.float64]


def _aligned(size: int) -> NDArray[np.float64]:
    raw = np.zeros(size + 8)
    skip = (-raw.ctypes.data % 64) // 8
    return raw[skip : skip + size]


def force_scratch(springs: Springs) -> ForceScratch:
    """Return work space for the force kernels on `springs`; not to be shared between threads."""
    return ForceScratch(_aligned(18 * BLOCK), _aligned(27 * BLOCK))


@kernel(inline=True)
def _block(springs, corner, result, first, begin, end, law, reaction):
    """Compute force and stiffness on the corners of triangles `begin`..`end` of the block that starts at `first`."""
    for q in range(begin, end):
        u, v, squares, reciprocals, t = triangle_shape(corner, q)
        tension, tangent, g, slope = spring_answers(springs, first + q, squares, reciprocals, law)
        a, b, c = forces_along_edges(tension, g, t, reaction)
        i, j, k = 4 * q, 4 * (BLOCK + q), 4 * (2 * BLOCK + q)
        _S0(result, i, a[0] * u[0] + a[1] * v[0])
        _S1(result, i + 1, a[0] * u[1] + a[1] * v[1])
        _S2(result, i + 2, a[0] * u[2] + a[1] * v[2])
        _S4(result, j, b[0] * u[0] + b[1] * v[0])
        _S5(result, j + 1, b[0] * u[1] + b[1] * v[1])
        _S6(result, j + 2, b[0] * u[2] + b[1] * v[2])
        _S8(result, k, c[0] * u[0] + c[1] * v[0])
        _S9(result, k + 1, c[0] * u[1] + c[1] * v[1])
        _S10(result, k + 2, c[0] * u[2] + c[1] * v[2])
        ka, kb, kc = stiffness_bounds(tangent, g, slope, t, squares, reciprocals, reaction)
        _S3(result, i + 3, ka)
        _S7(result, j + 3, kb)
        _S11(result, k + 3, kc)


@kernel(inline=True)
def _add_up(springs, result, first, count, out):
    """Add the block's results to the vertices, triangle after triangle."""
    for q in range(count):
        i = first + q
        add4(out, 4 * np.intp(load(springs.a, i)), result, 4 * q)
        add4(out, 4 * np.intp(load(springs.b, i)), result, 4 * (BLOCK + q))
        add4(out, 4 * np.intp(load(springs.c, i)), result, 4 * (2 * BLOCK + q))


@kernel(inline=True)
def _ask_for(springs, first, count):
    """Ask for the tables of `count` triangles from `first` on, to be read soon."""
    total = springs.a.size
    for q in range(first, first + count, 8):
        for k in range(3):
            prefetch(springs.edge_length, k * total + q)
            prefetch(springs.edge_stiffness, k * total + q)
            prefetch(springs.height, k * total + q)
            prefetch(springs.height_stiffness, k * total + q)
            prefetch(springs.repulsion, k * total + q)


@kernel
def elastic_force(x, springs, law, scratch, out):
    """Write the elastic force on every vertex and a bound of its stiffness into `out`.

    x : (n, 3) [mm]   springs : `Springs`   law : `Law`   scratch : `force_scratch(springs)`
    out : (n, 4): force fx, fy, fz [mN] and k [mN/mm]

    The bound k (with reaction). Let H be the exact Hessian of the elastic energy at x. Then 2 diag(k) - H is positive
    semidefinite, hence the semi-implicit step (m + dt D + dt^2 k) v' = m v + dt F(x) is stable for every dt at the
    state it is linearised about (its modes need no more than k >= eigenvalue / 2).
    - Edge spring: H <= max(tangent, tension / l) (e_i - e_j)(e_i - e_j)^T x I, the tangent is the larger one, and
      (a - b)^2 <= 2 a^2 + 2 b^2: k gets the tangent at both ends. Compression only lowers H.
    - Repulsion spring: with the weights w = (1, -(1-t), -t) of corner and edge ends, the material part of H is
      -g'(h) (w w^T) x (n n^T), and (w.z)^2 <= W sum |w_i| z_i^2 with W = sum |w_i|: k_i gets |w_i| W / 2 times -g'.
      This is all of it at rest or for linear springs, where g = 0. Away from rest the curvature of h adds, for
      g < 0, at most |g|/h (w w^T) x (I - n n^T), and for g > 0 at most that along the edge plus
      2 g h times the squared rotation of the edge, <= 4 g h (z_a^2 + z_b^2) / L^2: hence the maximum of -g' and
      |g| / h in place of -g', and 2 g h / L^2 more at the edge ends.
    With reaction = 0 the matrix is not symmetric; k then has the corner's own share |w| W / 2 of row-wise Gershgorin
    discs, which bounds the moduli of the eigenvalues but proves no stability, for such forces can do work in a cycle.
    """
    total = springs.a.size
    smooth_alpha = is_small_integer(law.alpha, 0.0)
    smooth_beta = is_small_integer(law.beta, 1.0)
    reaction = 1.0 * law.reaction
    whole = (law.alpha, 1.0 / (law.s0 * law.s0), law.beta, binomials(law.alpha))
    powers = indicators(law.beta)
    corner = scratch.corner
    result = scratch.result
    many = total > _MANY
    portion = _PORTION if many else BLOCK
    for i in range(out.shape[0]):
        for d in range(4):
            out[i, d] = 0.0
    for first in range(0, total, BLOCK):
        count = min(BLOCK, total - first)
        collect_corners(x, springs, corner, first, count)
        for begin in range(0, count, portion):
            end = min(begin + portion, count)
            if many:
                _ask_for(springs, first + BLOCK + begin, _PORTION)
            if smooth_alpha and smooth_beta:
                _block(springs, corner, result, first, begin, end, (*whole, False, powers, False), reaction)
            elif smooth_beta:
                _block(springs, corner, result, first, begin, end, (*whole, True, powers, False), reaction)
            elif smooth_alpha:
                _block(springs, corner, result, first, begin, end, (*whole, False, powers, True), reaction)
            else:
                _block(springs, corner, result, first, begin, end, (*whole, True, powers, True), reaction)
        _add_up(springs, result, first, count, out)


@kernel(inline=True)
def _difference(x, i, j):
    return x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]


@kernel
def elastic_energy(x, springs, law):
    """Return the energy of all springs [mN mm = 1e-6 J], zero at rest; its negative gradient is `elastic_force`.

    x : (n, 3) [mm]   springs : `Springs`   law : `Law` (with reaction = 0 the forces have no energy; this is that of
    reaction = 1). Infinite where a triangle with repulsion has no height.
    """
    smooth = is_small_integer(law.alpha, 0.0)
    energy = 0.0
    for q in range(springs.a.size):
        a, b, c = springs.a[q], springs.b[q], springs.c[q]
        ux, uy, uz = _difference(x, b, c)
        vx, vy, vz = _difference(x, c, a)
        wx, wy, wz = _difference(x, a, b)
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        area = math.sqrt(nx * nx + ny * ny + nz * nz)
        lengths = (
            math.sqrt(ux * ux + uy * uy + uz * uz),
            math.sqrt(vx * vx + vy * vy + vz * vz),
            math.sqrt(wx * wx + wy * wy + wz * wz),
        )
        for k in range(3):
            s = lengths[k] - springs.edge_length[k, q]
            energy += growth_energy(s, springs.edge_stiffness[k, q], law.alpha, law.s0, smooth)
            h = area / lengths[k]
            rest = springs.height[k, q]
            energy += growth_energy(h - rest, springs.height_stiffness[k, q], law.alpha, law.s0, smooth)
            energy += repulsion_energy(h, rest, springs.repulsion[k, q], law.beta)
    return energy
