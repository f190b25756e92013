"""The answer of the skin to every muscle of a body larger than a patch, computed once and kept.

Patches of one modulus know neither the shear of soft fat beneath stiff skin nor the flesh beyond their cut faces, so that
their superposition alone is too stiff (Ritz: 0.60 of the compliance of linear elements on a face). What it leaves
unbalanced is weighted again, now by fields that vary freely through the thickness: a block of the layered stiffness for
every column of nodes from skin to bone. A few such rounds, each followed by Ritz over all fields so far, make up for it.
This is the two-level correction of overlapping domain decomposition (Smith, Bjorstad & Gropp 1996, ch. 2) stopped early.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.csgraph import dijkstra

from faceanim.backends.nodal import fibre_table
from faceanim.backends.weighted_residual.options import Options
from faceanim.backends.weighted_residual.patches import Cutter, edge_graph
from faceanim.body.assembly import stiffness_matrix
from faceanim.body.body import Body
from faceanim.body.solid import Solid
from faceanim.geometry.topology import mirror_images
from faceanim.ground.arrays import Floats, Ints
from faceanim.kernels import muscles

SPACING = 0.27
"""Places that get a patch are this share of the reach apart."""
SHARED = 1.6
"""A pull is shared by the vertices within this many spacings of its place."""
CORE = 0.4
"""An answer fades between this share of the reach and the reach itself."""


def muscle_pulls(body: Body) -> Floats:
    """Return the forces of every muscle at full activation on the resting surface, (m, n, 3) [mN]."""
    n, m = len(body.surface.points), len(body.muscles.names)
    table = fibre_table(body.muscles, n)
    pose = np.tile(np.eye(4), (len(body.bones), 1, 1))
    out = np.zeros((m, n, 3))
    for k in range(m):
        muscles.pull(table, np.eye(m)[k], pose, body.surface.points, out[k])
    return out


def places(body: Body, pulled: Ints, spacing: float) -> tuple[Ints, Floats]:
    """Return vertices no more than `spacing` [mm] of way from all `pulled` ones, and the way from each, (p, n) [mm].

    On a surface that is its own mirror image the places are too, so that answers keep the symmetry.
    """
    points = body.surface.points
    graph, mirror = edge_graph(points, body.surface.triangles), mirror_images(points)
    found: list[int] = []
    rows: list[Floats] = []
    nearest = np.full(len(points), np.inf)
    while len(pulled) and (not found or nearest[pulled].max() > spacing):
        place = int(pulled[np.argmax(nearest[pulled] if found else points[pulled, 1])])
        images = [place] if mirror is None else sorted({place, int(mirror[place])})
        for image in images:
            way = dijkstra(graph, indices=image)
            found.append(image)
            rows.append(way)
            nearest = np.minimum(nearest, way)
    return np.array(found, dtype=np.int32), np.array(rows).reshape(len(found), -1)


def patch_fields(body: Body, solid: Solid, pulled: Ints, options: Options) -> Floats:
    """Return what patches answer to a unit pull along x, y, z at the solid's nodes, (k, n, 3).

    One patch around each of the `places` of the `pulled` vertices; the pull is shared by the pulled vertices near.
    """
    seeds, way = places(body, pulled, SPACING * options.reach)
    share = np.maximum(0.0, 1.0 - way / (SHARED * SPACING * options.reach)) ** 2
    pulls = (share[:, pulled] > 0.0).any(axis=1)  # the mirror image of a place need not be near anything that is pulled
    seeds, share = seeds[pulls], share[pulls]
    cutter = Cutter(solid, options)
    local = replace(options, degree=options.patch_degree)
    out = np.zeros((3 * len(seeds), len(solid.mesh.points), 3))
    for k, (seed, part) in enumerate(zip(seeds, share, strict=True)):
        mine = pulled[part[pulled] > 0.0]
        tets, way_in = cutter.around(solid.skin.node[seed][solid.skin.weight[seed] > 0.05])
        system = cutter.patch(tets, local).system
        force = np.einsum("v,ab->vba", part[mine] / part[mine].sum(), np.eye(3)).reshape(-1, 3)
        c = system.point_loads(body.surface.points[mine]) @ force
        fade = faded(np.minimum(way_in, options.reach) / options.reach)
        fade[solid.held] = 0.0
        seen = np.flatnonzero(np.abs(fade) > 1e-9)
        field = system.shapes(solid.mesh.points[seen]) @ c
        out[3 * k : 3 * k + 3, seen] = system.length * fade[seen, None] * field.transpose(2, 0, 1)
    return out


def faded(way: Floats) -> Floats:
    """Return 1 near a place, smoothly falling to 0 at the reach; `way` in reaches."""
    t = np.clip((way - CORE) / (1.0 - CORE), 0.0, 1.0)
    return np.asarray(1.0 - t * t * (3.0 - 2.0 * t))


def layered(solid: Solid, fields: Floats) -> Floats:
    """Return `fields` (k, n, 3) on the skin layer alone and, after them, on what lies beneath; (k, n, 3) without layer."""
    if solid.layer is None:
        return fields
    skin = np.zeros((len(solid.mesh.points), 1))
    skin[solid.layer.outer] = skin[solid.layer.inner] = 1.0
    return np.concatenate([skin * fields, (1.0 - skin) * fields])


class Columns:
    """The flesh between each skin node and the bone beneath as a small elastic body of its own, its neighbours still.

    A column holds the free nodes whose shortest way along the flesh to free skin ends at the same node.
    """

    def __init__(self, solid: Solid, stiffness: sparse.csr_matrix) -> None:
        mesh = solid.mesh
        skin = mesh.boundary_nodes if solid.layer is None else solid.layer.outer
        skin = skin[~solid.held[skin]] if not solid.held[skin].all() else skin
        graph = edge_graph(mesh.points, mesh.tets)
        _, _, column = dijkstra(graph, indices=skin, min_only=True, return_predecessors=True)
        column = np.where(column < 0, np.arange(len(column)), column)
        free = np.flatnonzero(~solid.held)
        free = free[np.argsort(column[free], kind="stable")]
        self.rows = (3 * free[:, None] + np.arange(3)).ravel()
        owner = np.repeat(column[free], 3)
        pair = stiffness[self.rows][:, self.rows].tocoo()
        own = owner[pair.row] == owner[pair.col]
        blocks = sparse.coo_matrix((pair.data[own], (pair.row[own], pair.col[own])), shape=pair.shape).tocsr()
        ends = np.concatenate([[0], np.flatnonzero(np.diff(owner)) + 1, [len(owner)]])
        spans = [slice(a, b) for a, b in pairwise(ends) if b > a]
        self.inverse = sparse.block_diag([np.linalg.inv(blocks[s, s].toarray()) for s in spans]).tocsr()

    def answer(self, force: Floats) -> Floats:
        """Return the displacements (3n, m) [mm] of all columns under the nodal forces `force` (3n, m) [mN]."""
        out = np.zeros_like(force)
        out[self.rows] = self.inverse @ force[self.rows]
        return out


def normalised(fields: Floats, stiffness: sparse.csr_matrix, cut_off: float) -> Floats:
    """Return combinations (3n, r) of `fields` (3n, m) whose energies are 1 and products 0, without dependent ones."""
    gram = fields.T @ (stiffness @ fields)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    value, vector = linalg.eigh(scale[:, None] * gram * scale)
    good = value > cut_off * value[-1]
    return np.asarray(fields @ (scale[:, None] * vector[:, good] / np.sqrt(value[good])))


def superposed(fields: Floats, solid: Solid, loads: Floats, rounds: int) -> Floats:
    """Return the displacements (3n, m) [mm] of least energy under nodal `loads` (3n, m) [mN], spanned by `fields` (3n, k)
    and `rounds` of what `Columns` answer to the forces that are still unbalanced.

    The compliance loads.T @ result grows with every round towards that of the layered solid and never beyond (Ritz).
    """
    stiffness = stiffness_matrix(solid)
    basis = normalised(fields, stiffness, 1e-8)
    found = np.asarray(basis @ (basis.T @ loads))
    columns = Columns(solid, stiffness) if rounds else None
    for _ in range(rounds):
        assert columns is not None
        left = loads - stiffness @ found
        left[np.repeat(solid.held, 3)] = 0.0
        if np.abs(left).max() <= 1e-9 * np.abs(loads).max():
            break
        extra = columns.answer(left)
        for _ in range(2):  # the second time around repairs what round-off left in the first
            extra -= basis @ (basis.T @ (stiffness @ extra))
            extra = normalised(extra, stiffness, 1e-10)
        found += extra @ (extra.T @ loads)
        basis = np.concatenate([basis, extra], axis=1)
    return found


def muscle_answers(body: Body, solid: Solid, options: Options) -> tuple[Floats, Floats, Floats]:
    """Return the skin's answer to every muscle at full activation, (m, n, 3) [mm], held vertices still, with the
    compliance (m, m) [uJ] and the mass (m, m) [kg mm^2] of these answers.

    The answers of the patches are superposed so that the energy of the whole body, with every element's own stiffness,
    is least (Ritz); flesh beneath the skin may lag behind the skin, as it does over soft fat (see `superposed`).
    """
    pulls = muscle_pulls(body)
    pulled = np.flatnonzero(np.abs(pulls).max(axis=(0, 2), initial=0.0) > 0.0).astype(np.int32)
    if not len(pulled):
        return np.zeros_like(pulls), np.zeros((len(pulls),) * 2), np.zeros((len(pulls),) * 2)
    skin = solid.skin.matrix(len(solid.mesh.points))
    loads = np.stack([(skin.T @ pull).ravel() for pull in pulls], axis=1)
    loads[np.repeat(solid.held, 3)] = 0.0
    inside = layered(solid, patch_fields(body, solid, pulled, options))
    nodal = superposed(inside.reshape(len(inside), -1).T, solid, loads, options.corrections)
    fields = np.stack([skin @ nodal[:, k].reshape(-1, 3) for k in range(len(pulls))])
    fields[:, body.pinned] = 0.0
    mass = nodal.T @ (np.repeat(solid.node_mass, 3)[:, None] * nodal)
    return fields, loads.T @ nodal, mass
