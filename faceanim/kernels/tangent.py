"""Tangent stiffness of the skin springs, and the linear solver on it.

The matrix of a mesh is kept as symmetric 3 x 3 blocks `diagonal` (n, 6) per vertex and full blocks `coupling` (e, 9)
per edge, from its first vertex (row) to its second (column). `edge_of` (3, t) numbers the edge opposite each corner.

Second derivatives. Edge spring of length l, tension f, tangent k, unit vector u: k u u^T + (f/l)(I - u u^T).
Edge repulsion spring of height h, energy U(h): with n the unit vector from foot to corner, e the unit vector of the
edge of length L, m = e x n, w = (1, -(1-t), -t) and z = (0, -1, 1) for (corner, edge start, edge end),
    U'' (w n)(w n)^T + U' [ (w m)(w m)^T / h - ((w e)(z n)^T + (z n)(w e)^T) / L - (h / L^2) (z n)(z n)^T ].
The projected form keeps what is surely positive: k, max(f, 0)/l, U'', max(U', 0)/h.
"""

from __future__ import annotations

import math

from faceanim.ground.jit import kernel
from faceanim.kernels.attachment import growth
from faceanim.kernels.contact import plane_product
from faceanim.kernels.linalg3 import add_identity, add_outer


@kernel(inline=True)
def height_terms(h, rest, stiffness, repulsion, law):
    """Return the first and second derivative of the energy of an edge repulsion spring by its height."""
    s = h - rest
    secant, tangent = growth((s / law.s0) ** 2, law.alpha)
    r = rest / h
    push = repulsion * (r * r if law.beta == 2.0 else r**law.beta)
    return stiffness * secant * s - push + repulsion, stiffness * tangent + law.beta * push / h


@kernel
def add_edge(x, i, j, rest, stiffness, law, exact, diagonal, coupling, e):
    """Add the tangent of the structural spring between vertices `i` and `j` to the matrix (`coupling` row `e`)."""
    dx = x[j, 0] - x[i, 0]
    dy = x[j, 1] - x[i, 1]
    dz = x[j, 2] - x[i, 2]
    l = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx /= l
    dy /= l
    dz /= l
    s = l - rest
    secant, tangent = growth((s / law.s0) ** 2, law.alpha)
    across = stiffness * secant * s / l
    if across < 0.0 and not exact:
        across = 0.0
    along = stiffness * tangent - across
    xx = along * dx * dx + across
    xy = along * dx * dy
    xz = along * dx * dz
    yy = along * dy * dy + across
    yz = along * dy * dz
    zz = along * dz * dz + across
    for v in (i, j):
        diagonal[v, 0] += xx
        diagonal[v, 1] += xy
        diagonal[v, 2] += xz
        diagonal[v, 3] += yy
        diagonal[v, 4] += yz
        diagonal[v, 5] += zz
    coupling[e, 0] -= xx
    coupling[e, 1] -= xy
    coupling[e, 2] -= xz
    coupling[e, 3] -= xy
    coupling[e, 4] -= yy
    coupling[e, 5] -= yz
    coupling[e, 6] -= xz
    coupling[e, 7] -= yz
    coupling[e, 8] -= zz


@kernel(inline=True)
def add_block(coupling, e, flip, s, px, py, pz, qx, qy, qz):
    """Add s p q^T to the block of edge `e`, transposed if `flip`."""
    if flip:
        px, py, pz, qx, qy, qz = qx, qy, qz, px, py, pz
    coupling[e, 0] += s * px * qx
    coupling[e, 1] += s * px * qy
    coupling[e, 2] += s * px * qz
    coupling[e, 3] += s * py * qx
    coupling[e, 4] += s * py * qy
    coupling[e, 5] += s * py * qz
    coupling[e, 6] += s * pz * qx
    coupling[e, 7] += s * pz * qy
    coupling[e, 8] += s * pz * qz


@kernel
def add_height(x, i, a, b, rest, stiffness, repulsion, law, exact, diagonal, coupling, ei, ea, eb):
    """Add the tangent of the repulsion spring of corner `i` over edge (a, b).

    ei, ea, eb : the edges opposite i, a and b
    """
    ex = x[b, 0] - x[a, 0]
    ey = x[b, 1] - x[a, 1]
    ez = x[b, 2] - x[a, 2]
    length = math.sqrt(ex * ex + ey * ey + ez * ez)
    ex /= length
    ey /= length
    ez /= length
    nx = x[i, 0] - x[a, 0]
    ny = x[i, 1] - x[a, 1]
    nz = x[i, 2] - x[a, 2]
    t = nx * ex + ny * ey + nz * ez
    nx -= t * ex
    ny -= t * ey
    nz -= t * ez
    t /= length
    h = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx /= h
    ny /= h
    nz /= h
    first, second = height_terms(h, rest, stiffness, repulsion, law)
    out = first / h
    if not exact and out < 0.0:
        out = 0.0
    mx = ey * nz - ez * ny
    my = ez * nx - ex * nz
    mz = ex * ny - ey * nx
    wa = t - 1.0
    wb = -t
    if law.reaction == 0:
        wa = 0.0
        wb = 0.0
    add_outer(diagonal, i, second, nx, ny, nz)
    add_outer(diagonal, i, out, mx, my, mz)
    if wa == 0.0 and wb == 0.0:
        return
    add_outer(diagonal, a, wa * wa * second, nx, ny, nz)
    add_outer(diagonal, a, wa * wa * out, mx, my, mz)
    add_outer(diagonal, b, wb * wb * second, nx, ny, nz)
    add_outer(diagonal, b, wb * wb * out, mx, my, mz)
    # rows and columns: (i, a) is the edge opposite b, and so on; the smaller vertex is the row
    add_block(coupling, eb, i > a, wa * second, nx, ny, nz, nx, ny, nz)
    add_block(coupling, eb, i > a, wa * out, mx, my, mz, mx, my, mz)
    add_block(coupling, ea, i > b, wb * second, nx, ny, nz, nx, ny, nz)
    add_block(coupling, ea, i > b, wb * out, mx, my, mz, mx, my, mz)
    add_block(coupling, ei, a > b, wa * wb * second, nx, ny, nz, nx, ny, nz)
    add_block(coupling, ei, a > b, wa * wb * out, mx, my, mz, mx, my, mz)
    if exact:
        add_turning(i, a, b, first, h, length, wa, wb, (ex, ey, ez), (nx, ny, nz), diagonal, coupling, ei, ea, eb)


@kernel
def add_turning(i, a, b, first, h, length, wa, wb, e, n, diagonal, coupling, ei, ea, eb):
    """Add the part of the repulsion spring's second derivative that comes from the turning of its edge."""
    s = -first / length
    r = -first * h / (length * length)
    # (w e)(z n)^T + (z n)(w e)^T with z = -1 on a, +1 on b; diagonal blocks are made symmetric by e n^T + n e^T
    for v, w, z in ((a, wa, -1.0), (b, wb, 1.0)):
        c = s * w * z
        diagonal[v, 0] += 2.0 * c * e[0] * n[0]
        diagonal[v, 1] += c * (e[0] * n[1] + n[0] * e[1])
        diagonal[v, 2] += c * (e[0] * n[2] + n[0] * e[2])
        diagonal[v, 3] += 2.0 * c * e[1] * n[1]
        diagonal[v, 4] += c * (e[1] * n[2] + n[1] * e[2])
        diagonal[v, 5] += 2.0 * c * e[2] * n[2]
        add_outer(diagonal, v, r, n[0], n[1], n[2])
    add_block(coupling, eb, i > a, -s, e[0], e[1], e[2], n[0], n[1], n[2])
    add_block(coupling, ea, i > b, s, e[0], e[1], e[2], n[0], n[1], n[2])
    add_block(coupling, ei, a > b, s * wa, e[0], e[1], e[2], n[0], n[1], n[2])
    add_block(coupling, ei, a > b, -s * wb, n[0], n[1], n[2], e[0], e[1], e[2])
    add_block(coupling, ei, a > b, -r, n[0], n[1], n[2], n[0], n[1], n[2])


@kernel
def spring_matrix(x, springs, law, edge_of, exact, diagonal, coupling):
    """Write the tangent stiffness of all springs into `diagonal` (n, 6) and `coupling` (e, 9) [mN/mm].

    exact : 1 = the second derivative, 0 = the positive semidefinite projection
    """
    diagonal[:] = 0.0
    coupling[:] = 0.0
    for q in range(springs.a.size):
        a = springs.a[q]
        b = springs.b[q]
        c = springs.c[q]
        e0 = edge_of[0, q]
        e1 = edge_of[1, q]
        e2 = edge_of[2, q]
        for k, i, j, l, ei, ej, el in ((0, a, b, c, e0, e1, e2), (1, b, c, a, e1, e2, e0), (2, c, a, b, e2, e0, e1)):
            add_edge(
                x, j, l, springs.edge_length[k, q], springs.edge_stiffness[k, q], law, exact, diagonal, coupling, ei
            )
            add_height(
                x, i, j, l, springs.height[k, q], springs.height_stiffness[k, q], springs.repulsion[k, q], law, exact,
                diagonal, coupling, ei, ej, el,
            )  # fmt: skip


@kernel
def spring_blocks(x, springs, law, bound, block):
    """Write the diagonal blocks of the projected tangent stiffness into `block` (n, 6) [mN/mm].

    bound : 0 = the blocks B themselves; 1 = larger ones, so that 2 B - H is positive semidefinite for the projected
    matrix H (a repulsion spring weighs |w| instead of w^2; see `elastic_force`)
    """
    block[:] = 0.0
    for q in range(springs.a.size):
        a = springs.a[q]
        b = springs.b[q]
        c = springs.c[q]
        for k, i, j, l in ((0, a, b, c), (1, b, c, a), (2, c, a, b)):
            ex = x[l, 0] - x[j, 0]
            ey = x[l, 1] - x[j, 1]
            ez = x[l, 2] - x[j, 2]
            length = math.sqrt(ex * ex + ey * ey + ez * ez)
            ex /= length
            ey /= length
            ez /= length
            s = length - springs.edge_length[k, q]
            secant, tangent = growth((s / law.s0) ** 2, law.alpha)
            across = max(0.0, springs.edge_stiffness[k, q] * secant * s / length)
            along = springs.edge_stiffness[k, q] * tangent - across
            for v in (j, l):
                add_outer(block, v, along, ex, ey, ez)
                add_identity(block, v, across)
            nx = x[i, 0] - x[j, 0]
            ny = x[i, 1] - x[j, 1]
            nz = x[i, 2] - x[j, 2]
            t = nx * ex + ny * ey + nz * ez
            nx -= t * ex
            ny -= t * ey
            nz -= t * ez
            t /= length
            h = math.sqrt(nx * nx + ny * ny + nz * nz)
            nx /= h
            ny /= h
            nz /= h
            first, second = height_terms(
                h, springs.height[k, q], springs.height_stiffness[k, q], springs.repulsion[k, q], law
            )
            out = max(0.0, first / h)
            mx = ey * nz - ez * ny
            my = ez * nx - ex * nz
            mz = ex * ny - ey * nx
            spread = 0.5 * (1.0 + abs(t) + abs(1.0 - t)) if bound else 1.0
            for v, w in ((i, 1.0), (j, 1.0 - t), (l, t)):
                if v == i or law.reaction:
                    w = abs(w) * spread if bound else w * w
                    add_outer(block, v, w * second, nx, ny, nz)
                    add_outer(block, v, w * out, mx, my, mz)


@kernel
def matrix_product(diagonal, coupling, pairs, m, n_pair, planes, tangent, v, out):
    """Write the matrix times `v` (n, 3) into `out`, for the first `m` vertices and the first `n_pair` edges.

    pairs : (e, 2) vertices of each edge; the first `n_pair` have both ends below `m`. `v` must vanish beyond `m`.
    """
    for i in range(m):
        x = v[i, 0]
        y = v[i, 1]
        z = v[i, 2]
        out[i, 0] = diagonal[i, 0] * x + diagonal[i, 1] * y + diagonal[i, 2] * z
        out[i, 1] = diagonal[i, 1] * x + diagonal[i, 3] * y + diagonal[i, 4] * z
        out[i, 2] = diagonal[i, 2] * x + diagonal[i, 4] * y + diagonal[i, 5] * z
    for e in range(n_pair):
        i = pairs[e, 0]
        j = pairs[e, 1]
        x = v[j, 0]
        y = v[j, 1]
        z = v[j, 2]
        out[i, 0] += coupling[e, 0] * x + coupling[e, 1] * y + coupling[e, 2] * z
        out[i, 1] += coupling[e, 3] * x + coupling[e, 4] * y + coupling[e, 5] * z
        out[i, 2] += coupling[e, 6] * x + coupling[e, 7] * y + coupling[e, 8] * z
        x = v[i, 0]
        y = v[i, 1]
        z = v[i, 2]
        out[j, 0] += coupling[e, 0] * x + coupling[e, 3] * y + coupling[e, 6] * z
        out[j, 1] += coupling[e, 1] * x + coupling[e, 4] * y + coupling[e, 7] * z
        out[j, 2] += coupling[e, 2] * x + coupling[e, 5] * y + coupling[e, 8] * z
    plane_product(v, planes, tangent, out)


@kernel
def inner(a, b, m):
    """Return the inner product of the first `m` rows."""
    total = 0.0
    for i in range(m):
        total += a[i, 0] * b[i, 0] + a[i, 1] * b[i, 1] + a[i, 2] * b[i, 2]
    return total


@kernel
def precondition(inverse, r, m, z):
    """Write the block-diagonal `inverse` (n, 6) times `r` into `z` (n, 3) and return r . z."""
    total = 0.0
    for i in range(m):
        x = r[i, 0]
        y = r[i, 1]
        w = r[i, 2]
        z[i, 0] = inverse[i, 0] * x + inverse[i, 1] * y + inverse[i, 2] * w
        z[i, 1] = inverse[i, 1] * x + inverse[i, 3] * y + inverse[i, 4] * w
        z[i, 2] = inverse[i, 2] * x + inverse[i, 4] * y + inverse[i, 5] * w
        total += x * z[i, 0] + y * z[i, 1] + w * z[i, 2]
    return total


@kernel(inline=True)
def to_border(xx, xp, pp, radius):
    """Return the positive s with |x + s p| = radius, from the inner products."""
    return (math.sqrt(max(0.0, xp * xp + pp * (radius * radius - xx))) - xp) / pp


@kernel
def conjugate_gradient(
    diagonal, coupling, pairs, m, n_pair, planes, tangent, inverse, b, tolerance, most, radius, work, solution
):
    """Solve the matrix times `solution` = `b` (n, 3) by preconditioned conjugate gradients, from zero (Steihaug).

    tolerance : relative, in the preconditioned norm   work : (4, n, 3)
    radius : the search stops at this norm of the solution (that of the inverse of `inverse`), where it also goes
    along a direction of negative curvature
    Returns (iterations, 1 if it stopped at the border or 2 at negative curvature, decrease of the quadratic model).
    """
    r = work[0]
    z = work[1]
    p = work[2]
    ap = work[3]
    for i in range(len(solution)):
        for d in range(3):
            solution[i, d] = 0.0
            p[i, d] = 0.0
            r[i, d] = b[i, d]
    rz = precondition(inverse, r, m, z)
    goal = tolerance * tolerance * rz
    for i in range(m):
        for d in range(3):
            p[i, d] = z[i, d]
    xx = 0.0  # squares and products in the preconditioner's norm
    xp = 0.0
    pp = rz
    decrease = 0.0
    for iteration in range(most):
        if rz <= goal:
            return iteration, 0, decrease
        matrix_product(diagonal, coupling, pairs, m, n_pair, planes, tangent, p, ap)
        curvature = inner(p, ap, m)
        step = rz / curvature if curvature > 0.0 else 0.0
        bent = curvature <= 0.0
        border = bent or xx + step * (2.0 * xp + step * pp) >= radius * radius
        if border:
            step = to_border(xx, xp, pp, radius)
            if bent:
                step = min(step, max(1.0, math.sqrt(xx / pp)))  # the model knows nothing of far along there
        decrease += step * rz - 0.5 * step * step * curvature
        for i in range(m):
            for d in range(3):
                solution[i, d] += step * p[i, d]
                r[i, d] -= step * ap[i, d]
        if border:
            return iteration + 1, 2 if bent else 1, decrease
        new = precondition(inverse, r, m, z)
        ratio = new / rz
        rz = new
        xx += step * (2.0 * xp + step * pp)
        xp = ratio * (xp + step * pp)
        pp = rz + ratio * ratio * pp
        for i in range(m):
            for d in range(3):
                p[i, d] = z[i, d] + ratio * p[i, d]
    return most, 0, decrease


@kernel
def step_limit(x, step, springs, share):
    """Return the largest fraction (at most 1) of `step` (n, 3) by which no corner uses up `share` of its height."""
    worst = 0.0
    for q in range(springs.a.size):
        a = springs.a[q]
        b = springs.b[q]
        c = springs.c[q]
        for i, j, l in ((a, b, c), (b, c, a), (c, a, b)):
            ex = x[l, 0] - x[j, 0]
            ey = x[l, 1] - x[j, 1]
            ez = x[l, 2] - x[j, 2]
            px = x[i, 0] - x[j, 0]
            py = x[i, 1] - x[j, 1]
            pz = x[i, 2] - x[j, 2]
            ee = ex * ex + ey * ey + ez * ez
            t = (px * ex + py * ey + pz * ez) / ee
            hh = px * px + py * py + pz * pz - t * t * ee
            dx = step[i, 0] - (1.0 - t) * step[j, 0] - t * step[l, 0]
            dy = step[i, 1] - (1.0 - t) * step[j, 1] - t * step[l, 1]
            dz = step[i, 2] - (1.0 - t) * step[j, 2] - t * step[l, 2]
            used = -(dx * (px - t * ex) + dy * (py - t * ey) + dz * (pz - t * ez)) / hh
            if used > worst:
                worst = used
    return 1.0 if worst <= share else share / worst


@kernel
def invert_positive(block, m):
    """Invert the first `m` symmetric matrices of `block` (n, 6) in place; one that is not positive definite counts as
    its size times the identity."""
    for i in range(m):
        xx = block[i, 0]
        xy = block[i, 1]
        xz = block[i, 2]
        yy = block[i, 3]
        yz = block[i, 4]
        zz = block[i, 5]
        c0 = yy * zz - yz * yz
        c1 = xz * yz - xy * zz
        c2 = xy * yz - xz * yy
        c3 = xx * zz - xz * xz
        c4 = xy * xz - xx * yz
        c5 = xx * yy - xy * xy
        det = xx * c0 + xy * c1 + xz * c2
        size = abs(xx) + abs(yy) + abs(zz)
        if xx > 0.0 and c5 > 1e-14 * size * size and det > 1e-12 * size * size * size:
            det = 1.0 / det
        else:
            c0 = 1.0
            c1 = 0.0
            c2 = 0.0
            c3 = 1.0
            c4 = 0.0
            c5 = 1.0
            det = 1.0 / size
        block[i, 0] = c0 * det
        block[i, 1] = c1 * det
        block[i, 2] = c2 * det
        block[i, 3] = c3 * det
        block[i, 4] = c4 * det
        block[i, 5] = c5 * det
