"""Hexahedral cells in an octree: a block, a closed surface or a tetrahedral volume cut into cubes, and their parents.

A cube of the grid may hold several cells, one for every piece of flesh in it: the lips touch but do not grow together
(the virtual nodes of Molino, Bao & Fedkiw 2004). Two cells share corners only if their flesh is connected.
Corner 4 x + 2 y + z of a cell is the one at (x, y, z) in {0, 1}^3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from faceanim.geometry.embedding import Embedding
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import UserError
from faceanim.kernels import voxels

CORNERS = np.array(list(product((0, 1), repeat=3)), dtype=np.int64)
"""Offsets of the eight corners, (8, 3)."""
MOST_CELLS = 2_000_000
"""Largest grid that is looked through; beyond that the tables would take gigabytes."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Cubes of one size.

    origin : (3,) [mm] of the grid   side : [mm]   index : (c, 3) place in the grid   corner : (c, 8) nodes
    points : (n, 3) [mm] nodes at rest, sorted by x, then y, then z
    """

    origin: Floats
    side: float
    index: Ints
    corner: Ints
    points: Floats

    @property
    def centres(self) -> Floats:
        """(c, 3) [mm]."""
        return np.asarray(self.origin + self.side * (self.index + 0.5))

    def weights(self, cell: Ints, points: Floats) -> Floats:
        """Return the trilinear weights (k, 8) of the corners of `cell` (k,) at `points` (k, 3), extrapolating outside."""
        at = (points - self.origin) / self.side - self.index[cell]
        at = np.where(np.abs(at - np.round(at)) < 1e-12, np.round(at), at)
        either = np.stack([1.0 - at, at], axis=1)
        return np.ascontiguousarray(
            either[:, CORNERS[:, 0], 0] * either[:, CORNERS[:, 1], 1] * either[:, CORNERS[:, 2], 2]
        )


@dataclass(frozen=True, eq=False)
class Overlap:
    """What part of which tetrahedron lies in which leaf: `cell`, `tet` (k,) and `volume` (k,) [mm^3]."""

    cell: Ints
    tet: Ints
    volume: Floats


@dataclass(frozen=True, eq=False)
class Octree:
    """Leaves and their parents: `levels[0]` the leaves, `levels[l]` cubes 2^l as long.

    ancestor : for every level (c,) the cell of that level that contains each leaf
    up : for every level but the last (n_l,) the node of the next level that is this node, -1 if none is
    fill : (c,) [-] filled share of each leaf   overlap : with the tetrahedra, None for a block or a surface
    """

    levels: tuple[Cells, ...]
    ancestor: tuple[Ints, ...]
    up: tuple[Ints, ...]
    fill: Floats
    overlap: Overlap | None = None

    @property
    def leaves(self) -> Cells:
        """The finest cells."""
        return self.levels[0]

    @cached_property
    def parts(self) -> Ints:
        """The connected part that each leaf belongs to, (c,), 0 the first; leaves are joined by shared corners."""
        return _components(self.leaves.corner)

    def locate(self, points: Floats) -> Ints:
        """Return the leaf that contains each of `points` (k, 3), else the nearest one, (k,)."""
        leaves = self.leaves
        at = np.floor((points - leaves.origin) / leaves.side - 1e-9).astype(np.int64)
        number = {tuple(place): cell for cell, place in reversed(list(enumerate(leaves.index.tolist())))}
        found = np.array([number.get(tuple(place), -1) for place in at.tolist()], dtype=np.int32)
        lost = np.flatnonzero(found < 0)
        if lost.size:
            found[lost] = _nearest(leaves, points[lost])
        return found

    def locate_in(self, mesh: TetMesh, skin: Embedding, points: Floats) -> Ints:
        """Return the leaf nearest to each of `points` (k, 3) among those with flesh at the point's heaviest node, (k,).

        skin : the points as carried by the nodes of `mesh`; so a point on the upper lip finds a cell of the upper lip.
        """
        if self.overlap is None:
            return self.locate(points)
        over = self.overlap
        e, n, c = len(mesh.tets), len(mesh.points), len(self.leaves.index)
        ones = np.ones(4 * e, dtype=np.int8)
        node_tet = sparse.csr_matrix((ones, (mesh.tets.ravel(), np.repeat(np.arange(e), 4))), shape=(n, e))
        tet_cell = sparse.csr_matrix((np.ones(len(over.tet), np.int8), (over.tet, over.cell)), shape=(e, c))
        heavy = skin.node[np.arange(len(points)), np.argmax(skin.weight, axis=1)]
        rows = (node_tet[heavy].astype(np.int32) @ tet_cell.astype(np.int32)).tocoo()
        away = np.abs(points[rows.row] - self.leaves.centres[rows.col]) - 0.5 * self.leaves.side
        distance = np.linalg.norm(np.maximum(away, 0.0), axis=1)
        order = np.lexsort((rows.col, np.round(distance / self.leaves.side, 9), rows.row))
        first = order[np.searchsorted(rows.row[order], np.arange(len(points)))]
        return np.asarray(rows.col[first], dtype=np.int32)


def block(cells: tuple[int, int, int], side: float, levels: int = 16, origin: Any = (0.0, 0.0, 0.0)) -> Octree:
    """Return a full block of cells[0] x cells[1] x cells[2] cubes of `side` [mm] with at most `levels` levels."""
    if min(cells) < 1 or not (np.isfinite(side) and side > 0):
        raise UserError(f"block: cells {cells} must be at least 1 and side = {side} mm positive")
    _guard(np.array(cells), side)
    index = np.stack(np.meshgrid(*(np.arange(c) for c in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    leaves, pairs = _glued(np.asarray(origin, dtype=np.float64), side, index)
    return _grown(leaves, pairs, np.ones(len(index)), levels)


def from_surface(surface: TriMesh, side: float, levels: int = 16, *, samples: int = 4) -> Octree:
    """Return the cubes of `side` [mm] that the closed `surface` fills, with at most `levels` levels.

    samples : points along each side of a cube at which the winding number tells inside from outside
    Raises `UserError` for a surface that is open, inside out or crosses itself, and for one of several parts.
    """
    reject_unsound(surface)
    low, shape = _grid(surface.points, side)
    index = np.stack(np.meshgrid(*(np.arange(c) for c in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    offset = (np.stack(np.meshgrid(*[np.arange(samples)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) / samples
    fill = np.zeros(len(index))
    voxels.fill_by_winding(surface.points, surface.triangles, low, side, index, offset, fill)
    kept = fill > 0
    if not kept.any():
        raise UserError(f"cell side {side:g} mm is too large for the surface: no cell has flesh at a sample; lower it")
    tree = _grown(*_glued(low, side, index[kept]), fill[kept], levels)
    if tree.parts.max() > 0:
        count = int(tree.parts.max()) + 1
        raise UserError(f"the surface fills {count} parts that are not connected; pass one part at a time")
    return tree


def from_tets(mesh: TetMesh, side: float, levels: int = 16) -> Octree:
    """Return the cubes of `side` [mm] that `mesh` fills, one cell for every connected piece, at most `levels` levels."""
    low, shape = _grid(mesh.points, side)
    corner = mesh.points[mesh.tets]
    first = np.clip(np.floor((corner.min(axis=1) - low) / side + 1e-9), 0, shape - 1).astype(np.int64)
    last = np.clip(np.ceil((corner.max(axis=1) - low) / side - 1e-9) - 1, first, shape - 1).astype(np.int64)
    count = int((last - first + 1).prod(axis=1).sum())
    if count > 20 * MOST_CELLS:
        raise UserError(f"cell side {side:g} mm is too small: {count} cubes meet the volume's elements; raise it")
    tet, place = np.zeros(count, dtype=np.int32), np.zeros((count, 3), dtype=np.int64)
    volume, touch = np.zeros(count), np.zeros((count, 14), dtype=np.bool_)
    voxels.cut_tets(corner, first, last, low, side, tet, place, volume, touch)
    kept = (volume > 1e-9 * side**3) | (volume > 0.5 * mesh.volumes[tet])  # crumbs make no cell of their own
    tet, place, volume, touch = tet[kept], place[kept], volume[kept], touch[kept]
    volume *= (mesh.volumes / np.bincount(tet, volume, len(mesh.tets)))[tet]
    cell, index, pairs = _pieces(mesh, tet, place, touch, shape)
    fill = np.bincount(cell, volume, len(index)) / side**3
    return _grown(_joined(low, side, index, pairs), pairs, fill, levels, Overlap(cell, tet, volume))


def reject_unsound(surface: TriMesh) -> None:
    """Raise `UserError` unless `surface` is closed, turned outward and free of self-intersections."""
    t = surface.triangles
    if not len(t):
        raise UserError("the surface has no triangles")
    n = len(surface.points)
    ahead = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]]).astype(np.int64)
    key, back = ahead[:, 0] * n + ahead[:, 1], ahead[:, 1] * n + ahead[:, 0]
    open_edges = np.flatnonzero(~np.isin(key, back))
    if open_edges.size:
        a, b = ahead[open_edges[0]]
        raise UserError(
            f"the surface is open: edge {a}-{b} has a triangle on one side only, {open_edges.size} edges do; "
            "close its holes"
        )
    if len(np.unique(key)) < len(key):
        raise UserError("the surface is not a clean boundary: an edge is used twice in one direction; weld or split it")
    corner = surface.points[t]
    volume = float(np.linalg.det(corner).sum()) / 6.0
    if volume <= 0:
        raise UserError(f"the surface is inside out (signed volume {volume:.3g} mm^3); turn its triangles round")
    pair = np.zeros(2, dtype=np.int64)
    if voxels.first_crossing(np.ascontiguousarray(corner), t, pair):
        raise UserError(
            f"the surface crosses itself: triangles {pair[0]} and {pair[1]} cut each other; repair it or pass "
            "tetrahedra, which may touch without being joined"
        )


def _grid(points: Floats, side: float) -> tuple[Floats, Floats]:
    if not (np.isfinite(side) and side > 0):
        raise UserError(f"cell side = {side} mm must be positive and finite")
    low, high = points.min(axis=0), points.max(axis=0)
    if side > (high - low).max() * (1 + 1e-9):
        raise UserError(f"cell side {side:g} mm is larger than the body ({(high - low).max():g} mm); lower it")
    shape = np.maximum(np.ceil((high - low) / side - 1e-6), 1).astype(np.int64)
    _guard(shape, side)
    return low - 0.5 * (shape * side - (high - low)), shape


def _guard(shape: Any, side: float) -> None:
    count = int(np.prod(np.asarray(shape, dtype=np.float64)))
    if count > MOST_CELLS:
        raise UserError(f"cell side {side:g} mm is too small: {count} cells, at most {MOST_CELLS}; raise it")


def _components(member: Ints) -> Ints:
    """Return the component of each row of `member` (c, k); rows with an equal entry are joined."""
    c, k = member.shape
    n = int(member.max()) + 1
    rows = np.repeat(np.arange(c), k)
    graph = sparse.coo_matrix((np.ones(c * k, np.int8), (rows, c + member.ravel())), shape=(c + n, c + n))
    _, label = connected_components(graph, directed=False)
    _, part = np.unique(label[:c], return_inverse=True)
    return part.astype(np.int32)


def _numbered(origin: Floats, side: float, index: Any, label: Any) -> Cells:
    """Return cells whose corners (c, 8) with equal `label` are one node."""
    place = (index[:, None, :] + CORNERS).reshape(-1, 3)
    _, first, which = np.unique(label.ravel(), return_index=True, return_inverse=True)
    spot = place[first]
    order = np.lexsort((first, spot[:, 2], spot[:, 1], spot[:, 0]))
    number = np.empty(len(order), dtype=np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    corner = np.ascontiguousarray(number[which].reshape(-1, 8))
    return Cells(origin, side, index.astype(np.int32), corner, origin + side * spot[order])


def _glued(origin: Floats, side: float, index: Any) -> tuple[Cells, Any]:
    """Return cells in which all corners at one place are one node, and all pairs of cells (p, 2) that share some."""
    place = (index[:, None, :] + CORNERS).reshape(-1, 3)
    _, label = np.unique(place, axis=0, return_inverse=True)
    cells = _numbered(origin, side, index, label.reshape(-1, 8))
    rows = np.repeat(np.arange(len(index)), 8)
    ones = np.ones(len(rows), dtype=np.int8)
    member = sparse.csr_matrix((ones, (rows, cells.corner.ravel())), shape=(len(index), len(cells.points)))
    pairs = sparse.triu(member @ member.T, 1).tocoo()
    return cells, np.stack([pairs.row, pairs.col], axis=1).astype(np.int64)


def _joined(origin: Floats, side: float, index: Any, pairs: Any) -> Cells:
    """Return cells that share the common corners of every pair of neighbours in `pairs` (p, 2)."""
    c = len(index)
    a, b = pairs[:, 0], pairs[:, 1]
    at = index[a][:, None, :] + CORNERS - index[b][:, None, :]
    common = ((at >= 0) & (at <= 1)).all(axis=2)
    mine = (8 * a[:, None] + np.arange(8))[common]
    other = (8 * b[:, None] + at @ np.array([4, 2, 1]))[common]
    graph = sparse.coo_matrix((np.ones(len(mine), np.int8), (mine, other)), shape=(8 * c, 8 * c))
    _, label = connected_components(graph, directed=False)
    return _numbered(origin, side, index, label.reshape(-1, 8))


def _pieces(mesh: TetMesh, tet: Ints, place: Any, touch: Any, shape: Any) -> tuple[Ints, Any, Any]:
    """Return the cell of each overlap, the grid place of each cell, and the pairs of cells whose flesh is connected.

    Elements in one cube are connected if a corner, edge or face of theirs that touches the cube is common.
    """
    entity = _entities(mesh)[tet]
    cube = (place[:, 0] * shape[1] + place[:, 1]) * shape[2] + place[:, 2]
    row, column = np.nonzero(touch)
    _, in_cube = np.unique(np.stack([cube[row], entity[row, column]], axis=1), axis=0, return_inverse=True)
    k, m = len(tet), int(in_cube.max()) + 1
    graph = sparse.coo_matrix((np.ones(len(row), np.int8), (row, k + in_cube.ravel())), shape=(k + m, k + m))
    _, label = connected_components(graph, directed=False)
    order = np.lexsort((label[:k], cube))
    starts = np.r_[True, (np.diff(cube[order]) != 0) | (np.diff(label[:k][order]) != 0)]
    cell = np.empty(k, dtype=np.int32)
    cell[order] = np.cumsum(starts) - 1
    index = place[order[starts]]
    c = len(index)
    whole = int(entity.max()) + 1  # an element that reaches into two cubes connects them, as a common corner does
    things = sparse.csr_matrix(
        (
            np.ones(len(row) + k, np.int32),
            (np.r_[cell[row], cell], np.r_[entity[row, column], whole + tet]),
        ),
        shape=(c, whole + len(mesh.tets)),
    )
    pairs = sparse.triu(things @ things.T, 1).tocoo()
    near = np.abs(index[pairs.row] - index[pairs.col]).max(axis=1) == 1
    return cell, index, np.stack([pairs.row[near], pairs.col[near]], axis=1).astype(np.int64)


def _entities(mesh: TetMesh) -> Any:
    """Return the numbers of the 4 corners, 6 edges and 4 faces of every element, (e, 14), distinct over all kinds."""
    columns, start = [mesh.tets.astype(np.int64)], len(mesh.points)
    for group in (voxels.EDGES, voxels.FACES):
        nodes = np.sort(mesh.tets[:, group].astype(np.int64), axis=2)
        _, number = np.unique(nodes.reshape(-1, nodes.shape[2]), axis=0, return_inverse=True)
        columns.append(start + number.reshape(len(mesh.tets), -1))
        start += int(number.max()) + 1
    return np.concatenate(columns, axis=1)


def _grown(leaves: Cells, pairs: Any, fill: Floats, most: int, overlap: Overlap | None = None) -> Octree:
    """Return the tree over `leaves`: parents until one cube holds all, at most `most` levels in all.

    pairs : (p, 2) neighbouring leaves whose flesh is connected
    """
    if most < 1:
        raise UserError(f"levels = {most} must be at least 1")
    levels, ancestor = [leaves], [np.arange(len(leaves.index), dtype=np.int32)]
    up: list[Ints] = []
    while len(levels) < most and np.ptp(levels[-1].index, axis=0).max() > 0:
        coarse, pairs, parent, same = _parents(levels[-1], pairs)
        levels.append(coarse)
        ancestor.append(parent[ancestor[-1]])
        up.append(same)
    return Octree(tuple(levels), tuple(ancestor), tuple(up), fill, overlap)


def _parents(cells: Cells, pairs: Any) -> tuple[Cells, Any, Ints, Ints]:
    """Return the next coarser cells and their connected pairs, every cell's parent, and the coarse node of each node.

    Children are one parent's if they are connected inside its cube, not merely around it.
    """
    place, count = cells.index // 2, len(cells.index)
    inner = (place[pairs[:, 0]] == place[pairs[:, 1]]).all(axis=1)
    ones = np.ones(int(inner.sum()), np.int8)
    graph = sparse.coo_matrix((ones, tuple(pairs[inner].T)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    _, first, which = np.unique(label, return_index=True, return_inverse=True)
    parent = which.astype(np.int32).ravel()
    between = np.unique(np.sort(parent[pairs[~inner]], axis=1), axis=0).astype(np.int64)
    coarse = _joined(cells.origin, 2.0 * cells.side, place[first].astype(np.int64), between)
    same = np.full(len(cells.points), -1, dtype=np.int32)
    octant = (cells.index % 2) @ np.array([4, 2, 1])
    same[cells.corner[np.arange(count), octant]] = coarse.corner[parent, octant]
    return coarse, between, parent, same


def _nearest(cells: Cells, points: Floats) -> Ints:
    """Return the cell whose cube is nearest to each of `points`; the nearest centre may mislead, so 8 are tried."""
    centres = cells.centres
    _, near = cKDTree(centres).query(points, k=min(8, len(centres)))
    near = near.reshape(len(points), -1)
    away = np.abs(points[:, None] - centres[near]) - 0.5 * cells.side
    best = np.argmin(np.linalg.norm(np.maximum(away, 0.0), axis=2), axis=1)
    return np.asarray(near[np.arange(len(points)), best], dtype=np.int32)
