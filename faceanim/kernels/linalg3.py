"""Small linear algebra on 3-vectors and symmetric 3 x 3 matrices kept as (xx, xy, xz, yy, yz, zz)."""

from __future__ import annotations

from faceanim.ground.jit import kernel


@kernel(inline=True)
def solve_symmetric(b, i, x, y, z):
    """Return the solution of B u = (x, y, z) for the positive definite matrix stored in row `i` of `b` (n, 6)."""
    xx = b[i, 0]
    xy = b[i, 1]
    xz = b[i, 2]
    yy = b[i, 3]
    yz = b[i, 4]
    zz = b[i, 5]
    c0 = yy * zz - yz * yz
    c1 = xz * yz - xy * zz
    c2 = xy * yz - xz * yy
    det = 1.0 / (xx * c0 + xy * c1 + xz * c2)
    c3 = xx * zz - xz * xz
    c4 = xy * xz - xx * yz
    c5 = xx * yy - xy * xy
    return det * (c0 * x + c1 * y + c2 * z), det * (c1 * x + c3 * y + c4 * z), det * (c2 * x + c4 * y + c5 * z)


@kernel(inline=True)
def add_outer(b, i, s, x, y, z):
    """Add s (x, y, z)(x, y, z)^T to the symmetric matrix in row `i` of `b` (n, 6)."""
    b[i, 0] += s * x * x
    b[i, 1] += s * x * y
    b[i, 2] += s * x * z
    b[i, 3] += s * y * y
    b[i, 4] += s * y * z
    b[i, 5] += s * z * z


@kernel(inline=True)
def add_identity(b, i, s):
    """Add s I to the symmetric matrix in row `i` of `b` (n, 6)."""
    b[i, 0] += s
    b[i, 3] += s
    b[i, 5] += s


@kernel
def invert_symmetric(b, out):
    """Write the inverses of the symmetric positive definite matrices `b` (n, 6) into `out` (n, 6)."""
    for i in range(len(b)):
        out[i, 0], out[i, 1], out[i, 2] = solve_symmetric(b, i, 1.0, 0.0, 0.0)
        _, out[i, 3], out[i, 4] = solve_symmetric(b, i, 0.0, 1.0, 0.0)
        _, _, out[i, 5] = solve_symmetric(b, i, 0.0, 0.0, 1.0)


@kernel
def multiply_symmetric(b, x, out):
    """Write B x into `out` (n, 3) for symmetric matrices `b` (n, 6) and vectors `x` (n, 3)."""
    for i in range(len(b)):
        u = x[i, 0]
        v = x[i, 1]
        w = x[i, 2]
        out[i, 0] = b[i, 0] * u + b[i, 1] * v + b[i, 2] * w
        out[i, 1] = b[i, 1] * u + b[i, 3] * v + b[i, 4] * w
        out[i, 2] = b[i, 2] * u + b[i, 4] * v + b[i, 5] * w
