"""Elastic laws at one point: energy density psi(F), first Piola-Kirchhoff stress P = dpsi/dF, and tangent A = dP/dF.

F (3, 3) is the deformation gradient, F[i, j] = dx_i / dX_j; A (9, 9) has the row 3 i + j for P[i, j] and the column
3 k + l for F[k, l]. `c` (5,) holds lambda, mu, c10, c01 and kappa [kPa]. G = F^-T, J = det F, I1 = F : F, C = F^T F.

LINEAR         mu e : e + lambda/2 (tr e)^2, e = (F + F^T)/2 - I
NEO_HOOKEAN    mu/2 (I1 - 3 - 2 ln J) + lambda/2 (ln J)^2; infinite for J <= 0
COROTATIONAL   mu |F - R|^2 + lambda/2 (tr(R^T F) - 3)^2, R the rotation nearest to F (det R = +1, also for J < 0)
STVK           mu E : E + lambda/2 (tr E)^2, E = (C - I)/2; softens when compressed and lets elements invert
MOONEY_RIVLIN  c10 (J^(-2/3) I1 - 3) + c01 (J^(-4/3) I2 - 3) + kappa/2 (J - 1)^2; infinite for J <= 0
TENSION        f(J^(-2/3) I1 - 3) + kappa/2 (J - 1)^2, f of `kernels.tension`, c01 <= 0; infinite for J <= 0
STVK_BARRIER   mu E : E + lambda/2 (ln J)^2: STVK whose volume term is a barrier; infinite for J <= 0

Bonet & Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2008, chapters 6 and 8; for the derivative of R
see McAdams et al., Efficient elasticity for character skinning with contact and collisions, 2011.
"""

from __future__ import annotations

import math

from faceanim.ground.jit import kernel
from faceanim.kernels.tension import tension_curvature, tension_energy, tension_slope

LINEAR = 0
NEO_HOOKEAN = 1
COROTATIONAL = 2
STVK = 3
MOONEY_RIVLIN = 4
TENSION = 5
STVK_BARRIER = 6

SWEEPS = 40
"""Most sweeps of a Jacobi iteration; five to ten are usual."""
FLATTEST = 1e-8
"""Least sum of two singular values by which the rotation's derivative is divided."""


@kernel(inline=True)
def determinant(F):
    """Return det F."""
    return (
        F[0, 0] * (F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1])
        - F[0, 1] * (F[1, 0] * F[2, 2] - F[1, 2] * F[2, 0])
        + F[0, 2] * (F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0])
    )


@kernel(inline=True)
def volume_change(F):
    """Return det F - 1 without the loss of digits near F = I."""
    a = F[0, 0] - 1.0
    b = F[1, 1] - 1.0
    c = F[2, 2] - 1.0
    minors = a * b + b * c + c * a - F[0, 1] * F[1, 0] - F[1, 2] * F[2, 1] - F[0, 2] * F[2, 0]
    rest = (
        a * (b * c - F[1, 2] * F[2, 1])
        - F[0, 1] * (F[1, 0] * c - F[1, 2] * F[2, 0])
        + F[0, 2] * (F[1, 0] * F[2, 1] - b * F[2, 0])
    )
    return a + b + c + minors + rest


@kernel
def inverse_transpose(F, G):
    """Write F^-T into `G` and return det F; F must not be singular."""
    J = determinant(F)
    s = 1.0 / J
    for i in range(3):
        k = (i + 1) % 3
        m = (i + 2) % 3
        for j in range(3):
            p = (j + 1) % 3
            q = (j + 2) % 3
            G[i, j] = s * (F[k, p] * F[m, q] - F[k, q] * F[m, p])
    return J


@kernel(inline=True)
def squared(F):
    """Return I1 = F : F."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += F[i, j] * F[i, j]
    return total


@kernel(inline=True)
def stretch_change(F):
    """Return I1 - 3 without the loss of digits near F = I."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            h = F[i, j] - (1.0 if i == j else 0.0)
            total += h * h + (2.0 * h if i == j else 0.0)
    return total


@kernel
def _orthogonalise(B, V):
    """Rotate the columns of `B` (3, 3) until they are orthogonal (one-sided Jacobi); `V` gathers the rotations."""
    for _ in range(SWEEPS):
        turned = False
        for k in range(3):
            p = 0 if k < 2 else 1
            q = 1 if k == 0 else 2
            a = B[0, p] * B[0, p] + B[1, p] * B[1, p] + B[2, p] * B[2, p]
            b = B[0, q] * B[0, q] + B[1, q] * B[1, q] + B[2, q] * B[2, q]
            g = B[0, p] * B[0, q] + B[1, p] * B[1, q] + B[2, p] * B[2, q]
            if abs(g) <= 1e-15 * math.sqrt(a * b) or abs(g) < 1e-280:
                continue
            turned = True
            z = (b - a) / (2.0 * g)
            t = (1.0 if z >= 0.0 else -1.0) / (abs(z) + math.sqrt(1.0 + z * z))
            c = 1.0 / math.sqrt(1.0 + t * t)
            s = c * t
            for i in range(3):
                u = B[i, p]
                B[i, p] = c * u - s * B[i, q]
                B[i, q] = s * u + c * B[i, q]
                u = V[i, p]
                V[i, p] = c * u - s * V[i, q]
                V[i, q] = s * u + c * V[i, q]
        if not turned:
            break


@kernel
def singular_values(F, U, V):
    """Write rotations U and V with F = U diag(s) V^T and return s; only the smallest may be negative, with J.

    Columns of U belonging to singular values of zero complete it to a rotation.
    """
    for i in range(3):
        for j in range(3):
            U[i, j] = F[i, j]
            V[i, j] = 1.0 if i == j else 0.0
    _orthogonalise(U, V)
    n0 = math.sqrt(U[0, 0] ** 2 + U[1, 0] ** 2 + U[2, 0] ** 2)
    n1 = math.sqrt(U[0, 1] ** 2 + U[1, 1] ** 2 + U[2, 1] ** 2)
    n2 = math.sqrt(U[0, 2] ** 2 + U[1, 2] ** 2 + U[2, 2] ** 2)
    # the smallest is column r; p, q, r stay in cyclic order so that u_p x u_q = u_r
    r = 2
    if n0 <= n1 and n0 <= n2:
        r = 0
    elif n1 <= n0 and n1 <= n2:
        r = 1
    p = (r + 1) % 3
    q = (r + 2) % 3
    np_ = n0 if p == 0 else (n1 if p == 1 else n2)
    nq = n0 if q == 0 else (n1 if q == 1 else n2)
    b0 = U[0, r]
    b1 = U[1, r]
    b2 = U[2, r]
    _complete(U, p, q, r, np_, nq)
    sr = U[0, r] * b0 + U[1, r] * b1 + U[2, r] * b2
    s0 = sr if r == 0 else (np_ if p == 0 else nq)
    s1 = sr if r == 1 else (np_ if p == 1 else nq)
    s2 = sr if r == 2 else (np_ if p == 2 else nq)
    return s0, s1, s2


@kernel
def _complete(U, p, q, r, np_, nq):
    """Make columns p and q of lengths `np_` and `nq` unit vectors, choosing what is lost, and set u_r = u_p x u_q."""
    if nq > np_:
        big, small, nb, ns = q, p, nq, np_
    else:
        big, small, nb, ns = p, q, np_, nq
    for i in range(3):
        U[i, big] = U[i, big] / nb if nb > 1e-150 else (1.0 if i == big else 0.0)
    if ns <= 1e-14 * nb or nb <= 1e-150:
        axis = 0
        for i in range(1, 3):
            if abs(U[i, big]) < abs(U[axis, big]):
                axis = i
        for i in range(3):
            U[i, small] = 1.0 if i == axis else 0.0
    dot = U[0, small] * U[0, big] + U[1, small] * U[1, big] + U[2, small] * U[2, big]
    length = 0.0
    for i in range(3):
        U[i, small] -= dot * U[i, big]
        length += U[i, small] ** 2
    length = math.sqrt(length)
    for i in range(3):
        U[i, small] /= length
    for i in range(3):
        k = (i + 1) % 3
        m = (i + 2) % 3
        U[i, r] = U[k, p] * U[m, q] - U[m, p] * U[k, q]


@kernel
def _rotation(F, work):
    """Write R into `work[0]`, U and V into `work[1]` and `work[2]`; return the singular values."""
    U = work[1]
    V = work[2]
    s0, s1, s2 = singular_values(F, U, V)
    for i in range(3):
        for j in range(3):
            work[0, i, j] = U[i, 0] * V[j, 0] + U[i, 1] * V[j, 1] + U[i, 2] * V[j, 2]
    return s0, s1, s2


@kernel
def energy_density(law, F, c, work):
    """Return psi(F) [kPa]; `work` (3, 3, 3) is overwritten."""
    lame = c[0]
    mu = c[1]
    if law == LINEAR:
        trace = F[0, 0] + F[1, 1] + F[2, 2] - 3.0
        total = 0.0
        for i in range(3):
            for j in range(3):
                e = 0.5 * (F[i, j] + F[j, i]) - (1.0 if i == j else 0.0)
                total += e * e
        return mu * total + 0.5 * lame * trace * trace
    if law == COROTATIONAL:
        s0, s1, s2 = _rotation(F, work)
        d0 = s0 - 1.0
        d1 = s1 - 1.0
        d2 = s2 - 1.0
        return mu * (d0 * d0 + d1 * d1 + d2 * d2) + 0.5 * lame * (d0 + d1 + d2) ** 2
    if law == STVK:
        total = 0.0
        trace = 0.0
        for i in range(3):
            for j in range(3):
                e = 0.5 * (F[0, i] * F[0, j] + F[1, i] * F[1, j] + F[2, i] * F[2, j] - (1.0 if i == j else 0.0))
                total += e * e
                if i == j:
                    trace += e
        return mu * total + 0.5 * lame * trace * trace
    change = volume_change(F)
    if not change > -1.0:
        return math.inf
    if law == NEO_HOOKEAN:
        logarithm = math.log1p(change)
        return 0.5 * mu * (stretch_change(F) - 2.0 * logarithm) + 0.5 * lame * logarithm * logarithm
    if law == STVK_BARRIER:
        logarithm = math.log1p(change)
        return mu * green_squared(F) + 0.5 * lame * logarithm * logarithm
    if law == TENSION:
        return tension_energy(isochoric_change(F, change), c[2], c[3]) + 0.5 * c[4] * change * change
    I1 = squared(F)
    cube = (1.0 + change) ** (-2.0 / 3.0)
    return (
        c[2] * (cube * I1 - 3.0) + c[3] * (cube * cube * second_invariant(F, I1) - 3.0) + 0.5 * c[4] * change * change
    )


@kernel(inline=True)
def isochoric_change(F, change):
    """Return J^(-2/3) I1 - 3 for J = 1 + `change` without the loss of digits near F = I."""
    shrunk = math.expm1(-2.0 / 3.0 * math.log1p(change))
    more = stretch_change(F)
    return more + shrunk * (3.0 + more)


@kernel(inline=True)
def green_squared(F):
    """Return E : E of Green's strain E = (C - I) / 2."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            e = 0.5 * (F[0, i] * F[0, j] + F[1, i] * F[1, j] + F[2, i] * F[2, j] - (1.0 if i == j else 0.0))
            total += e * e
    return total


@kernel
def second_invariant(F, I1):
    """Return I2 = (I1^2 - C : C) / 2."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            C = F[0, i] * F[0, j] + F[1, i] * F[1, j] + F[2, i] * F[2, j]
            total += C * C
    return 0.5 * (I1 * I1 - total)


@kernel
def stress(law, F, c, work, P):
    """Write P = dpsi/dF [kPa] into `P` (3, 3); laws with a barrier need J > 0. `work` (3, 3, 3) is overwritten."""
    lame = c[0]
    mu = c[1]
    if law == LINEAR:
        trace = F[0, 0] + F[1, 1] + F[2, 2] - 3.0
        for i in range(3):
            for j in range(3):
                P[i, j] = mu * (F[i, j] + F[j, i])
            P[i, i] += lame * trace - 2.0 * mu
    elif law == NEO_HOOKEAN:
        G = work[0]
        inverse_transpose(F, G)
        s = lame * math.log1p(volume_change(F)) - mu
        for i in range(3):
            for j in range(3):
                P[i, j] = mu * F[i, j] + s * G[i, j]
    elif law == COROTATIONAL:
        s0, s1, s2 = _rotation(F, work)
        s = lame * (s0 + s1 + s2 - 3.0) - 2.0 * mu
        for i in range(3):
            for j in range(3):
                P[i, j] = 2.0 * mu * F[i, j] + s * work[0, i, j]
    elif law == STVK:
        S = work[0]
        _second_stress(F, lame, mu, S)
        for i in range(3):
            for j in range(3):
                P[i, j] = F[i, 0] * S[0, j] + F[i, 1] * S[1, j] + F[i, 2] * S[2, j]
    elif law == STVK_BARRIER:
        S = work[0]
        G = work[1]
        _second_stress(F, 0.0, mu, S)
        inverse_transpose(F, G)
        s = lame * math.log1p(volume_change(F))
        for i in range(3):
            for j in range(3):
                P[i, j] = F[i, 0] * S[0, j] + F[i, 1] * S[1, j] + F[i, 2] * S[2, j] + s * G[i, j]
    elif law == TENSION:
        _tension_stress(F, c, work, P)
    else:
        _mooney_stress(F, c, work, P)


@kernel
def _second_stress(F, lame, mu, S):
    """Write S = 2 mu E + lambda tr(E) I."""
    trace = 0.5 * stretch_change(F)
    for i in range(3):
        for j in range(3):
            C = F[0, i] * F[0, j] + F[1, i] * F[1, j] + F[2, i] * F[2, j]
            S[i, j] = mu * (C - (1.0 if i == j else 0.0))
        S[i, i] += lame * trace


@kernel
def _invariant_gradient(F, I1, C, H):
    """Write C = F^T F and H = dI2/dF = 2 (I1 F - F C)."""
    for i in range(3):
        for j in range(3):
            C[i, j] = F[0, i] * F[0, j] + F[1, i] * F[1, j] + F[2, i] * F[2, j]
    for i in range(3):
        for j in range(3):
            H[i, j] = 2.0 * (I1 * F[i, j] - F[i, 0] * C[0, j] - F[i, 1] * C[1, j] - F[i, 2] * C[2, j])


@kernel
def _mooney_stress(F, c, work, P):
    G = work[0]
    H = work[2]
    J = inverse_transpose(F, G)
    I1 = squared(F)
    I2 = second_invariant(F, I1)
    _invariant_gradient(F, I1, work[1], H)
    a = c[2] * J ** (-2.0 / 3.0)
    b = c[3] * J ** (-4.0 / 3.0)
    s = c[4] * volume_change(F) * J - 2.0 / 3.0 * a * I1 - 4.0 / 3.0 * b * I2
    for i in range(3):
        for j in range(3):
            P[i, j] = 2.0 * a * F[i, j] + b * H[i, j] + s * G[i, j]


@kernel
def tangent(law, F, c, work, A):
    """Write A = dP/dF [kPa] into `A` (9, 9), symmetric; laws with a barrier need J > 0. `work` is overwritten."""
    lame = c[0]
    mu = c[1]
    if law == LINEAR:
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    for l in range(3):
                        A[3 * i + j, 3 * k + l] = (
                            (mu if i == k and j == l else 0.0)
                            + (mu if i == l and j == k else 0.0)
                            + (lame if i == j and k == l else 0.0)
                        )
    elif law == NEO_HOOKEAN:
        G = work[0]
        inverse_transpose(F, G)
        s = mu - lame * math.log1p(volume_change(F))
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    for l in range(3):
                        A[3 * i + j, 3 * k + l] = (
                            s * G[i, l] * G[k, j] + lame * G[i, j] * G[k, l] + (mu if i == k and j == l else 0.0)
                        )
    elif law == COROTATIONAL:
        _corotational_tangent(F, lame, mu, work, A)
    elif law == STVK:
        _stvk_tangent(F, lame, mu, work, A)
    elif law == STVK_BARRIER:
        _stvk_tangent(F, 0.0, mu, work, A)
        G = work[0]
        inverse_transpose(F, G)
        s = lame * math.log1p(volume_change(F))
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    for l in range(3):
                        A[3 * i + j, 3 * k + l] += lame * G[i, j] * G[k, l] - s * G[i, l] * G[k, j]
    elif law == TENSION:
        _tension_tangent(F, c, work, A)
    else:
        _mooney_tangent(F, c[2], c[3], c[4], work, A)


@kernel
def _corotational_tangent(F, lame, mu, work, A):
    """Write A = 2 mu I + lambda R R + (lambda tr(S - I) - 2 mu) dR/dF."""
    s0, s1, s2 = _rotation(F, work)
    R = work[0]
    U = work[1]
    V = work[2]
    factor = lame * (s0 + s1 + s2 - 3.0) - 2.0 * mu
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for l in range(3):
                    A[3 * i + j, 3 * k + l] = lame * R[i, j] * R[k, l]
            A[3 * i + j, 3 * i + j] += 2.0 * mu
    for pair in range(3):
        p = 0 if pair < 2 else 1
        q = 1 if pair == 0 else 2
        total = (s0 + s1) if pair == 0 else ((s0 + s2) if pair == 1 else (s1 + s2))
        f = factor / max(total, FLATTEST)
        for i in range(3):
            for j in range(3):
                t = f * (U[i, p] * V[j, q] - U[i, q] * V[j, p])
                for k in range(3):
                    for l in range(3):
                        A[3 * i + j, 3 * k + l] += t * (U[k, p] * V[l, q] - U[k, q] * V[l, p])


@kernel
def _stvk_tangent(F, lame, mu, work, A):
    """Write A = I S + mu (F F^T terms) + lambda F F."""
    S = work[0]
    _second_stress(F, lame, mu, S)
    for i in range(3):
        for k in range(3):
            B = mu * (F[i, 0] * F[k, 0] + F[i, 1] * F[k, 1] + F[i, 2] * F[k, 2])
            for j in range(3):
                for l in range(3):
                    A[3 * i + j, 3 * k + l] = (
                        mu * F[i, l] * F[k, j]
                        + lame * F[i, j] * F[k, l]
                        + (S[l, j] if i == k else 0.0)
                        + (B if j == l else 0.0)
                    )


@kernel
def _tension_stress(F, c, work, P):
    """Write P = f' dI/dF + kappa (J - 1) J G with I = J^(-2/3) I1."""
    G = work[0]
    J = inverse_transpose(F, G)
    change = volume_change(F)
    a = tension_slope(isochoric_change(F, change), c[2], c[3]) * J ** (-2.0 / 3.0)
    s = c[4] * change * J - 2.0 / 3.0 * a * squared(F)
    for i in range(3):
        for j in range(3):
            P[i, j] = 2.0 * a * F[i, j] + s * G[i, j]


@kernel
def _tension_tangent(F, c, work, A):
    """Write A: that of the Mooney-Rivlin law with the constants f' and 0, plus f'' dI/dF (x) dI/dF."""
    change = volume_change(F)
    over = isochoric_change(F, change)
    _mooney_tangent(F, tension_slope(over, c[2], c[3]), 0.0, c[4], work, A)
    D = work[1]
    b = 2.0 * (1.0 + change) ** (-2.0 / 3.0)
    third = squared(F) / 3.0
    for i in range(3):
        for j in range(3):
            D[i, j] = b * (F[i, j] - third * work[0, i, j])
    bend = tension_curvature(over, c[2], c[3])
    for i in range(3):
        for j in range(3):
            t = bend * D[i, j]
            for k in range(3):
                for l in range(3):
                    A[3 * i + j, 3 * k + l] += t * D[k, l]


@kernel
def _mooney_tangent(F, c10, c01, kappa, work, A):
    """Write A and leave G in `work[0]`."""
    G = work[0]
    C = work[1]
    H = work[2]
    J = inverse_transpose(F, G)
    I1 = squared(F)
    I2 = second_invariant(F, I1)
    _invariant_gradient(F, I1, C, H)
    a = c10 * J ** (-2.0 / 3.0)
    b = c01 * J ** (-4.0 / 3.0)
    change = volume_change(F)
    turned = 2.0 / 3.0 * a * I1 + 4.0 / 3.0 * b * I2 - kappa * change * J
    outer = 4.0 / 9.0 * a * I1 + 16.0 / 9.0 * b * I2 + kappa * (2.0 * change + 1.0) * J
    for i in range(3):
        for k in range(3):
            B = F[i, 0] * F[k, 0] + F[i, 1] * F[k, 1] + F[i, 2] * F[k, 2]
            for j in range(3):
                for l in range(3):
                    value = outer * G[i, j] * G[k, l] + turned * G[i, l] * G[k, j]
                    value -= 4.0 / 3.0 * a * (F[i, j] * G[k, l] + G[i, j] * F[k, l])
                    value -= 4.0 / 3.0 * b * (H[i, j] * G[k, l] + G[i, j] * H[k, l])
                    value += 2.0 * b * (2.0 * F[i, j] * F[k, l] - F[i, l] * F[k, j])
                    if i == k:
                        value -= 2.0 * b * C[l, j]
                    if j == l:
                        value -= 2.0 * b * B
                        if i == k:
                            value += 2.0 * a + 2.0 * b * I1
                    A[3 * i + j, 3 * k + l] = value


@kernel
def make_definite(A, V, D, least):
    """Raise the eigenvalues of the symmetric `A` (9, 9) to at least `least`, in place; `V`, `D` (9, 9) are overwritten.

    Cyclic Jacobi rotations (Golub & Van Loan, Matrix Computations, 8.5).
    """
    n = len(A)
    norm = 0.0
    for i in range(n):
        for j in range(n):
            D[i, j] = 0.5 * (A[i, j] + A[j, i])
            V[i, j] = 1.0 if i == j else 0.0
            norm += D[i, j] * D[i, j]
    for _ in range(SWEEPS):
        off = 0.0
        for p in range(n - 1):
            for q in range(p + 1, n):
                off += D[p, q] * D[p, q]
        if off <= 1e-26 * norm:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if abs(D[p, q]) > 1e-300:
                    _rotate(D, V, p, q)
    lowest = D[0, 0]
    for p in range(1, n):
        lowest = min(lowest, D[p, p])
    if lowest >= least:
        return
    for i in range(n):
        for j in range(n):
            total = 0.0
            for p in range(n):
                total += V[i, p] * max(D[p, p], least) * V[j, p]
            A[i, j] = total


@kernel
def _rotate(D, V, p, q):
    """Zero D[p, q] by a rotation of rows and columns p and q."""
    n = len(D)
    z = (D[q, q] - D[p, p]) / (2.0 * D[p, q])
    t = (1.0 if z >= 0.0 else -1.0) / (abs(z) + math.sqrt(1.0 + z * z))
    c = 1.0 / math.sqrt(1.0 + t * t)
    s = c * t
    for k in range(n):
        u = D[k, p]
        D[k, p] = c * u - s * D[k, q]
        D[k, q] = s * u + c * D[k, q]
    for k in range(n):
        u = D[p, k]
        D[p, k] = c * u - s * D[q, k]
        D[q, k] = s * u + c * D[q, k]
        u = V[k, p]
        V[k, p] = c * u - s * V[k, q]
        V[k, q] = s * u + c * V[k, q]
