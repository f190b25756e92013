"""Flesh against flesh: two sheets of the surface that nodes carry (lip on lip, lid on lid) keep a gap, by a penalty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from scipy import sparse

from faceanim.elements.contact import RIM, Tangled
from faceanim.geometry.embedding import Embedding
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Floats, Ints, frozen, ints
from faceanim.ground.errors import UserError
from faceanim.kernels import sheet_contact as kernels


class SheetPair(Protocol):
    """Vertices `node` (c,) that stay `gap` [mm] before the triangles `triangle[start[k]:start[k + 1]]` of the other side."""

    @property
    def node(self) -> Ints: ...

    @property
    def start(self) -> Ints: ...

    @property
    def triangle(self) -> Ints: ...

    @property
    def gap(self) -> float: ...


class SheetTable(NamedTuple):
    """All pairs of sheets as the kernels read them.

    corners : (t, 3)   pair_node : (c,)   pair_start : (c + 1,)   pair_triangle : candidates   pair_gap : (c,) [mm]
    """

    corners: Ints
    pair_node: Ints
    pair_start: Ints
    pair_triangle: Ints
    pair_gap: Floats


class SheetTouch(NamedTuple):
    """How sheets touch: the deepest intrusion into the gap and through the other side [mm], how many vertices.

    pressed : [mN] sum of the sizes of the forces between the sheets
    """

    deepest: float
    through: float
    active: int
    pressed: float


def sheet_table(surface: TriMesh, pairs: Sequence[SheetPair]) -> SheetTable:
    """Return the table of `pairs` over the vertices and triangles of `surface`, with the triangles that they use alone."""
    n, t = len(surface.points), len(surface.triangles)
    node = np.concatenate([np.zeros(0, np.int32), *(ints("pair.node", p.node, None, below=n) for p in pairs)])
    chosen = np.concatenate([np.zeros(0, np.int32), *(ints("pair.triangle", p.triangle, None, below=t) for p in pairs)])
    starts, done = [np.zeros(1, dtype=np.int32)], 0
    for p in pairs:
        if len(p.start) != len(p.node) + 1 or p.start[0] != 0 or p.start[-1] != len(p.triangle):
            raise UserError("a pair of sheets: start must run from 0 to the number of triangles, one step a vertex")
        starts.append((p.start[1:] + done).astype(np.int32))
        done += len(p.triangle)
    used, index = np.unique(chosen, return_inverse=True)
    gap = np.concatenate([np.zeros(0), *(np.full(len(p.node), float(p.gap)) for p in pairs)])
    tables = (surface.triangles[used].reshape(-1, 3), node, np.concatenate(starts), index.ravel().astype(np.int32), gap)
    return SheetTable(*(frozen(np.ascontiguousarray(table)) for table in tables))


def coupled(surface: TriMesh, pairs: Sequence[SheetPair], skin: Embedding, reach: float = np.inf) -> Ints:
    """Return the pairs of nodes, (k, 2), that the sheets' tangent couples: pass them to `Elements(coupled=)`.

    reach : [mm] leave out candidates farther apart than that at rest; what the pattern lacks later is made up for on
    the diagonal, at the price of more steps
    """
    table = sheet_table(surface, pairs)
    n = int(skin.node.max()) + 1 if skin.node.size else 0
    carriers = skin.matrix(n) != 0
    owner = np.repeat(np.arange(len(table.pair_node)), np.diff(table.pair_start))
    middle = surface.points[table.corners].mean(axis=1)
    radius = np.linalg.norm(surface.points[table.corners] - middle[:, None], axis=2).max(axis=1)
    apart = np.linalg.norm(surface.points[table.pair_node[owner]] - middle[table.pair_triangle], axis=1)
    near = apart - radius[table.pair_triangle] <= reach
    met = (owner[near], table.pair_triangle[near])
    meets = sparse.csr_matrix((np.ones(near.sum()), met), shape=(len(table.pair_node), len(table.corners)))
    triangle = sum(
        (carriers[table.corners[:, k]].astype(float) for k in range(3)), sparse.csr_matrix((len(table.corners), n))
    )
    vertex = carriers[table.pair_node].astype(float)
    used = triangle[np.unique(table.pair_triangle[near])]
    both = vertex.T @ (meets @ triangle) + used.T @ used + vertex.T @ vertex
    return np.stack(both.nonzero(), axis=1).astype(np.int32)


class Found(NamedTuple):
    """Contacts as affine functions of the vertices, c of them.

    row : (c,) of the table   vertex : (c, 4), the vertex, then the corners   share : (c, 4) [-], 1 and minus the weights
    normal : (c, 3)   offset : (c,) [mm]; depth = offset - normal . sum_a share_a x_a
    """

    row: Ints
    vertex: Ints
    share: Floats
    normal: Floats
    offset: Floats


class SheetPenalty:
    """The energy k A p^2 / 2 of every vertex that is p nearer to the other sheet than the gap: a `newton.Term`.

    Action is reaction: what pushes the vertex pushes the triangle's corners back by the nearest point's weights. Live,
    the force is the exact derivative of the energy, but that of a distance to flat triangles has kinks over concave
    edges, and equilibria like to lie in them. Frozen (`freeze`), the nearest points and normals found at some
    positions are kept, so that every depth is affine, the energy convex and the tangent k A j j^T exact: so a search
    converges, and it is repeated with what is nearest then (`contact.settle`).
    Where the pattern has no room for a pair of nodes, the size of its block goes to both diagonals, which keeps the
    tangent an upper bound, never negative: more steps, the same balance. See `coupled`.
    """

    def __init__(
        self,
        elements: Tangled,
        surface: TriMesh,
        skin: Embedding,
        pairs: Sequence[SheetPair],
        stiffness: float,
    ) -> None:
        """Compile the tables; a vertex that is nearer than its gap at rest keeps the distance that it has there.

        stiffness : [mN/mm^3], pressure per depth; about 50 E / edge length keeps sheets from going through each other
        Raises `UserError` for a stiffness that is not positive and for a skin that does not carry the surface.
        """
        if not (np.isfinite(stiffness) and stiffness > 0.0):
            raise UserError(f"sheet contact: stiffness = {stiffness} mN/mm^3 must be positive and finite")
        if len(skin.node) != len(surface.points):
            raise UserError(
                f"sheet contact: {len(skin.node)} carried points; {len(surface.points)} vertices are needed"
            )
        self.elements, self.skin = elements, skin
        self.table = sheet_table(surface, pairs)
        self.weight = stiffness * surface.vertex_areas[self.table.pair_node]
        self._matrix = skin.matrix(len(elements.points))
        self._spread = self._matrix.T.tocsr()
        c, t, n = len(self.table.pair_node), len(self.table.corners), len(surface.points)
        self._ball, self._looks = np.zeros((t, 4)), np.zeros((n, 3))
        self._depth, self._corner = np.zeros(c), np.zeros((c, 3), dtype=np.int32)
        self._share, self._normal = np.zeros((c, 3)), np.zeros((c, 3))
        self._frozen: Found | None = None
        at_rest = self.found(elements.points)
        gap = self.table.pair_gap.copy()
        gap[at_rest.row] -= self._depth[at_rest.row]
        self.table = self.table._replace(pair_gap=frozen(gap))
        pattern = elements.node_pattern
        row = np.repeat(np.arange(pattern.shape[0], dtype=np.int64), np.diff(pattern.indptr))
        self._known = np.sort(row * pattern.shape[0] + pattern.indices)

    def place(self, x: Floats) -> Floats:
        """Return where the surface is when the nodes are at `x` (n, 3), (n_surface, 3) [mm]."""
        return np.asarray(self._matrix @ x)

    def found(self, x: Floats, reach: float = 0.0) -> Found:
        """Return the contacts at node positions `x` (n, 3) of vertices less than `reach` [mm] before the gap."""
        place = np.ascontiguousarray(self.place(x))
        kernels.sheet_depths(
            place, self.table, self._ball, self._looks, self._depth, self._corner, self._share, self._normal
        )
        row = np.flatnonzero(self._depth > -reach).astype(np.int32)
        vertex = np.concatenate([self.table.pair_node[row, None], self._corner[row]], axis=1)
        share = np.concatenate([np.ones((len(row), 1)), -self._share[row]], axis=1)
        normal = self._normal[row]
        return Found(row, vertex, share, normal, self._depth[row] + _heights(place, vertex, share, normal))

    def freeze(self, x: Floats, reach: float = 2.0) -> None:
        """Keep the contacts found at `x` (n, 3), those less than `reach` [mm] before the gap, until the next call."""
        self._frozen = self.found(x, reach)

    def thaw(self) -> None:
        """Find the contacts anew at all positions."""
        self._frozen = None

    def _depths(self, x: Floats) -> tuple[Found, Floats]:
        """Return the contacts that count at `x` and how deep they are, (c,) [mm], zero where they do not touch."""
        found = self.found(x) if self._frozen is None else self._frozen
        depth = found.offset - _heights(self.place(x), found.vertex, found.share, found.normal)
        return found, np.maximum(depth, 0.0)

    def energy(self, x: Floats) -> float:
        """Return the energy [uJ]."""
        found, deep = self._depths(x)
        return float(0.5 * (self.weight[found.row] * deep) @ deep)

    def forces(self, x: Floats) -> Floats:
        """Return minus its gradient, (n, 3) [mN]."""
        found, deep = self._depths(x)
        push = (self.weight[found.row] * deep)[:, None] * found.normal
        out = np.zeros((len(self.skin.node), 3))
        np.add.at(out, found.vertex, found.share[:, :, None] * push[:, None])
        return np.asarray(self._spread @ out)

    def add_tangent(self, x: Floats, values: Floats) -> None:
        """Add k A j j^T of the vertices that touch, j the derivative of the depth by the nodes."""
        found, deep = self._depths(x)
        on = np.flatnonzero(deep > 0.0)
        if not len(on):
            return
        node = self.skin.node[found.vertex[on]].reshape(len(on), -1)
        part = (found.share[on, :, None] * self.skin.weight[found.vertex[on]]).reshape(len(on), -1)
        normal = found.normal[on]
        block = self.weight[found.row[on], None, None] * normal[:, :, None] * normal[:, None, :]
        product = part[:, :, None] * part[:, None, :]
        row, a, b = np.nonzero(product)
        self._place(values, node[row, a], node[row, b], product[row, a, b], block[row])

    def _place(self, values: Floats, i: Ints, j: Ints, size: Floats, block: Floats) -> None:
        """Add `size` (k,) times `block` (k, 3, 3) at the node pairs (i, j), or its size on the diagonal where none is."""
        key = i.astype(np.int64) * len(self.elements.points) + j
        at = np.minimum(np.searchsorted(self._known, key), len(self._known) - 1)
        room = self._known[at] == key
        # each missing pair comes twice, as (i, j) and (j, i): once for either diagonal
        column, size = np.where(room, j, i).astype(np.int32), np.where(room, size, np.abs(size))
        entry = self.elements.entries(i, column).reshape(-1)
        values += np.bincount(entry, (size[:, None, None] * block).ravel(), len(values))

    def report(self, x: Floats) -> SheetTouch:
        """Return how the sheets touch at `x`, by what is nearest there."""
        found = self.found(x)
        depth = found.offset - _heights(self.place(x), found.vertex, found.share, found.normal)
        through = float((depth - self.table.pair_gap[found.row]).max(initial=0.0))
        pressed = float((self.weight[found.row] * depth).sum())
        return SheetTouch(float(depth.max(initial=0.0)), max(through, 0.0), int((depth > RIM).sum()), pressed)


def _heights(place: Floats, vertex: Ints, share: Floats, normal: Floats) -> Floats:
    """Return how far before the other sheet's points the vertices are, along the normals, (c,) [mm]."""
    return np.asarray(np.einsum("ca,cai,ci->c", share, place[vertex], normal))


def opposed(surface: TriMesh, one: Ints, other: Ints, *, gap: float, name: str = "sheets") -> NamedSheets:
    """Return the pair of the sheets whose triangles have all corners in `one` or in `other`, (k,) vertices each, both ways.

    gap : [mm] that is kept
    """
    n = len(surface.points)
    if not (np.isfinite(gap) and gap >= 0.0):
        raise UserError(f"{name}: gap = {gap} mm must be finite and not negative")
    sides = [ints(label, side, None, below=n) for label, side in (("one", one), ("other", other))]
    sheets = [np.flatnonzero(np.isin(surface.triangles, side).all(axis=1)).astype(np.int32) for side in sides]
    if np.intersect1d(sides[0], sides[1]).size or not all(len(sheet) for sheet in sheets):
        raise UserError(f"{name}: the sheets need separate vertices and at least one triangle each")
    node = np.concatenate(sides)
    facing = [sheets[1]] * len(sides[0]) + [sheets[0]] * len(sides[1])
    start = np.cumsum([0, *(len(f) for f in facing)]).astype(np.int32)
    return NamedSheets(name, node, start, np.concatenate(facing), float(gap))


class NamedSheets(NamedTuple):
    """A pair of sheets, see `SheetPair`."""

    name: str
    node: Ints
    start: Ints
    triangle: Ints
    gap: float
