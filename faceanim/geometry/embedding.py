"""Points carried by the nodes of a volume: weights that sum to 1, both ways."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Floats, Ints, frozen
from faceanim.ground.errors import UserError


@dataclass(frozen=True, eq=False)
class Embedding:
    """Points as weighted means of nodes: point k is sum_a weight[k, a] * x[node[k, a]].

    node : (k, w)   weight : (k, w) [-], rows sum to 1 (a weight may be negative: the point then lies outside its cell)
    """

    node: Ints
    weight: Floats

    def __post_init__(self) -> None:
        if self.node.ndim != 2 or self.node.shape != self.weight.shape:
            raise UserError(f"embedding: node {self.node.shape} and weight {self.weight.shape} must be equal (k, w)")
        if self.node.size and np.abs(self.weight.sum(axis=1) - 1.0).max() > 1e-6:
            raise UserError("embedding: the weights of a point must sum to 1")
        frozen(self.node)
        frozen(self.weight)

    @classmethod
    def of_nodes(cls, node: Ints) -> Embedding:
        """Return points that are the nodes `node` (k,) themselves."""
        return cls(np.ascontiguousarray(node, dtype=np.int32)[:, None], np.ones((len(node), 1)))

    def apply(self, values: Floats) -> Floats:
        """Return the values at the points, (k, ...), of `values` (n, ...) at the nodes."""
        return np.einsum("ka,ka...->k...", self.weight, values[self.node])

    def matrix(self, n: int) -> sparse.csr_matrix:
        """Return the weights as a sparse (k, n) matrix B: points B x; nodal forces of the same work B^T f."""
        k, w = self.node.shape
        rows = np.repeat(np.arange(k), w)
        matrix = sparse.coo_matrix((self.weight.ravel(), (rows, self.node.ravel())), shape=(k, n)).tocsr()
        matrix.eliminate_zeros()
        return matrix


def barycentric(mesh: TetMesh, tets: Ints, points: Floats) -> Floats:
    """Return the barycentric coordinates of `points` (k, 3) in elements `tets` (k,), (k, 4)."""
    g = mesh.gradients[tets]
    first = mesh.points[mesh.tets[tets, 0]]
    out = np.einsum("kai,ki->ka", g, points - first)
    out[:, 0] += 1.0
    return out


def _search_wider(
    mesh: TetMesh, points: Floats, lost: np.ndarray, allowed: np.ndarray, tree: cKDTree, tet: Any
) -> None:
    """Look for elements that contain the points `lost` although many others have nearer centres; write them into `tet`."""
    reach = np.linalg.norm(mesh.points[mesh.tets[allowed]] - tree.data[:, None], axis=2).max(axis=1)
    for i, near in zip(lost, tree.query_ball_point(points[lost], float(reach.max())), strict=True):
        near = np.array(near, dtype=np.int64)
        near = near[np.linalg.norm(tree.data[near] - points[i], axis=1) <= reach[near]]
        if len(near):
            inside = barycentric(mesh, allowed[near], np.broadcast_to(points[i], (len(near), 3))).min(axis=1)
            if inside.max() >= -1e-12:
                tet[i] = allowed[near[np.argmax(inside)]]


def embed(mesh: TetMesh, points: Floats, *, among: Ints | None = None, candidates: int = 24) -> Embedding:
    """Return `points` (k, 3) as carried by the elements of `mesh`: by the one that contains a point, else the nearest.

    A point outside every element gets the extrapolating weights of the element in which it is least outside.
    among : elements that may carry (None = all)   candidates : how many near elements are tried for each point at first
    """
    allowed = np.arange(len(mesh.tets)) if among is None else np.asarray(among)
    if not len(allowed):
        raise UserError("embedding: there is no element to carry the points")
    centres = mesh.points[mesh.tets[allowed]].mean(axis=1)
    tree = cKDTree(centres)
    tries = min(candidates, len(allowed))
    _, near = tree.query(points, k=tries)
    near = allowed[near.reshape(len(points), tries)]
    best = np.full(len(points), -np.inf)
    tet = near[:, 0].copy()
    for column in near.T:
        inside = barycentric(mesh, column, points).min(axis=1)
        better = inside > best + 1e-12
        best[better], tet[better] = inside[better], column[better]
    lost = np.flatnonzero(best < 0.0)
    if len(lost) and tries < len(allowed):
        _search_wider(mesh, points, lost, allowed, tree, tet)
    weight = barycentric(mesh, tet, points)
    return Embedding(np.ascontiguousarray(mesh.tets[tet]), np.ascontiguousarray(weight))
