"""Rotation-strain shapes: each element turned by exp([w]x) of its own rotation and stretched by its own strain."""

from __future__ import annotations

from faceanim.ground.jit import kernel
from faceanim.kernels.warp import coefficients, turn


@kernel(inline=True)
def _gradient(tets, gradients, e, values, out):
    """Write the gradient of element `e` of the nodal `values` into `out` (3, 3): out[i, j] = d value_i / d x_j."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for a in range(4):
                total += values[tets[e, a], i] * gradients[e, a, j]
            out[i, j] = total


@kernel(inline=True)
def _rotate_rows(h, out):
    """Write exp([w]x)(I + eps) into `out` (3, 3), with w and eps the skew and symmetric parts of `h`; return w."""
    wx = 0.5 * (h[2, 1] - h[1, 2])
    wy = 0.5 * (h[0, 2] - h[2, 0])
    wz = 0.5 * (h[1, 0] - h[0, 1])
    a, _, sine = coefficients(wx * wx + wy * wy + wz * wz)
    for j in range(3):
        x = 0.5 * (h[0, j] + h[j, 0])
        y = 0.5 * (h[1, j] + h[j, 1])
        z = 0.5 * (h[2, j] + h[j, 2])
        if j == 0:
            x += 1.0
        elif j == 1:
            y += 1.0
        else:
            z += 1.0
        out[0, j], out[1, j], out[2, j] = turn(sine, a, wx, wy, wz, x, y, z)
    return wx, wy, wz


@kernel
def rotation_strain(tets, gradients, volumes, local, scratch, out):
    """Write sum_e V_e F_e g_a of every node into `out` (n, 3), F_e = exp([w_e]x)(I + eps_e).

    It is the right side of the Poisson problem min sum V_e |grad x - F_e|^2.
    local : (n, 3 or more) local displacements   scratch : (3, 3, 3)
    """
    out[:] = 0.0
    for e in range(len(tets)):
        _gradient(tets, gradients, e, local, scratch[0])
        _rotate_rows(scratch[0], scratch[1])
        for a in range(4):
            for i in range(3):
                total = 0.0
                for j in range(3):
                    total += scratch[1, i, j] * gradients[e, a, j]
                out[tets[e, a], i] += volumes[e] * total


@kernel
def rotation_strain_force(tets, gradients, volumes, local, y, scratch, out):
    """Write the forces on the local displacements into `out` (n, 3): derivative of sum V_e <grad y, F_e>.

    local : (n, 3 or more) local displacements   y : (n, 3) solution of the Poisson problem for the load
    """
    out[:] = 0.0
    for e in range(len(tets)):
        h, f, g = scratch[0], scratch[1], scratch[2]
        _gradient(tets, gradients, e, local, h)
        _gradient(tets, gradients, e, y, g)
        wx = 0.5 * (h[2, 1] - h[1, 2])
        wy = 0.5 * (h[0, 2] - h[2, 0])
        wz = 0.5 * (h[1, 0] - h[0, 1])
        a, b, sine = coefficients(wx * wx + wy * wy + wz * wz)
        for j in range(3):  # f = R^T grad y
            f[0, j], f[1, j], f[2, j] = turn(-sine, a, wx, wy, wz, g[0, j], g[1, j], g[2, j])
        for i in range(3):  # g = f (I + eps)
            for j in range(3):
                total = f[i, j]
                for k in range(3):
                    total += f[i, k] * 0.5 * (h[k, j] + h[j, k])
                g[i, j] = total
        tx, ty, tz = turn(a, b, wx, wy, wz, g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1])
        for i in range(3):
            for j in range(3):
                h[i, j] = 0.5 * (f[i, j] + f[j, i])
        h[2, 1] += 0.5 * tx
        h[1, 2] -= 0.5 * tx
        h[0, 2] += 0.5 * ty
        h[2, 0] -= 0.5 * ty
        h[1, 0] += 0.5 * tz
        h[0, 1] -= 0.5 * tz
        for n in range(4):
            for i in range(3):
                total = 0.0
                for j in range(3):
                    total += h[i, j] * gradients[e, n, j]
                out[tets[e, n], i] += volumes[e] * total
