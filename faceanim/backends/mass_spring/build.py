"""From a body to the tables of the mass-spring kernels, for all vertices or for a part of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from faceanim.body.body import Body
from faceanim.geometry import topology
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import UserError
from faceanim.kernels import contact
from faceanim.kernels.tables import BoneGrids, Colliders, Fibres, Half, Law, Layer, Planes, Scene, Springs, Tethers

STIFFENING = 0.2
"""Depth at which the stiffness of a contact has grown fourfold [mm]."""


@dataclass(frozen=True, eq=False)
class Patch:
    """A part of a body in its own numbering: the free vertices first, then the ring that only acts on them.

    nodes : (n,) body vertex of each   m : how many are free   held : (n,) those carried by the bones
    mass : (n,) [kg]   edge_of : (3, t) edge opposite each corner   pairs : (e, 2) vertices of each edge, smaller first;
    the first `n_pair` edges join free vertices   shear : (e, 2) of the layer beneath [mN/mm] and its growth [mN/mm^3]
    scene : kernel tables   muscles : how many the body has   half : what is mirrored
    """

    nodes: Ints
    m: int
    held: Bools
    mass: Floats
    edge_of: Ints
    pairs: Ints
    n_pair: int
    shear: Floats
    scene: Scene
    muscles: int
    half: Half


FACING = -0.2
"""Cosine of the angle between the normals of a vertex and a triangle above which they cannot meet."""
RINGS = 3
"""A vertex does not meet triangles within so many edges of it: there the two sides are one sheet."""

BEHIND = 0.3
"""A vertex is behind a triangle at rest if this share of its distance, or more, is behind the triangle's plane."""
TOUCHING = 0.1
"""Vertices nearer than this [mm] at rest touch, whatever side rounding puts them on."""


class Tables:
    """Everything about a body that does not depend on which vertices are free.

    Springs carry their triangle's share: an edge gets Y * area / d^2 from each of its triangles (Van Gelder), or
    uniform_k0 in all; a repulsion spring gets height_ratio times what an edge would get in an
    equilateral mesh of that height, 2 Y * area / (4/3 h^2): a sliver's long height must not be as stiff as its short side.
    """

    def __init__(self, body: Body) -> None:
        self.body = body
        law = body.law
        self.law = Law(float(law.alpha), float(law.s0), float(law.beta), int(law.reaction))
        self.edges, self.edge_of = topology.edge_of_corner(body.surface.triangles)
        self._springs()
        self._shear_layer()
        self.grids = bone_grids(body)
        self._rest_gaps()

    def _springs(self) -> None:
        body, law = self.body, self.body.law
        points, triangles = body.surface.points, body.surface.triangles
        length = np.linalg.norm(points[self.edges[:, 1]] - points[self.edges[:, 0]], axis=1)
        self.edge_length = length[self.edge_of]
        count = np.bincount(self.edge_of.ravel(), minlength=len(self.edges))
        if law.uniform_k0 is None:
            self.edge_share = (body.membrane_modulus * body.surface.areas)[:, None] / self.edge_length**2
        else:
            self.edge_share = law.uniform_k0 / count[self.edge_of]
        self.height = body.surface.heights
        if law.uniform_k0 is None:
            like_edge = 1.5 * (body.membrane_modulus * body.surface.areas)[:, None] / self.height**2
        else:
            like_edge = np.full_like(self.height, law.uniform_k0)
        self.height_stiffness = law.height_ratio * like_edge
        self.repulsion = law.zeta * self.height_stiffness * self.height
        self.triangles = triangles

    def _shear_layer(self) -> None:
        """Compute what the shear layer adds to each edge: stiffness w [mN/mm] and growth w / (limit length)^2.

        `layer_share` (t, 3), `layer_growth` (t, 3) by triangle, `shear` (e, 2) in all.
        Cotangent weights, none negative: they sum to the integral of |grad u|^2.
        """
        body = self.body
        self.shear: Floats = np.zeros((len(self.edges), 2))
        self.layer_share, self.layer_growth = np.zeros((2, *self.edge_of.shape))
        if body.attachment.shear is None:
            return
        corner = body.surface.points[body.surface.triangles]
        left, right = np.roll(corner, -1, axis=1) - corner, np.roll(corner, -2, axis=1) - corner
        cotangent = (left * right).sum(axis=2) / (2.0 * body.surface.areas[:, None])
        self.layer_share = 0.5 * body.attachment.shear[:, None] * np.clip(cotangent, 0.0, 10.0)
        if body.attachment.shear_limit is not None:
            self.layer_growth = self.layer_share / (body.attachment.shear_limit[:, None] * self.edge_length) ** 2
        for k, share in enumerate((self.layer_share, self.layer_growth)):
            np.add.at(self.shear[:, k], self.edge_of.ravel(), share.ravel())

    def _local_shear(self, local: Ints, n: int) -> tuple[Ints, Ints, Floats, Floats]:
        """Return start, neighbour, stiffness and growth of the shear layer's ties between the `n` vertices of a patch."""
        keep = (local[self.edges] >= 0).all(axis=1) & (self.shear[:, 0] > 0.0)
        pairs, shear = local[self.edges[keep]], self.shear[keep]
        lists = topology.grouped(pairs.T.ravel(), np.arange(2 * len(pairs), dtype=np.int32), n)
        other = pairs[:, ::-1].T.ravel()[lists.item]
        stiffness, growth = np.ascontiguousarray(np.tile(shear.T, 2)[:, lists.item])
        return lists.start, np.ascontiguousarray(other, dtype=np.int32), stiffness, growth

    def _rest_gaps(self) -> None:
        """Shrink each clearance to the gap at rest, so that a body at rest feels no contact."""
        body, x = self.body, self.body.surface.points
        area = body.surface.vertex_areas
        node, bone, clear = _bone_pairs(body)
        clear = clear.copy()
        for b, one in enumerate(body.bones):
            mine = bone == b
            if one.grid is not None and mine.any():
                clear[mine] = np.minimum(clear[mine], one.grid.sample(x[node[mine]]))
        ball_node, ball, ball_clear = _sphere_pairs(body)
        hard = np.repeat([s.hardness for s in body.spheres], [len(s.node) for s in body.spheres])
        gap = np.linalg.norm(x[ball_node] - ball[:, :3], axis=1) - ball[:, 3]
        ball = np.concatenate([ball[:, :3], (ball[:, 3] + np.minimum(ball_clear, gap))[:, None]], axis=1)
        pair_node, pair_start, pair_triangle, pair_gap = _pair_lists(body)
        self.colliders = Colliders(
            node, bone, clear, area[node], ball_node, np.ascontiguousarray(ball), area[ball_node] * hard,
            pair_node, pair_start, pair_triangle, pair_gap, area[pair_node],
            self.triangles, float(body.contact_stiffness), STIFFENING,
        )  # fmt: skip
        at_rest = np.zeros(len(pair_node))
        contact.pair_gaps(x, self.colliders, np.zeros((len(self.triangles), 4)), np.zeros_like(x), at_rest)
        np.minimum(pair_gap, at_rest, out=pair_gap)

    def patch(self, free: Ints, mirror: Ints | None = None) -> Patch:
        """Return the tables with the vertices `free` (in that order) free and their neighbourhood as the ring.

        With `mirror` (n,), the image of each vertex, `free` is one half of what moves and the other half follows.
        """
        n = len(self.body.surface.points)
        is_free = np.zeros(n, dtype=bool)
        is_free[free] = True
        used = is_free[self.triangles].any(axis=1)
        rows = self._pair_rows(is_free)
        c = self.colliders
        touched = np.concatenate([np.arange(c.pair_start[r], c.pair_start[r + 1]) for r in rows] or [np.zeros(0, int)])
        candidates = c.pair_triangle[touched]
        around = np.unique(
            np.concatenate([self.triangles[used].ravel(), self.triangles[candidates].ravel(), c.pair_node[rows]])
        )
        nodes = np.concatenate([free, around[~is_free[around]]]).astype(np.int32)
        local = np.full(n, -1, dtype=np.int32)
        local[nodes] = np.arange(len(nodes), dtype=np.int32)
        springs, layer, edge_of, pairs, n_pair = self._local_springs(
            np.flatnonzero(used).astype(np.int32), local, len(nodes), len(free)
        )
        body = self.body
        tethers = Tethers(
            body.surface.points[nodes], np.ascontiguousarray(body.attachment.bone_weight[nodes]),
            body.attachment.stiffness[nodes], float(body.attachment.alpha), float(body.attachment.s0),
            *self._local_shear(local, len(nodes)),
        )  # fmt: skip
        fibres = _local_fibres(body, local, len(free), len(nodes))
        colliders = self._local_colliders(is_free, local, rows, touched)
        scene = Scene(len(free), springs, layer, self.law, tethers, fibres, colliders, self.grids)
        shear = self.shear[_rows_of(self.edges, nodes[pairs])]
        return Patch(
            nodes, len(free), body.pinned[nodes], body.mass[nodes], edge_of, pairs, n_pair, shear, scene,
            len(body.muscles.names), _half(nodes, len(free), local, mirror),
        )  # fmt: skip

    def _pair_rows(self, is_free: Bools) -> Ints:
        """Return the pair contacts in which a free vertex takes part."""
        c = self.colliders
        if not len(c.pair_node):
            return np.zeros(0, dtype=np.int32)
        any_free = np.concatenate([[0], np.cumsum(np.asarray(is_free[self.triangles].any(axis=1))[c.pair_triangle])])
        acts = any_free[c.pair_start[1:]] > any_free[c.pair_start[:-1]]
        return np.flatnonzero(is_free[c.pair_node] | acts).astype(np.int32)

    def _local_springs(self, used: Ints, local: Ints, n: int, m: int) -> tuple[Springs, Layer, Ints, Ints, int]:
        corners = local[self.triangles[used]]
        a, b, c = (np.ascontiguousarray(corners[:, k]) for k in range(3))
        slots = np.arange(3 * len(used), dtype=np.int32)
        lists = topology.grouped(corners.T.ravel(), slots, n)

        def table(rows: Floats) -> Floats:
            return np.ascontiguousarray(rows[used].T)

        springs = Springs(
            a, b, c, table(self.edge_length), table(self.edge_share), table(self.height),
            table(self.height_stiffness), table(self.repulsion), lists.start, lists.item,
        )  # fmt: skip
        pairs, edge_of = topology.edge_of_corner(corners)
        inner = (pairs < m).all(axis=1)
        order = np.concatenate([np.flatnonzero(inner), np.flatnonzero(~inner)])
        place = np.empty(len(order), dtype=np.int32)
        place[order] = np.arange(len(order), dtype=np.int32)
        layer = Layer(table(self.layer_share), table(self.layer_growth))
        return (
            springs,
            layer,
            np.ascontiguousarray(place[edge_of].T),
            np.ascontiguousarray(pairs[order]),
            int(inner.sum()),
        )

    def _local_colliders(self, is_free: Bools, local: Ints, rows: Ints, touched: Ints) -> Colliders:
        c = self.colliders
        bone = is_free[c.bone_node]
        ball = is_free[c.sphere_node]
        start = np.zeros(len(rows) + 1, dtype=np.int32)
        np.cumsum(c.pair_start[rows + 1] - c.pair_start[rows], out=start[1:])
        triangles, which = np.unique(c.pair_triangle[touched], return_inverse=True)
        return Colliders(
            local[c.bone_node[bone]], c.bone[bone], c.bone_clearance[bone], c.bone_area[bone],
            local[c.sphere_node[ball]], np.ascontiguousarray(c.sphere[ball]), c.sphere_area[ball],
            local[c.pair_node[rows]], start, which.astype(np.int32), c.pair_gap[rows], c.pair_area[rows],
            np.ascontiguousarray(local[self.triangles[triangles]]), c.pressure, c.stiffening,
        )  # fmt: skip


def _half(nodes: Ints, m: int, local: Ints, mirror: Ints | None) -> Half:
    """Return which of `nodes` mirror which of the first `m` of them."""
    if mirror is None:
        none = np.zeros(0, dtype=np.int32)
        return Half(none, none, none, np.ones((m, 3)))
    image = local[mirror[nodes]]
    ghost = (m + np.flatnonzero((image[m:] >= 0) & (image[m:] < m))).astype(np.int32)
    middle = np.flatnonzero(mirror[nodes[:m]] == nodes[:m]).astype(np.int32)
    copies = np.full((m, 3), 2.0)
    copies[middle] = 1.0
    return Half(ghost, np.ascontiguousarray(image[ghost], dtype=np.int32), middle, copies)


def _rows_of(edges: Ints, pairs: Ints) -> Ints:
    """Return the row of each of `pairs` (k, 2) in the sorted list `edges` (e, 2)."""
    span = int(edges.max(initial=0)) + 1
    key = np.sort(pairs, axis=1).astype(np.int64)
    rows = np.searchsorted(edges[:, 0].astype(np.int64) * span + edges[:, 1], key[:, 0] * span + key[:, 1])
    return rows.astype(np.int32)


def room_for_planes(colliders: Colliders, n: int) -> Planes:
    """Return empty planes with room for every contact of `colliders` at once, among `n` vertices."""
    pairs = len(colliders.pair_node)
    size = max(1, len(colliders.bone_node) + len(colliders.sphere_node) + pairs)
    return Planes(
        np.zeros(2, dtype=np.int32), np.full((size, 4), -1, dtype=np.int32), np.zeros((size, 3)), np.zeros((size, 3)),
        np.zeros(size), np.zeros(size), colliders.pair_triangle[colliders.pair_start[:-1]].copy(), np.zeros(pairs),
        np.zeros((n, 3)), np.zeros((len(colliders.corners), 4)), np.zeros((n, 3)),
        np.zeros((len(colliders.bone_node), 4)),
    )  # fmt: skip


def bone_grids(body: Body) -> BoneGrids:
    """Return the distance grids of all bones in one flat array."""
    count = len(body.bones)
    values: list[np.ndarray] = []
    offset = np.full(count, -1, dtype=np.int32)
    shape = np.zeros((count, 3), dtype=np.int32)
    origin = np.zeros((count, 3))
    spacing = np.ones(count)
    total = 0
    for b, bone in enumerate(body.bones):
        if bone.grid is not None:
            offset[b], shape[b], origin[b], spacing[b] = (
                total,
                bone.grid.values.shape,
                bone.grid.origin,
                bone.grid.spacing,
            )
            values.append(np.ascontiguousarray(bone.grid.values, dtype=np.float32).ravel())
            total += values[-1].size
    if total >= 2**31:
        raise UserError(f"the bones' distance grids hold {total} samples; fewer than 2^31 are needed")
    flat = np.concatenate(values) if values else np.zeros(1, dtype=np.float32)
    return BoneGrids(flat, offset, shape, origin, spacing)


def _bone_pairs(body: Body) -> tuple[Ints, Ints, Floats]:
    if body.bone_contact is None:
        return np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros(0)
    free = ~body.pinned[body.bone_contact.node]
    one = body.bone_contact
    return one.node[free].astype(np.int32), one.bone[free].astype(np.int32), one.clearance[free].astype(np.float64)


def _sphere_pairs(body: Body) -> tuple[Ints, Floats, Floats]:
    node = [np.asarray(s.node, dtype=np.int32) for s in body.spheres]
    ball = [np.tile(np.append(s.centre, s.radius), (len(s.node), 1)) for s in body.spheres]
    clear = [np.asarray(s.clearance, dtype=np.float64) for s in body.spheres]
    if not node:
        return np.zeros(0, dtype=np.int32), np.zeros((0, 4)), np.zeros(0)
    return np.concatenate(node), np.concatenate(ball), np.concatenate(clear)


def _pair_lists(body: Body) -> tuple[Ints, Ints, Ints, Floats]:
    """Return node, start, triangle and gap of every pair contact.

    Left out is what a vertex cannot meet: triangles around it, that look the same way as it does, or
    that it is behind at rest (as at the corners of mouth and eyes, where the two sides are one sheet).
    """
    node: list[int] = []
    gap: list[float] = []
    start, triangle = [0], [np.zeros(0, dtype=np.int32)]
    points, corners = body.surface.points, body.surface.triangles
    looks = body.surface.vertex_normals
    faces = body.surface.normals_by_area / np.maximum(body.surface.areas[:, None], 1e-300)
    adjacent = topology.neighbours(corners, len(points))
    neighbours = [adjacent.of(i).tolist() for i in range(len(points))]
    for pair in body.pairs:
        for c, i in enumerate(pair.node):
            mine = pair.triangle[pair.start[c] : pair.start[c + 1]]
            mine = mine[faces[mine] @ looks[i] < FACING]
            mine = mine[~np.isin(corners[mine], _around(neighbours, int(i))).any(axis=1)].astype(np.int32)
            keep = np.zeros(len(mine), dtype=bool)
            contact.in_front(points, corners, int(i), mine, BEHIND, TOUCHING, keep)
            if keep.any():
                node.append(int(i))
                gap.append(pair.gap)
                triangle.append(mine[keep])
                start.append(start[-1] + int(keep.sum()))
    return (
        np.array(node, dtype=np.int32),
        np.array(start, dtype=np.int32),
        np.concatenate(triangle).astype(np.int32),
        np.array(gap, dtype=np.float64),
    )


def _around(neighbours: list[list[int]], i: int) -> list[int]:
    """Return the vertices within `RINGS` edges of vertex `i`, with itself."""
    found = ring = {i}
    for _ in range(RINGS):
        ring = {k for j in ring for k in neighbours[j]} - found
        found = found | ring
    return list(found)


def _local_fibres(body: Body, local: Ints, m: int, n: int) -> Fibres:
    u = body.muscles
    row = np.flatnonzero((local[u.node] >= 0) & (local[u.node] < m) & (u.weight != 0.0))
    row = row[np.argsort(local[u.node[row]], kind="stable")]
    start = np.zeros(n + 1, dtype=np.int32)
    np.cumsum(np.bincount(local[u.node[row]], minlength=n), out=start[1:])
    return Fibres(
        start,
        u.muscle[row].astype(np.int32),
        u.kind[row].astype(np.int32),
        u.bone[row].astype(np.int32),
        u.max_force[u.muscle[row]] * u.weight[row],
        np.ascontiguousarray(u.point[row], dtype=np.float64),
        np.maximum(u.softening[row], 1e-3),
    )
