"""Distances and smooth fields along the skin."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import splu

from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Bools, Floats, Ints


def edge_graph(mesh: TriMesh) -> csr_matrix:
    """Return the (n, n) symmetric matrix of edge lengths [mm]."""
    i, j = mesh.triangles[:, [0, 1, 2]].ravel(), mesh.triangles[:, [1, 2, 0]].ravel()
    low, high = np.minimum(i, j), np.maximum(i, j)
    pairs = np.unique(np.stack([low, high], axis=1), axis=0)
    length = np.linalg.norm(mesh.points[pairs[:, 0]] - mesh.points[pairs[:, 1]], axis=1)
    n = len(mesh.points)
    half = coo_matrix((length, (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return (half + half.T).tocsr()


def distance_along(mesh: TriMesh, sources: Ints, limit: float = np.inf) -> Floats:
    """Return each vertex's shortest distance along edges to the nearest of `sources`, (n,) [mm]; inf past `limit`."""
    return dijkstra(edge_graph(mesh), directed=False, indices=sources, min_only=True, limit=limit)


def harmonic_field(mesh: TriMesh, fixed: Bools, value: Floats, pull: Floats) -> Floats:
    """Return the smooth field w (n,) that equals `value` where `fixed` and minimises the Dirichlet energy elsewhere.

    `pull` (n,) [1/mm^2] draws every free vertex towards its `value` with that weight per area (a screened Poisson
    problem): 0 leaves it free, large values hold it.
    """
    laplace, area = cotangent_laplacian(mesh)
    free = np.flatnonzero(~fixed)
    system = (laplace + diags(pull * area)).tocsr()
    right = (pull * area * value)[free] - system[free][:, np.flatnonzero(fixed)] @ value[fixed]
    out = value.astype(np.float64).copy()
    out[free] = splu(system[free][:, free].tocsc()).solve(right)
    return out


def cotangent_laplacian(mesh: TriMesh) -> tuple[csr_matrix, Floats]:
    """Return the cotangent Laplacian (n, n), positive semi-definite with non-negative weights, and the areas (n,)."""
    n = len(mesh.points)
    corner = mesh.points[mesh.triangles]
    rows, cols, weights = [], [], []
    for k in range(3):
        u = corner[:, (k + 1) % 3] - corner[:, k]
        v = corner[:, (k + 2) % 3] - corner[:, k]
        cotangent = np.einsum("ij,ij->i", u, v) / np.linalg.norm(np.cross(u, v), axis=1)
        rows.append(mesh.triangles[:, (k + 1) % 3])
        cols.append(mesh.triangles[:, (k + 2) % 3])
        weights.append(0.5 * np.clip(cotangent, 0.02, 20.0))
    i, j, w = np.concatenate(rows), np.concatenate(cols), np.concatenate(weights)
    half = coo_matrix((w, (i, j)), shape=(n, n))
    adjacency = (half + half.T).tocsr()
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    return (diags(degree) - adjacency).tocsr(), mesh.vertex_areas
