"""Solving with a sparse Cholesky factor: L L^T z = r for three right-hand sides at once."""

from __future__ import annotations

import numpy as np

from faceanim.ground.jit import kernel
from faceanim.kernels.memory import load


@kernel
def solve_factored(factor, r, work, z):
    """Write the solution of L L^T z = r into `z` (n, 3); `r` (n, 3), `work` (n, 4); see `tables.Factor`.

    Both sweeps gather: forwards along the rows of L, backwards along those of L^T.
    """
    n = len(factor.order)
    for i in range(n):
        at = factor.order[i]
        s = factor.copies[i]
        a = s * r[at, 0]
        b = s * r[at, 1]
        c = s * r[at, 2]
        for e in range(factor.lower_start[i], factor.lower_start[i + 1]):
            j = 4 * np.intp(load(factor.lower_column, e))
            w = load(factor.lower, e)
            a -= w * load(work, j)
            b -= w * load(work, j + 1)
            c -= w * load(work, j + 2)
        s = factor.inverse_diagonal[i]
        work[i, 0] = s * a
        work[i, 1] = s * b
        work[i, 2] = s * c
    for i in range(n - 1, -1, -1):
        a = work[i, 0]
        b = work[i, 1]
        c = work[i, 2]
        for e in range(factor.upper_start[i], factor.upper_start[i + 1]):
            j = 4 * np.intp(load(factor.upper_column, e))
            w = load(factor.upper, e)
            a -= w * load(work, j)
            b -= w * load(work, j + 1)
            c -= w * load(work, j + 2)
        s = factor.inverse_diagonal[i]
        work[i, 0] = s * a
        work[i, 1] = s * b
        work[i, 2] = s * c
        at = factor.order[i]
        z[at, 0] = s * a
        z[at, 1] = s * b
        z[at, 2] = s * c
