"""Coarse cubes whose elasticity is measured on the fine lattice: global harmonic coarsening (Kharevych et al. 2009).

Six loads, each a constant stress on the boundary, are solved on the whole fine lattice at small strain. In every coarse
cell the mean strain and the energy under these six loads give its elasticity tensor; the cell becomes a hexahedron of
that material with 2 x 2 x 2 Gauss points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from faceanim.backends.octree_mass_spring.direct import solve
from faceanim.backends.octree_mass_spring.simplify import KB, KE, KF, PAIRS
from faceanim.geometry.octree import CORNERS, Octree
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import UserError

SOFTENING = 1e-9
"""What holds the free body in the six solves, as a share of the largest stiffness; their loads are balanced."""
MOST_NODES = 60_000


def cell_matrix(springs: Floats) -> Floats:
    """Return the stiffness at rest (24, 24) of one cell with these 28 `springs`, three rows a corner."""
    out = np.zeros((8, 3, 8, 3))
    for (a, b), k in zip(PAIRS, springs, strict=True):
        along = (CORNERS[b] - CORNERS[a]).astype(np.float64)
        share = k * np.outer(along, along) / (along @ along)
        out[a, :, a] += share
        out[b, :, b] += share
        out[a, :, b] -= share
        out[b, :, a] -= share
    return out.reshape(24, 24)


UNIT = cell_matrix(np.r_[np.full(12, KE / 4), np.full(12, KF / 2), np.full(4, KB)])
"""Stiffness of a leaf whose whole edge has the stiffness 1."""


def _strain_rows(gradient: Any) -> Floats:
    """Return B (..., 6, 24), strain xx, yy, zz, yz, zx, xy (engineering), from corner `gradient` (..., 8, 3)."""
    b = np.zeros((*gradient.shape[:-2], 6, 8, 3))
    for d in range(3):
        b[..., d, :, d] = gradient[..., d]
    for row, (p, q) in enumerate(((1, 2), (2, 0), (0, 1)), start=3):
        b[..., row, :, p] = gradient[..., q]
        b[..., row, :, q] = gradient[..., p]
    return b.reshape(*gradient.shape[:-2], 6, 24)


def _gradients(at: Any) -> Floats:
    """Return the gradients of the corner functions of the unit cube at `at` (k, 3), (k, 8, 3)."""
    value = np.where(CORNERS == 1, at[:, None], 1.0 - at[:, None])
    sign = 2.0 * CORNERS - 1.0
    parts = [sign[:, d] * np.delete(value, d, axis=2).prod(axis=2) for d in range(3)]
    return np.asarray(np.stack(parts, axis=2), dtype=np.float64)


MEAN = _strain_rows((2.0 * CORNERS - 1.0)[None] / 4.0)[0]
"""Mean strain of the unit cube from its corners, (6, 24)."""
_GAUSS = _strain_rows(_gradients(0.5 + (CORNERS - 0.5) / np.sqrt(3.0)))


def hexahedra(elasticity: Floats, side: float) -> Floats:
    """Return the stiffness (c, 24, 24) of cubes of `elasticity` (c, 6, 6) [kPa], 2 x 2 x 2 Gauss points."""
    return np.asarray(side / 8.0 * np.einsum("gai,cab,gbj->cij", _GAUSS, elasticity, _GAUSS, optimize=True))


def _six_solutions(tree: Octree, stiffness: Floats) -> Floats:
    """Return the displacements (n, 3, 6) of the leaves' nodes under six constant boundary stresses."""
    leaves = tree.leaves
    n = len(leaves.points)
    if n > MOST_NODES:
        raise UserError(f"rule 'harmonic': {n} fine nodes, at most {MOST_NODES} can be solved; raise the cell size")
    rows = (3 * leaves.corner[:, :, None] + np.arange(3)).reshape(-1, 24)
    i, j = np.repeat(rows, 24, axis=1).ravel(), np.tile(rows, (1, 24)).ravel()
    blocks = stiffness[:, None, None] * UNIT
    k = sparse.coo_matrix((blocks.ravel(), (i, j)), shape=(3 * n, 3 * n)).tocsc()
    load = np.zeros((3 * n, 6))
    share = np.broadcast_to(leaves.side**2 * MEAN.T, (len(rows), 24, 6))
    np.add.at(load, rows.ravel(), share.reshape(-1, 6))
    k = k + SOFTENING * stiffness.max() * sparse.identity(3 * n, format="csc")
    return np.asarray(solve(k, load).reshape(n, 3, 6))


def cubes(tree: Octree, stiffness: Floats) -> dict[int, Floats]:
    """Return for every level above 0 the stiffness (c, 24, 24) of its cells, from leaves of `stiffness` (c,)."""
    u = _six_solutions(tree, stiffness)
    scale = stiffness.max()
    local = u[tree.leaves.corner].reshape(-1, 24, 6)
    energy = np.einsum("cap,ab,cbq->cpq", local, UNIT, local, optimize=True) * stiffness[:, None, None]
    out = {}
    node: Any = np.arange(len(tree.leaves.points))
    for level in range(1, len(tree.levels)):
        cells = tree.levels[level]
        node = _lifted(node, tree.up[level - 1], len(cells.points))
        total = np.zeros((len(cells.index), 6, 6))
        np.add.at(total, tree.ancestor[level], energy)
        corner = node[cells.corner]
        moved = np.where((corner >= 0)[:, :, None, None], u[corner], 0.0)
        whole = (corner >= 0).all(axis=1)
        strain = np.einsum("ia,caj->cij", MEAN, moved.reshape(-1, 24, 6)) / cells.side
        if not whole.all():
            strain[~whole] = _mean_strain(tree, local, level)[~whole]
        inverse = np.linalg.pinv(strain, rcond=1e-9)
        tensor = inverse.transpose(0, 2, 1) @ total @ inverse / cells.side**3
        out[level] = hexahedra(_positive(tensor, scale / cells.side), cells.side)
    return out


def _lifted(node: Any, up: Ints, n: int) -> Any:
    """Return the fine node at each of `n` coarse nodes, -1 where none is, from those `node` of the level below."""
    out = np.full(n, -1)
    held = (up >= 0) & (node >= 0)
    out[up[held]] = node[held]
    return out


def _mean_strain(tree: Octree, local: Floats, level: int) -> Floats:
    """Return the mean strain (c, 6, 6) of the leaves in every cell of `level`, for cells with missing corners."""
    leaf = np.einsum("ia,caj->cij", MEAN, local) / tree.leaves.side
    parent = tree.ancestor[level]
    total = np.zeros((len(tree.levels[level].index), 6, 6))
    np.add.at(total, parent, leaf)
    return total / np.bincount(parent, minlength=len(total))[:, None, None]


def _positive(tensor: Floats, scale: float) -> Floats:
    """Return symmetric tensors (c, 6, 6) with no eigenvalue below a small share of `scale`."""
    value, vector = np.linalg.eigh(0.5 * (tensor + tensor.transpose(0, 2, 1)))
    value = np.maximum(value, 1e-6 * scale)
    return np.asarray(np.einsum("cia,ca,cja->cij", vector, value, vector))
