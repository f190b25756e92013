"""Springs, masses, hexahedra and ties of one choice of cells: the cut through the octree that is simulated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import eigsh

from faceanim.backends.octree_mass_spring import harmonic
from faceanim.backends.octree_mass_spring.direct import factored
from faceanim.backends.octree_mass_spring.lattice import Lattice
from faceanim.backends.octree_mass_spring.simplify import PAIRS, YOUNG
from faceanim.geometry.octree import Octree
from faceanim.ground.arrays import Floats, Ints
from faceanim.kernels import lattice as kernels
from faceanim.kernels.lattice import (
    LatticeBarrier,
    LatticeCells,
    LatticeHexes,
    LatticeSlaves,
    LatticeSprings,
    LatticeTables,
    LatticeTies,
)


def closed(tree: Octree, level: Ints) -> Ints:
    """Return the coarsest of the wanted leaf levels `level` (c,) on all leaves of a cell: a cut that can be built."""
    out = np.clip(np.asarray(level, dtype=np.int32), 0, len(tree.levels) - 1)
    for k in range(1, len(tree.levels)):
        most = np.zeros(len(tree.levels[k].index), dtype=np.int32)
        np.maximum.at(most, tree.ancestor[k], out)
        reached = most[tree.ancestor[k]] >= k
        out = np.where(reached, np.maximum(out, k), out).astype(np.int32)
    return out


@dataclass(frozen=True, eq=False)
class Model:
    """What is stepped: a cut with its tables.

    level : (c,) of the active cell over each leaf   of_leaf : (c,) that active cell
    cell_level, cell : (a,) of every active cell   corner : (a, 8)   points : (n, 3) [mm] at rest, sorted by place
    mass : (n,) [kg], of slaves moved to their masters   own_mass : (a, 8) [kg] each cell's share
    carried : (p,) nodes that bones carry exactly   carried_by : (p,) which held point of the solid each is
    reduce : (n, n) all nodes from those that are no slaves
    """

    lattice: Lattice
    level: Ints
    of_leaf: Ints
    cell_level: Ints
    cell: Ints
    corner: Ints
    points: Floats
    mass: Floats
    own_mass: Floats
    carried: Ints
    carried_by: Ints
    tables: LatticeTables
    reduce: sparse.csr_matrix

    @property
    def side(self) -> Floats:
        """(a,) [mm]."""
        return self.lattice.tree.leaves.side * np.left_shift(1, self.cell_level).astype(np.float64)

    def embed(self, leaf: Ints, points: Floats) -> tuple[Ints, Floats]:
        """Return nodes and trilinear weights (k, 8) of `points` (k, 3) at rest in the active cells over `leaf` (k,)."""
        active = self.of_leaf[leaf]
        weight = np.zeros((len(leaf), 8))
        for level, cells in enumerate(self.lattice.tree.levels):
            mine = self.cell_level[active] == level
            if mine.any():
                weight[mine] = cells.weights(self.cell[active[mine]], points[mine])
        return self.corner[active], weight

    def free_mask(self) -> np.ndarray:
        """Return which nodes are neither carried nor slaves, (n,) bool."""
        free = np.ones(len(self.points), dtype=bool)
        free[self.carried] = False
        free[self.tables.slaves.node] = False
        return free

    def stiffness_at(self, x: Floats, floor: float = 0.0) -> sparse.csc_matrix:
        """Return the stiffness of springs, ties and hexahedra at `x` (n, 3), never negative across, (3n, 3n) [mN/mm]."""
        n, t = len(self.points), self.tables
        block = np.zeros((len(t.springs.i), 3, 3))
        kernels.spring_blocks(x, t.springs, floor, block)
        i, j = t.springs.i, t.springs.j
        parts = [_scattered(p, q, s * block, n) for p, q, s in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1))]
        if len(t.hexes.side):
            turn = np.zeros((len(t.hexes.side), 3, 3))
            kernels.hex_rotations(x, t.hexes, turn)
            k = t.hexes.stiffness.reshape(-1, 8, 3, 8, 3)
            k = np.einsum("cij,cajbk,clk->cabil", turn, k, turn, optimize=True)
            rows = np.repeat(t.hexes.corner, 8, axis=1).ravel()
            columns = np.tile(t.hexes.corner, (1, 8)).ravel()
            parts.append(_scattered(rows, columns, k.reshape(-1, 3, 3), n))
        total = sum(parts[1:], parts[0])
        if len(t.ties.stiffness):
            w = self.tie_matrix()
            total = total + sparse.kron(w.T @ sparse.diags(t.ties.stiffness) @ w, sparse.identity(3))
        if t.barrier.listed[0]:
            total = total + self._barrier_at(x)
        return total.tocsc()

    def _barrier_at(self, x: Floats) -> sparse.csr_matrix:
        """Return the stiffness of the barriers near `x` (n, 3) without the part that may be negative, (3n, 3n)."""
        cells, barrier = self.tables.cells, self.tables.barrier
        k = 8 * int(barrier.listed[0])
        node, slope, weight = np.zeros((k, 4), np.int32), np.zeros((k, 4, 3)), np.zeros(k)
        kernels.barrier_slopes(x, cells, barrier, node, slope, weight)
        columns = (3 * node[:, :, None] + np.arange(3)).reshape(k, 12)
        rows = np.repeat(np.arange(k), 12)
        g = sparse.csr_matrix((slope.ravel(), (rows, columns.ravel())), shape=(k, 3 * len(self.points)))
        return (g.T @ sparse.diags(weight) @ g).tocsr()

    def tie_matrix(self) -> sparse.csr_matrix:
        """Return the weights of all ties, (t, n)."""
        ties = self.tables.ties
        rows = np.repeat(np.arange(len(ties.stiffness)), 9)
        shape = (len(ties.stiffness), len(self.points))
        return sparse.csr_matrix((ties.weight.ravel(), (rows, ties.node.ravel())), shape=shape)

    def largest_step(self, drag: float = 0.0) -> float:
        """Return the largest stable step of symplectic Euler at rest [s], 2 / w, w^2 the largest eigenvalue of M^-1 K.

        With a drag [1/s], implicit in the velocity, it is longer: (w dt)^2 = 4 + 2 drag dt.
        """
        if not self.free_mask().any():
            return np.inf
        square = self._largest_square()
        return float((drag + np.sqrt(drag**2 + 4.0 * square)) / square)

    def slowest(self) -> float:
        """Return the angular frequency [1/s] of the lowest vibration at rest: inverse iteration from the rigid movements."""
        free = self.free_mask()
        if not free.any():
            return np.inf
        lift = sparse.kron(self.reduce[:, free], sparse.identity(3)).tocsr()
        k = (lift.T @ self.stiffness_at(self.points) @ lift).tocsc()
        mass = np.repeat(self.mass[free], 3)
        solved = factored(k + 1e-12 * float(k.diagonal().max()) * sparse.identity(k.shape[0], format="csc"))
        x, lowest = np.tile(np.eye(3), (int(free.sum()), 1)), np.inf
        for _ in range(8):
            x, _ = np.linalg.qr(solved(mass[:, None] * x))  # else all columns turn into the slowest vibration
            value = eigh(x.T @ (k @ x), x.T @ (mass[:, None] * x), eigvals_only=True)
            lowest = float(max(value[0], 0.0))
        return float(np.sqrt(lowest))

    def _largest_square(self) -> float:
        """Return the largest eigenvalue of M^-1 K at rest [1/s^2]."""
        free = self.free_mask()
        lift = sparse.kron(self.reduce[:, free], sparse.identity(3)).tocsr()
        k = (lift.T @ self.stiffness_at(self.points) @ lift).tocsr()
        scale = sparse.diags(1.0 / np.sqrt(np.repeat(self.mass[free], 3)))
        a = (scale @ k @ scale).tocsr()
        if a.shape[0] < 40:
            return float(np.linalg.eigvalsh(a.toarray())[-1])
        start = np.random.default_rng(0).standard_normal(a.shape[0])
        top = eigsh(a, k=1, which="LA", return_eigenvectors=False, v0=start, tol=1e-4)
        return float(top[0])

    def least_volume(self, x: Floats) -> Floats:
        """Return the smallest corner Jacobian of every active cell at `x` (n, 3), (a,) [-]; 1 at rest."""
        out = np.zeros(len(self.corner))
        kernels.corner_volumes(x, self.tables.cells, out)
        return out


def _scattered(rows: Ints, columns: Ints, blocks: Floats, n: int) -> sparse.csr_matrix:
    d = np.arange(3)
    i = np.broadcast_to(3 * rows[:, None, None] + d[None, :, None], blocks.shape)
    j = np.broadcast_to(3 * columns[:, None, None] + d[None, None, :], blocks.shape)
    return sparse.coo_matrix((blocks.ravel(), (i.ravel(), j.ravel())), shape=(3 * n, 3 * n)).tocsr()


@dataclass(frozen=True, eq=False)
class Points:
    """Held points (p, 3) of the solid at rest, each in a leaf (p,): carried exactly or tied to where bones take them.

    node : for every level (n_l,) the held point that each of its nodes is, -1 = none
    """

    leaf: Ints
    place: Floats
    node: tuple[Ints, ...]

    @classmethod
    def none(cls, tree: Octree) -> Points:
        """Return no held points."""
        return cls(np.zeros(0, np.int32), np.zeros((0, 3)), tuple(np.full(len(c.points), -1) for c in tree.levels))

    @classmethod
    def at(cls, tree: Octree, leaf: Ints, place: Floats) -> Points:
        """Return the held points `place` (p, 3) in leaves `leaf` (p,), with the nodes that lie exactly on them."""
        weight = tree.leaves.weights(leaf, place)
        which = np.argmax(weight, axis=1)
        exact = weight[np.arange(len(leaf)), which] > 1.0 - 1e-9
        node = [np.full(len(cells.points), -1) for cells in tree.levels]
        node[0][tree.leaves.corner[leaf, which][exact]] = np.flatnonzero(exact)
        for k, up in enumerate(tree.up):
            found = (node[k] >= 0) & (up >= 0)
            node[k + 1][up[found]] = node[k][found]
        return cls(leaf, place, tuple(node))


def assemble(
    lattice: Lattice, level: Ints, *, ks: float = 10.0, hard: bool = False, held: Points | None = None
) -> Model:
    """Return the model of the cut `level` (c,), the wanted level over each leaf.

    ks : [-] stiffness of the ties between cells of unlike size, in edges of the finest leaves they join
    hard : hanging nodes follow their coarse cell exactly instead   held : points that bones carry
    """
    tree = lattice.tree
    held = Points.none(tree) if held is None else held
    level = closed(tree, level)
    nodes = _Nodes(tree, level)
    carrier = nodes.carrier(held)
    springs = _springs(lattice, nodes)
    own = np.concatenate([lattice.cell_tables(k)[1][nodes.cell[nodes.cell_level == k]] for k in nodes.used])
    mass: Floats = np.bincount(nodes.corner.ravel(), own.ravel(), len(nodes.points)).astype(np.float64)
    hanging, parent = nodes.hanging(carrier < 0)
    points = nodes.points
    model = Model(
        lattice, level, nodes.of_leaf, nodes.cell_level, nodes.cell, nodes.corner, points, mass, own,
        np.flatnonzero(carrier >= 0).astype(np.int32), carrier[carrier >= 0].astype(np.int32),
        _no_tables(lattice, springs, nodes), sparse.identity(len(points), format="csr"),
    )  # fmt: skip
    masters, weight = model.embed(nodes.a_leaf[parent], points[hanging])
    tables, reduce = model.tables._replace(hexes=_hexes(lattice, nodes)), model.reduce
    fine_edge = float(np.median(lattice.stiffness))
    if hard and len(hanging):
        reduce, slaves = _slaves(len(points), hanging, masters, weight)
        tables = tables._replace(slaves=slaves)
        mass = np.asarray(reduce.T @ mass)
    elif len(hanging):
        weight = np.concatenate([weight, np.full((len(hanging), 1), -1.0)], axis=1)
        masters = np.concatenate([masters, hanging[:, None]], axis=1).astype(np.int32)
        tables = tables._replace(ties=LatticeTies(masters, weight, np.full(len(hanging), ks * fine_edge)))
    values = {**model.__dict__, "tables": tables, "reduce": reduce, "mass": mass}
    return Model(**values)


def tied(model: Model, held: Points, stiffness: Floats) -> tuple[Model, Ints]:
    """Return `model` with ties of `stiffness` (p,) [mN/mm] to the held points that are loose, and which these are."""
    node, weight = model.embed(held.leaf, held.place)
    is_carried = np.zeros(len(model.points), dtype=bool)
    is_carried[model.carried] = True
    loose = (np.where(is_carried[node], 0.0, np.abs(weight)).sum(axis=1) > 1e-9).nonzero()[0].astype(np.int32)
    if not len(loose):
        return model, loose
    old = model.tables.ties
    ties = LatticeTies(
        np.concatenate([old.node, np.pad(node[loose], ((0, 0), (0, 1)))]).astype(np.int32),
        np.concatenate([old.weight, np.pad(weight[loose], ((0, 0), (0, 1)))]),
        np.concatenate([old.stiffness, stiffness[loose]]),
    )
    return Model(**{**model.__dict__, "tables": model.tables._replace(ties=ties)}), loose


class _Nodes:
    """The active cells of a cut and their nodes: nodes of unlike levels at one place are one where flesh joins them."""

    def __init__(self, tree: Octree, level: Ints) -> None:
        self.tree, self.level = tree, level
        self.used = [k for k in range(len(tree.levels)) if (level == k).any()]
        self.cell_level, self.cell = np.zeros((2, 0), dtype=np.int32)
        self.of_leaf = np.zeros(len(level), dtype=np.int32)
        for k in self.used:
            cells, which = np.unique(tree.ancestor[k][level == k], return_inverse=True)
            self.of_leaf[level == k] = len(self.cell) + which
            self.cell = np.r_[self.cell, cells].astype(np.int32)
            self.cell_level = np.r_[self.cell_level, np.full(len(cells), k)].astype(np.int32)
        self.a_leaf = np.zeros(len(self.cell), dtype=np.int32)
        self.a_leaf[self.of_leaf] = np.arange(len(level))
        self._number()

    def _number(self) -> None:
        """Number the nodes by place; `number[k]` gives the node of the cut that each node of level k is, or -1."""
        tree, count = self.tree, len(self.tree.levels)
        alive = [np.zeros(len(c.points), dtype=bool) for c in tree.levels]
        for k in self.used:
            alive[k][tree.levels[k].corner[self.cell[self.cell_level == k]]] = True
        start = np.r_[0, np.cumsum([len(c.points) for c in tree.levels])]
        key = [start[k] + np.arange(len(c.points)) for k, c in enumerate(tree.levels)]
        for k in reversed(range(count - 1)):
            follows = (tree.up[k] >= 0) & alive[k + 1][tree.up[k]]
            key[k] = np.where(follows, key[k + 1][tree.up[k]], key[k])
            alive[k] |= follows
        every = np.unique(np.concatenate([key[k][alive[k]] for k in range(count)]))
        points = np.concatenate([c.points for c in tree.levels])[every]
        order = np.lexsort((points[:, 2], points[:, 1], points[:, 0]))
        rank = np.empty(len(every), dtype=np.int64)
        rank[order] = np.arange(len(every))
        self.number = [
            np.where(alive[k], rank[np.searchsorted(every, key[k]).clip(0, len(every) - 1)], -1) for k in range(count)
        ]
        self.points = np.ascontiguousarray(points[order])
        corner = [self.number[k][tree.levels[k].corner[self.cell[self.cell_level == k]]] for k in self.used]
        self.corner = np.ascontiguousarray(np.concatenate(corner), dtype=np.int32)

    def carrier(self, held: Points) -> Ints:
        """Return the held point that each node is, (n,), -1 = none."""
        out = np.full(len(self.points), -1)
        for k, node in enumerate(held.node):
            found = (node >= 0) & (self.number[k] >= 0)
            out[self.number[k][found]] = node[found]
        return out

    def hanging(self, allowed: np.ndarray) -> tuple[Ints, Ints]:
        """Return the nodes that lie on a face or edge of a larger active cell, and that cell (the largest of them)."""
        best = np.full(len(self.points), -1)
        for k in range(len(self.tree.levels)):
            over = np.zeros(len(self.tree.levels[k].index), dtype=np.int64)
            over[self.tree.ancestor[k]] = self.of_leaf
            inside = np.zeros(len(over), dtype=bool)
            inside[self.tree.ancestor[k]] = self.level > k
            cells = np.flatnonzero(inside)
            node = self.number[k][self.tree.levels[k].corner[cells]]
            larger = np.repeat(over[cells], 8).reshape(-1, 8)
            known = node >= 0
            known[known] &= ~(self.corner[larger[known]] == node[known][:, None]).any(axis=1)
            rank = self.cell_level[larger[known]] * np.int64(len(self.cell)) + larger[known]
            np.maximum.at(best, node[known], rank)
        found = np.flatnonzero((best >= 0) & allowed)
        return found.astype(np.int32), (best[found] % len(self.cell)).astype(np.int32)


def _no_tables(lattice: Lattice, springs: LatticeSprings, nodes: _Nodes) -> LatticeTables:
    none = np.zeros(0, dtype=np.int32)
    side = nodes.tree.leaves.side * np.left_shift(1, nodes.cell_level).astype(np.float64)
    return LatticeTables(
        springs, LatticeTies(np.zeros((0, 9), np.int32), np.zeros((0, 9)), np.zeros(0)),
        LatticeSlaves(none, np.zeros(1, np.int32), none, np.zeros(0)),
        LatticeHexes(np.zeros((0, 8), np.int32), np.zeros((0, 24, 24)), np.zeros(0)),
        LatticeCells(nodes.corner, side), _barrier(lattice, nodes),
    )  # fmt: skip


def _barrier(lattice: Lattice, nodes: _Nodes) -> LatticeBarrier:
    """Return the barriers of all active cells: `Lattice.barrier` E volume / 8 at each corner."""
    leaf = 0.125 * lattice.barrier * YOUNG * lattice.stiffness * lattice.tree.leaves.side**2
    count = len(nodes.cell)
    strength: Floats = np.bincount(nodes.of_leaf, leaf, count).astype(np.float64)
    return LatticeBarrier(strength, float(lattice.least), np.zeros(count, np.int32), np.zeros(1, np.int32))


def _springs(lattice: Lattice, nodes: _Nodes) -> LatticeSprings:
    """Return the springs of all active cells, those between the same nodes added up, sorted by their nodes."""
    n = len(nodes.points)
    pair, stiffness = np.zeros(0, dtype=np.int64), np.zeros(0)
    for k in nodes.used:
        if k and lattice.rule == "harmonic":
            continue
        mine = nodes.cell_level == k
        ends = np.sort(nodes.corner[mine][:, PAIRS].astype(np.int64), axis=2).reshape(-1, 2)
        pair = np.r_[pair, ends[:, 0] * n + ends[:, 1]]
        stiffness = np.r_[stiffness, lattice.cell_tables(k)[0][nodes.cell[mine]].ravel()]
    unique, which = np.unique(pair, return_inverse=True)
    total: Any = np.bincount(which, stiffness, len(unique)) if len(unique) else np.zeros(0)
    unique, total = unique[total > 0], total[total > 0]
    i, j = (unique // n).astype(np.int32), (unique % n).astype(np.int32)
    rest = np.linalg.norm(nodes.points[j] - nodes.points[i], axis=1)
    return LatticeSprings(i, j, total, rest, lattice.low * rest, lattice.high * rest, float(lattice.ramp))


def _hexes(lattice: Lattice, nodes: _Nodes) -> LatticeHexes:
    coarse = [k for k in nodes.used if k] if lattice.rule == "harmonic" else []
    mine = np.isin(nodes.cell_level, coarse)
    if not mine.any():
        return LatticeHexes(np.zeros((0, 8), np.int32), np.zeros((0, 24, 24)), np.zeros(0))
    stiffness = np.concatenate([lattice.cubes(k)[nodes.cell[nodes.cell_level == k]] for k in coarse])
    side = nodes.tree.leaves.side * np.left_shift(1, nodes.cell_level[mine]).astype(np.float64)
    return LatticeHexes(np.ascontiguousarray(nodes.corner[mine]), np.ascontiguousarray(stiffness), side)


def _slaves(n: int, node: Ints, masters: Ints, weight: Floats) -> tuple[sparse.csr_matrix, LatticeSlaves]:
    """Return all nodes as weighted sums of free ones, (n, n), and the same as a table; a master may itself be a slave."""
    free = np.ones(n)
    free[node] = 0.0
    rows = np.repeat(node, 8)
    follow = sparse.csr_matrix((weight.ravel(), (rows, masters.ravel())), shape=(n, n)) + sparse.diags(free)
    for _ in range(32):
        follow = (follow @ follow).tocsr()
        follow.data[np.abs(follow.data) < 1e-14] = 0.0
        follow.eliminate_zeros()
        if not free[follow.indices].min() < 1.0:
            break
    part = follow[node].tocsr()
    table = LatticeSlaves(
        node, part.indptr.astype(np.int32), part.indices.astype(np.int32), np.ascontiguousarray(part.data)
    )
    return follow, table


__all__ = ["Model", "Points", "assemble", "closed", "harmonic", "tied"]
