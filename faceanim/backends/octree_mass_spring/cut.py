"""Which cells are simulated: by the forces they must survive, by importance, by a budget of springs (section 4.4)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from faceanim.backends.octree_mass_spring.lattice import Lattice
from faceanim.backends.octree_mass_spring.model import Model, assemble, closed
from faceanim.geometry.octree import Octree
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import UserError

Forces = Callable[[Model], Floats]
"""Nodal forces (n, 3) [mN] on a model."""


def unsafe_cells(model: Model, force: Floats, dt: float, beta: float) -> Bools:
    """Return the active cells (a,) with a corner that `force` (n, 3) moves out of its safe box in one step from rest.

    The sphere of radius d = |f| dt^2 / m must fit into the box of half-width beta side: a cell is unsafe if d is larger.
    """
    mass = np.maximum(model.mass, 1e-300)
    d = np.linalg.norm(force, axis=1) * dt**2 / mass
    d[model.carried] = 0.0
    d[model.tables.slaves.node] = 0.0
    return np.asarray(d[model.corner].max(axis=1) > beta * model.side)


def coarsened(model: Model, cells: Bools) -> Ints:
    """Return the leaf levels (c,) of the cut in which every active cell of `cells` (a,) is replaced by its parent."""
    return closed(model.lattice.tree, model.level + cells[model.of_leaf])


def safe_cut(lattice: Lattice, force: Forces, dt: float, beta: float, start: Ints | None = None) -> Ints:
    """Return the leaf levels (c,) at which no cell is unsafe under `force` with steps `dt` [s], or its parent is the root.

    From `start` (default: the leaves): unsafe cells give way to their parents, forces and masses are taken anew, until
    none is unsafe. Larger cells are heavier and wider, hence safer.
    """
    level = np.zeros(len(lattice.stiffness), dtype=np.int32) if start is None else closed(lattice.tree, start)
    for _ in range(len(lattice.stiffness)):
        model = assemble(lattice, level)
        bad = unsafe_cells(model, force(model), dt, beta) & (model.cell_level < lattice.top)
        if not bad.any():
            return level
        level = coarsened(model, bad)
    return level


def important_cut(tree: Octree, leaf: Ints, weight: Floats, coarsest: int) -> Ints:
    """Return the leaf levels (c,): 0 where surface points in `leaf` (k,) have `weight` (k,) 1, `coarsest` where 0.

    A leaf takes the largest weight painted in it; one without surface that of the nearest leaf with surface.
    """
    painted = np.full(len(tree.leaves.index), -1.0)
    np.maximum.at(painted, leaf, weight)
    known = np.flatnonzero(painted >= 0)
    _, near = cKDTree(tree.leaves.centres[known]).query(tree.leaves.centres)
    level = np.rint((1.0 - painted[known[near]]) * coarsest).astype(np.int32)
    # an important leaf must stay a leaf although a whole parent is coarsened with its dullest child
    return _finest(tree, level)


def box_cut(tree: Octree, box: Floats, coarsest: int) -> Ints:
    """Return the leaf levels (c,): 0 for leaves that meet `box` (2, 3) [mm], `coarsest` where that leaves them alone."""
    half = 0.5 * tree.leaves.side
    inside = ((tree.leaves.centres + half > box[0]) & (tree.leaves.centres - half < box[1])).all(axis=1)
    return _finest(tree, np.where(inside, 0, coarsest))


def _finest(tree: Octree, level: Ints) -> Ints:
    """Return the coarsest cut that is nowhere coarser than wanted: a cell is used only if all its leaves want it."""
    out = np.zeros(len(level), dtype=np.int32)
    for k in range(1, len(tree.levels)):
        least = np.full(len(tree.levels[k].index), 99, dtype=np.int64)
        np.minimum.at(least, tree.ancestor[k], level)
        out[least[tree.ancestor[k]] >= k] = k
    return closed(tree, out)


def budget_cut(lattice: Lattice, budget: int, importance: Floats | None = None) -> Ints:
    """Return the finest leaf levels (c,) with at most `budget` springs; what matters least is coarsened first.

    importance : (c,) of the leaves; a cell matters as much as its most important leaf (None = all alike)
    Raises `UserError` if even the coarsest level has more springs.
    """
    tree = lattice.tree
    value = np.zeros(len(lattice.stiffness)) if importance is None else importance
    order = []
    for k in range(1, len(tree.levels)):
        most = np.full(len(tree.levels[k].index), -np.inf)
        np.maximum.at(most, tree.ancestor[k], value)
        order += [(k, int(cell)) for cell in np.argsort(most, kind="stable")]

    def cut(count: int) -> Ints:
        level = np.zeros(len(value), dtype=np.int32)
        for k in range(1, len(tree.levels)):
            cells = [cell for at, cell in order[:count] if at == k]
            level[np.isin(tree.ancestor[k], cells)] = k
        return closed(tree, level)

    def springs(count: int) -> int:
        return len(assemble(lattice, cut(count)).tables.springs.i)

    low, high = 0, len(order)
    if springs(high) > budget:
        raise UserError(
            f"budget = {budget} springs: the coarsest level has {springs(high)}; allow more levels or springs"
        )
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if springs(middle) <= budget else (middle + 1, high)
    return cut(low)
