"""From one cut to another while moving, and how far two cuts are apart (sections 4.4 and 4.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from faceanim.backends.octree_mass_spring.model import Model
from faceanim.ground.arrays import Floats, Ints
from faceanim.kernels import lattice as kernels


def transfer(old: Model, new: Model, x: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Return positions and velocities (n, 3) on `new` from those on `old`; the momentum of all cells is kept exactly.

    Positions: every node is where the old cell carried that material point. Velocities: a cell that stays or was cut up
    takes those of the old cell at its corners, one that replaces smaller cells their momenta by trilinear weights; a
    node's velocity is the sum of its cells' momenta over the sum of their masses.
    """
    leaf = _corner_leaves(new)
    place = new.points[new.corner]
    node, weight = old.embed(leaf.ravel(), place.reshape(-1, 3))
    moved = np.einsum("ka,kad->kd", weight, x[node])
    position = np.zeros_like(new.points)
    position[new.corner.ravel()] = moved
    momentum = new.own_mass[:, :, None] * np.einsum("ka,kad->kd", weight, v[node]).reshape(-1, 8, 3)
    grown = np.zeros(len(new.cell), dtype=bool)
    grown[new.of_leaf[new.level > old.level]] = True
    momentum[grown] = _gathered(old, new, v)[grown]
    total, mass = np.zeros_like(new.points), np.zeros(len(new.points))
    np.add.at(total, new.corner, momentum)
    np.add.at(mass, new.corner, new.own_mass)
    total, mass = new.reduce.T @ total, new.reduce.T @ mass
    velocity = np.divide(total, mass[:, None], out=np.zeros_like(total), where=mass[:, None] > 0)
    kernels.follow(position, new.tables.slaves)
    kernels.follow(velocity, new.tables.slaves)
    return position, velocity


def _corner_leaves(model: Model) -> Ints:
    """Return the leaf nearest to each corner of every active cell, (a, 8)."""
    centres = model.lattice.tree.leaves.centres
    out = np.zeros((len(model.cell), 8), dtype=np.int32)
    for k in range(8):
        away = np.abs(centres - model.points[model.corner[model.of_leaf, k]]).max(axis=1)
        order = np.lexsort((away, model.of_leaf))
        out[:, k] = order[np.searchsorted(model.of_leaf[order], np.arange(len(out)))]
    return out


def _gathered(old: Model, new: Model, v: Floats) -> Floats:
    """Return the momenta (a, 8, 3) that the old cells inside every new cell give to its corners."""
    out = np.zeros((len(new.cell), 8, 3))
    leaf = np.unique(old.of_leaf, return_index=True)[1].astype(np.int32)
    inside = old.cell_level <= new.cell_level[new.of_leaf[leaf]]
    cells = np.flatnonzero(inside)
    over = new.of_leaf[leaf[cells]]
    momentum = old.own_mass[cells][:, :, None] * v[old.corner[cells]]
    for k in range(8):
        _, weight = new.embed(leaf[cells], old.points[old.corner[cells, k]])
        np.add.at(out, over, weight[:, :, None] * momentum[:, k, None, :])
    return out


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Points `place` (k, 3) [mm] of the body at rest, in leaves `leaf` (k,), at which cuts are compared."""

    leaf: Ints
    place: Floats

    def at(self, model: Model, x: Floats) -> Floats:
        """Return where they are when the nodes of `model` are at `x` (n, 3), (k, 3) [mm]: trilinear, fixed coordinates."""
        node, weight = model.embed(self.leaf, self.place)
        return np.asarray(np.einsum("ka,kad->kd", weight, x[node]))


def landmark_error(
    marks: Landmarks, fine: Model, x_fine: Floats, coarse: Model, x_coarse: Floats
) -> tuple[float, float]:
    """Return Err = sum_i |g_i(fine) - g_i(coarse)| [mm] (section 4.5) and Err over the sum of the fine displacements."""
    reference = marks.at(fine, x_fine)
    error = float(np.linalg.norm(reference - marks.at(coarse, x_coarse), axis=1).sum())
    moved = float(np.linalg.norm(reference - marks.place, axis=1).sum())
    return error, error / moved if moved > 0 else (0.0 if error == 0 else np.inf)
