"""Symmetric positive definite sparse systems: banded Cholesky where the band is narrow, else a general factor."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy import sparse
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import splu

from faceanim.ground.arrays import Floats, Ints

MOST_BAND = 40_000_000
"""Largest number of entries in a band (320 MB)."""


def solve(matrix: sparse.csc_matrix, right: Floats) -> Floats:
    """Return the solution (n, ...) of matrix x = right for a symmetric positive definite `matrix` (n, n)."""
    return factored(matrix)(right)


def factored(matrix: sparse.csc_matrix) -> Callable[[Floats], Floats]:
    """Return what solves matrix x = right for any `right` (n, ...), for a symmetric positive definite `matrix` (n, n)."""
    order = reverse_cuthill_mckee(matrix.tocsr(), symmetric_mode=True)
    turned = matrix.tocsr()[order][:, order].tocoo()
    away = turned.row - turned.col
    width = int(away.max(initial=0))
    if (width + 1) * matrix.shape[0] <= MOST_BAND:
        band = np.zeros((width + 1, matrix.shape[0]))
        lower = away >= 0
        band[away[lower], turned.col[lower]] = turned.data[lower]
        try:
            factor = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
        except LinAlgError:
            pass
        else:
            return partial(_banded, factor, order)
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve


def _banded(factor: Floats, order: Ints, right: Floats) -> Floats:
    """Return the solution (n, ...) by the banded Cholesky `factor` of the system turned by `order` (n,)."""
    out = np.empty_like(right)
    out[order] = cho_solve_banded((factor, True), right[order], check_finite=False)
    return out
