"""The fixed pattern in which element vectors and matrices are summed, node by node and pair by pair."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from faceanim.geometry.topology import grouped
from faceanim.ground.arrays import Floats, Ints, frozen
from faceanim.kernels import solids


class Pattern:
    """Where the entries of elements with nodes `node` (e, a) among `n` nodes go, each node with three freedoms.

    node_pattern : (n, n) which nodes are coupled   indptr, indices : of the sparse matrix (3n, 3n)
    """

    def __init__(self, node: Ints, n: int) -> None:
        e, a = node.shape
        key = (node[:, :, None].astype(np.int64) * n + node[:, None, :]).ravel()
        pairs = np.unique(key)
        slots = grouped(np.searchsorted(pairs, key).astype(np.int32), np.arange(len(key), dtype=np.int32), len(pairs))
        own = grouped(node.ravel(), np.arange(e * a, dtype=np.int32), n)
        column = (pairs % n).astype(np.int32)
        first = np.zeros(n + 1, dtype=np.int32)
        np.cumsum(np.bincount(pairs // n, minlength=n), out=first[1:])
        self._gather = solids.Gather(*map(frozen, (own.start, own.item, first, slots.start, slots.item)))
        self.size = 3 * n
        self.node_pattern = sparse.csr_matrix((np.ones(len(column)), column, first), shape=(n, n))
        blocks = sparse.bsr_matrix((np.ones((len(column), 3, 3)), column, first), shape=(self.size, self.size)).tocsr()
        self.indptr: Ints = blocks.indptr.astype(np.int32)
        self.indices: Ints = blocks.indices.astype(np.int32)

    def vectors(self, element: Floats) -> Floats:
        """Return the sum, (n, 3), of the elements' vectors (e, a, 3)."""
        out = np.empty((self.size // 3, 3))
        solids.gather_nodes(self._gather, element, out)
        return out

    def values(self, element: Floats, out: Floats) -> Floats:
        """Write the sum of the elements' matrices (e, 3a, 3a) into the values `out` of the sparse matrix; return it."""
        solids.gather_pairs(self._gather, element, out)
        return out

    def matrix(self, values: Floats) -> sparse.csr_matrix:
        """Return the sparse matrix (3n, 3n) with these `values`."""
        return sparse.csr_matrix((values, self.indices, self.indptr), shape=(self.size, self.size))
