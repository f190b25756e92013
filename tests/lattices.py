"""The block of the multiresolution verification: 16 x 8 x 8 cells, 2 x 1 x 1, clamped and loaded in four ways."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from faceanim.backends.octree_mass_spring.lattice import Lattice
from faceanim.backends.octree_mass_spring.model import Model, assemble
from faceanim.backends.octree_mass_spring.static import dead_load, equilibrium
from faceanim.geometry import octree

TREE = octree.block((16, 8, 8), 0.125)
LEAVES = len(TREE.leaves.index)
PLACE = TREE.leaves.index
KINDS = ("tension", "shear", "bend", "twist", "gravity")


def lattice(rule: str = "energy", chain: str = "small_strain", stiffness: Any = 1.0) -> Lattice:
    """Return the block with edges of `stiffness` and density 1."""
    return Lattice(TREE, np.broadcast_to(stiffness, LEAVES).astype(float), np.full(LEAVES, 0.125**3), rule, chain)


def uniform(at: Lattice, level: int) -> Model:
    """Return the cut of one level everywhere."""
    return assemble(at, np.full(LEAVES, level))


def fine_nodes(model: Model) -> sparse.csr_matrix:
    """Return the trilinear weights (n_fine, n) with which `model` carries the nodes of the leaves."""
    leaf = np.zeros(len(TREE.leaves.points), dtype=np.int64)
    leaf[TREE.leaves.corner.ravel()] = np.repeat(np.arange(LEAVES), 8)
    node, weight = model.embed(leaf, TREE.leaves.points)
    rows = np.repeat(np.arange(len(leaf)), 8)
    return sparse.csr_matrix((weight.ravel(), (rows, node.ravel())), shape=(len(leaf), len(model.points)))


def on_face(points: np.ndarray, axis: int, value: float) -> np.ndarray:
    """Return which of `points` (n, 3) lie on a side of the block."""
    return np.isclose(points[:, axis], value)


def load(kind: str, fine: Model, size: float = 1.0) -> np.ndarray:
    """Return the forces (n, 3) on the leaves' nodes, spread over the loaded side by area."""
    x, force = fine.points, np.zeros_like(fine.points)
    axis, value = (2, 1.0) if kind == "shear" else (0, 2.0)
    share = on_face(x, axis, value).astype(float)
    for d in {0, 1, 2} - {axis}:
        share *= np.where(on_face(x, d, 0.0) | on_face(x, d, x[:, d].max()), 0.5, 1.0)
    share *= size / share.sum()
    if kind in ("tension", "shear"):
        force[:, 0] = 0.2 * share
    elif kind == "bend":
        force[:, 2] = -0.02 * share
    elif kind == "twist":
        force[:, 1], force[:, 2] = -0.1 * share * (x[:, 2] - 0.5), 0.1 * share * (x[:, 1] - 0.5)
    else:
        force[:, 2] = -0.025 * size * fine.mass
    return force


def settled(model: Model, force: np.ndarray, kind: str) -> np.ndarray:
    """Return the displacement (n, 3) of the equilibrium with the opposite side clamped."""
    clamped = on_face(model.points, 2 if kind == "shear" else 0, 0.0)
    x, report = equilibrium(model, model.points, dead_load(force), free=model.free_mask() & ~clamped)
    assert report.residual < 1e-9 * max(np.abs(force).max(), 1e-3), report
    return x - model.points


def loaded_side(kind: str) -> np.ndarray:
    """Return the leaves' nodes on the loaded side."""
    return on_face(TREE.leaves.points, *((2, 1.0) if kind == "shear" else (0, 2.0)))


def displacement_error(reference: np.ndarray, other: np.ndarray, kind: str) -> float:
    """Return the change of the mean displacement of the loaded side [%]; both (n_fine, 3)."""
    mean = [np.linalg.norm(u[loaded_side(kind)], axis=1).mean() for u in (reference, other)]
    return float(100.0 * (mean[1] / mean[0] - 1.0))


def coarse_error(at: Lattice, level: Any, kind: str, reference: np.ndarray, force: np.ndarray, **cut: Any) -> float:
    """Return the displacement error [%] of a cut, forces transferred by virtual work."""
    model = assemble(at, np.broadcast_to(level, LEAVES), **cut)
    weight = fine_nodes(model)
    return displacement_error(reference, weight @ settled(model, weight.T @ force, kind), kind)
