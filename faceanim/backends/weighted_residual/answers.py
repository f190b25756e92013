"""The answer of the skin to every muscle of a body larger than a patch, computed once and kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import linalg
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


def patch_fields(body: Body, solid: Solid, pulled: Ints, options: Options) -> tuple[Floats, Floats]:
    """Return what patches answer to a unit pull along x, y, z: (k, n_surface, 3) and, at the solid's nodes, (k, n, 3).

    One patch around each of the `places` of the `pulled` vertices; the pull is shared by the pulled vertices near.
    """
    seeds, way = places(body, pulled, SPACING * options.reach)
    share = np.maximum(0.0, 1.0 - way / (SHARED * SPACING * options.reach)) ** 2
    cutter = Cutter(solid, options)
    local = replace(options, degree=options.patch_degree)
    skin: list[Floats] = []
    inside: list[Floats] = []
    for seed, part in zip(seeds, share, strict=True):
        mine = pulled[part[pulled] > 0.0]
        tets, way_in = cutter.around(solid.skin.node[seed][solid.skin.weight[seed] > 0.05])
        system = cutter.patch(tets, local).system
        force = np.einsum("v,ab->vba", part[mine] / part[mine].sum(), np.eye(3)).reshape(-1, 3)
        c = system.point_loads(body.surface.points[mine]) @ force
        fade_in = faded(np.minimum(way_in, options.reach) / options.reach)
        fade_in[solid.held] = 0.0
        fade = np.where(body.pinned, 0.0, solid.skin.apply(fade_in))
        for points, weight, out in ((body.surface.points, fade, skin), (solid.mesh.points, fade_in, inside)):
            seen = np.flatnonzero(np.abs(weight) > 1e-9)
            u = np.zeros((3, len(points), 3))
            field = system.shapes(points[seen]) @ c
            u[:, seen] = system.length * weight[seen, None] * field.transpose(2, 0, 1)
            out.append(u)
    return np.concatenate(skin), np.concatenate(inside)


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


def muscle_answers(body: Body, solid: Solid, options: Options) -> tuple[Floats, Floats, Floats]:
    """Return the skin's answer to every muscle at full activation, (m, n, 3) [mm], held vertices still, with the
    compliance (m, m) [uJ] and the mass (m, m) [kg mm^2] of these answers.

    The answers of the patches are superposed so that the energy of the whole body, with every element's own stiffness,
    is least (Ritz); flesh beneath the skin may lag behind the skin, as it does over soft fat.
    """
    pulls = muscle_pulls(body)
    pulled = np.flatnonzero(np.abs(pulls).max(axis=(0, 2), initial=0.0) > 0.0).astype(np.int32)
    if not len(pulled):
        return np.zeros_like(pulls), np.zeros((len(pulls),) * 2), np.zeros((len(pulls),) * 2)
    skin, inside = patch_fields(body, solid, pulled, options)
    flat = layered(solid, inside).reshape(-1, inside[0].size).T
    stiffness = flat.T @ (stiffness_matrix(solid) @ flat)
    work = np.zeros((flat.shape[1], len(pulls)))
    work[: len(skin)] = skin.reshape(len(skin), -1) @ pulls.reshape(len(pulls), -1).T
    scale = 1.0 / np.sqrt(np.diag(stiffness))
    value, vector = linalg.eigh(scale[:, None] * stiffness * scale)
    good = value > 1e-8 * value[-1]
    vector = scale[:, None] * vector[:, good]
    amplitude = vector @ ((vector.T @ work) / value[good, None])
    fields = (amplitude[: len(skin)].T @ skin.reshape(len(skin), -1)).reshape(pulls.shape)
    nodal = flat @ amplitude
    mass = nodal.T @ (np.repeat(solid.node_mass, 3)[:, None] * nodal)
    return np.ascontiguousarray(fields), work.T @ amplitude, mass
