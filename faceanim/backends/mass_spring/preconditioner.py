"""An incomplete Cholesky factor of a patch's stiffness at rest, averaged over the directions of space.

The shear layer and the tethers act alike in all directions, and the membrane nearly so, so that one scalar matrix
stands for the three components. Its Cholesky factor is computed in full and then thinned: entries below `DROPPED` of
their diagonals go. What is left has about five entries a row, is positive definite by construction, and conditions the
matrix nearly as well as the whole factor.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from faceanim.backends.mass_spring.load import Load
from faceanim.geometry.topology import mirror_images
from faceanim.ground.arrays import Floats, Ints
from faceanim.kernels import attachment, tangent
from faceanim.kernels.tables import Factor

DROPPED = 0.03
"""Entries of the factor below this share of their diagonals (geometric mean) are left out."""
SOFTEST = 1e-6
"""Added to the diagonal, as a share of its mean: a vertex that nothing holds has no stiffness."""
NEAR = 1.0
"""Contacts that may touch are those nearer at rest than this [mm]."""
RIGID_SHARE = 0.2
"""Share of the stiffness of contacts with bones and eyeballs that is counted on: most do not touch most of the time."""
PAIR_SHARE = 0.06
"""The same for lips and lids, which travel far together before they part."""


def scalar_stiffness(load: Load) -> sparse.csr_matrix:
    """Return the stiffness of the free vertices at rest, a third of the trace of each 3 x 3 block, (m, m) [mN/mm].

    For a half, that of the whole body as a function of the half's positions: what comes twice counts twice.
    """
    patch, m = load.patch, load.patch.m
    load.rest()
    diagonal, coupling = np.zeros((len(patch.nodes), 6)), np.zeros((len(patch.pairs), 9))
    tangent.spring_matrix(load.x, patch.scene.springs, patch.scene.law, patch.edge_of, 0, diagonal, coupling)
    anchor = load.moment.anchor
    attachment.shear_coupling(load.x, anchor, patch.pairs, patch.shear[:, 0], patch.shear[:, 1], coupling)
    attachment.tether_blocks(load.x, anchor, patch.scene.tethers, m, diagonal)
    own = diagonal[:m, [0, 3, 5]].sum(axis=1) / 3.0
    between = coupling[:, [0, 4, 8]].sum(axis=1) / 3.0
    copies = patch.half.copies[:, 0]
    stands_for = np.full(len(patch.nodes), -1)
    stands_for[:m] = k = np.arange(m)
    stands_for[patch.half.ghost] = patch.half.source
    i, j = np.concatenate([patch.pairs, patch.pairs[:, ::-1]]).T
    # From the middle to a ghost is the mirror image of what counts twice already.
    middle = np.concatenate([copies == 1.0, np.zeros(len(patch.nodes) - m, dtype=bool)]) & (len(patch.half.ghost) > 0)
    keep = (i < m) & (stands_for[j] >= 0) & ~(middle[i] & (j >= m))
    rows, columns = np.concatenate([k, i[keep]]), np.concatenate([k, stands_for[j[keep]]])
    values = np.concatenate([own, np.tile(between, 2)[keep]]) * np.maximum(copies[rows], copies[columns])
    return sparse.csr_matrix((values, (rows, columns)), shape=(m, m))


def contact_stiffness(load: Load) -> Floats:
    """Return a share of the stiffness of the contacts that may touch, (m,) [mN/mm].

    Left out, soft tissue pressed together over a wide patch would be many times stiffer than its preconditioner.
    """
    load.rest()
    load.touch(load.x, NEAR)
    planes, total = load.moment.planes, np.zeros(len(load.patch.nodes))
    for c in range(int(planes.count[0])):
        k = planes.stiffness[c] * (PAIR_SHARE if planes.node[c, 1] >= 0 else RIGID_SHARE)
        total[planes.node[c, 0]] += k
        if planes.node[c, 1] >= 0:
            np.add.at(total, planes.node[c, 1:], k * planes.weight[c])
    return total[: load.patch.m]


def elimination_order(stiffness: sparse.csr_matrix, points: Floats) -> Ints:
    """Return the order of elimination: little fill, and the same on both sides of a symmetric patch.

    points : (m, 3) rest positions [mm]. Where the patch is symmetric about x = 0, one side's order is used for both and
    what lies between them comes last, so that thinning the factor leaves it symmetric.
    """
    mirror = mirror_images(points)
    if mirror is None:
        return _minimum_degree(stiffness)
    coo = stiffness.tocoo()
    across = points[coo.row, 0] * points[coo.col, 0] < 0.0
    between = points[:, 0] == 0.0
    between[coo.row[across]] = True
    left = np.flatnonzero((points[:, 0] > 0.0) & ~between)
    left = left[_minimum_degree(stiffness[left][:, left])]
    middle = np.flatnonzero(between)
    middle = middle[_minimum_degree(stiffness[middle][:, middle])]
    return np.concatenate([left, mirror[left], middle]).astype(np.int32)


def _minimum_degree(matrix: sparse.csr_matrix) -> Ints:
    if matrix.shape[0] < 2:
        return np.arange(matrix.shape[0], dtype=np.int32)
    ones = sparse.csc_matrix(matrix, copy=True)
    order: Ints = np.argsort(_decompose(ones, "MMD_AT_PLUS_A").perm_c).astype(np.int32)
    return order


def _decompose(matrix: sparse.csc_matrix, order: str) -> Any:
    """Return the LU decomposition of a symmetric positive definite matrix, pivots on the diagonal."""
    return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def incomplete_factor(stiffness: sparse.csr_matrix, order: Ints, weight: Floats, copies: Floats) -> Factor:
    """Return the thinned Cholesky factor of `stiffness` (m, m) plus the diagonal `weight` (m,), eliminated in `order`.

    copies : (m,) how often each vertex occurs; its weight and right-hand side count so often
    """
    m = len(order)
    if m == 0:
        empty, none = np.zeros(0), np.zeros(0, dtype=np.int32)
        return Factor(none, empty, empty, np.zeros(1, np.int32), none, empty, np.zeros(1, np.int32), none, empty)
    soft = SOFTEST * stiffness.diagonal().mean()
    whole = (stiffness + sparse.diags(copies * weight + soft))[order][:, order].tocsc()
    parts = _decompose(whole, "NATURAL")
    lower = (parts.L @ sparse.diags(np.sqrt(parts.U.diagonal()))).tocoo()
    diagonal = lower.tocsr().diagonal()
    keep = (lower.row > lower.col) & (
        np.abs(lower.data) >= DROPPED * np.sqrt(diagonal[lower.row] * diagonal[lower.col])
    )
    thin = sparse.csr_matrix((lower.data[keep], (lower.row[keep], lower.col[keep])), shape=(m, m))
    back = thin.T.tocsr()
    thin.sort_indices()
    back.sort_indices()
    return Factor(
        np.ascontiguousarray(order, dtype=np.int32), 1.0 / diagonal, np.ascontiguousarray(copies[order]),
        thin.indptr.astype(np.int32), thin.indices.astype(np.int32), thin.data,
        back.indptr.astype(np.int32), back.indices.astype(np.int32), back.data,
    )  # fmt: skip
