"""Open up slivers: push apart vertices of the coarse mesh that nearly coincide and carry the motion to all samples."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from assets_subdivision import QuadMesh


def both_diagonals(faces: np.ndarray) -> np.ndarray:
    """All four triangles a quad can be cut into, (4 f, 3): whichever diagonal is taken later is covered."""
    return np.vstack([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]], faces[:, [0, 1, 3]], faces[:, [1, 2, 3]]])


def altitudes(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smallest altitude of each triangle [mm], its unit direction, and its corner opposite the longest edge first."""
    corners = points[triangles]
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2)
    apex = np.argmax(length, axis=1)
    order = triangles[np.arange(len(triangles))[:, None], (apex[:, None] + np.arange(3)) % 3]
    a, b, c = (points[order[:, k]] for k in range(3))
    along = (c - b) / np.maximum(np.linalg.norm(c - b, axis=1), 1e-9)[:, None]
    up = (a - b) - np.einsum("ij,ij->i", a - b, along)[:, None] * along
    height = np.linalg.norm(up, axis=1)
    return height, up / np.maximum(height, 1e-9)[:, None], order


def relax(points: np.ndarray, mesh: QuadMesh, *, edge: float, height: float, sweeps: int = 60) -> np.ndarray:
    """Displacement (n, 3) [mm] that lengthens edges shorter than `edge` and triangles lower than `height` [mm]."""
    n = mesh.n_points
    p = points[:n].copy()
    triangles = both_diagonals(mesh.faces)
    pairs = mesh.edges
    adjacency = sp.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    adjacency = (adjacency + adjacency.T).tocsr()
    mean = sp.diags(1.0 / np.asarray(adjacency.sum(axis=1)).ravel()) @ adjacency
    fixed = np.zeros(n, bool)
    fixed[pairs[mesh.boundary].ravel()] = True
    for _ in range(sweeps):
        move, count = np.zeros((n, 3)), np.zeros(n)
        span = p[pairs[:, 1]] - p[pairs[:, 0]]
        length = np.linalg.norm(span, axis=1)
        short = np.flatnonzero(length < edge)
        push = 0.5 * (edge - length[short])[:, None] * span[short] / np.maximum(length[short], 1e-6)[:, None]
        for column, sign in ((0, -1.0), (1, 1.0)):
            np.add.at(move, pairs[short, column], sign * push)
            np.add.at(count, pairs[short, column], 1.0)
        tall, up, order = altitudes(p, triangles)
        low = np.flatnonzero(tall < height)
        lift = 0.5 * (height - tall[low])[:, None] * up[low]
        for column, share in ((0, 1.0), (1, -0.5), (2, -0.5)):
            np.add.at(move, order[low, column], share * lift)
            np.add.at(count, order[low, column], 1.0)
        touched = count > 0
        step = move / np.maximum(count, 1.0)[:, None]
        near = (mean @ touched.astype(float)) > 0
        step[near] += 0.08 * (mean @ p - p)[near]
        step[fixed] = 0.0
        p += step
    return p - points[:n]
