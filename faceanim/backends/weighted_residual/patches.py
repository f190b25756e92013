"""Patches of flesh around what pulls, each solved by the weighted residual method.

A patch is every element within a reach of a place, along the flesh and not across slits such as the mouth. Where bone
holds it, it stands still; where it was cut from the rest it does too, which is sound where the answer has died away;
elsewhere it is free. The skin, far stiffer than what lies beneath, joins as an elastic coat of the free surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from faceanim.backends.weighted_residual.boundary import TRIANGLE_RULES, Boundary
from faceanim.backends.weighted_residual.fields import Sample
from faceanim.backends.weighted_residual.method import WeightedResidual
from faceanim.backends.weighted_residual.options import Options
from faceanim.body.solid import Solid
from faceanim.geometry.volume import FACES, TetMesh
from faceanim.ground.arrays import Bools, Floats, Ints

FILM = 0.02
"""Elements softer than this share of the stiffest are films that keep walls apart, not flesh that carries."""


@dataclass(frozen=True, eq=False)
class Patch:
    """A piece of flesh with its solution: `system`, its elements, and its elastic constants [kPa, -]."""

    system: WeightedResidual
    tets: Ints
    young: float
    poisson: float


def edge_graph(points: Floats, cells: Ints) -> sparse.csr_matrix:
    """Return the graph of the edges of `cells` (e, k) over `points` with their lengths [mm]."""
    k = cells.shape[1]
    i, j = np.concatenate([cells[:, [a, b]] for a in range(k) for b in range(a)]).T
    length = np.maximum(np.linalg.norm(points[i] - points[j], axis=1), 1e-9)
    low, high = np.minimum(i, j), np.maximum(i, j)
    _, first = np.unique(low.astype(np.int64) * len(points) + high, return_index=True)
    shape = (len(points), len(points))
    half = sparse.coo_matrix((length[first], (low[first], high[first])), shape=shape)
    return (half + half.T).tocsr()


class Cutter:
    """Cuts patches out of a solid."""

    def __init__(self, solid: Solid, options: Options) -> None:
        self.solid, self.options = solid, options
        young = np.array([m.young_modulus for m in solid.materials])
        self.young = young[solid.region]
        self.poisson = np.array([m.poisson_ratio for m in solid.materials])[solid.region]
        self.flesh = np.flatnonzero(self.young > FILM * young.max()).astype(np.int32)
        self.graph = edge_graph(solid.mesh.points, solid.mesh.tets[self.flesh])
        self.outside = _faces(solid.mesh.tets[self.flesh], len(solid.mesh.points))
        self.layer = solid.layer

    def around(self, nodes: Ints) -> tuple[Ints, Floats]:
        """Return the elements within reach of `nodes`, and the way to every node of the solid, (n,) [mm]."""
        way = dijkstra(self.graph, indices=nodes, min_only=True, limit=1.5 * self.options.reach)
        near = np.isfinite(way) & (way <= self.options.reach)
        return self.flesh[near[self.solid.mesh.tets[self.flesh]].all(axis=1)], np.asarray(way)

    def patch(self, tets: Ints, options: Options) -> Patch:
        """Return the elements `tets` as a patch of one material under an elastic coat."""
        mesh, solid = self.solid.mesh, self.solid
        faces = mesh.tets[tets][:, FACES].reshape(-1, 3)
        key = _keys(faces, len(mesh.points))
        _, first, count = np.unique(key, return_index=True, return_counts=True)
        skin = np.sort(first[count == 1])
        faces, key = faces[skin], key[skin]
        held = solid.held[faces].all(axis=1)
        cut = ~np.isin(key, self.outside)
        boundary = _boundary(mesh, faces, held | cut)
        coated, stiffness, thickness = self._coated(tets, faces, held | cut)
        bulk = tets if self.layer is None else tets[solid.region[tets] != self.layer.region]
        bulk = bulk if len(bulk) else tets
        volume = mesh.volumes[bulk]
        young = float(1.0 / np.average(1.0 / self.young[bulk], weights=volume))
        poisson = float(np.average(self.poisson[bulk], weights=volume))
        coat = None
        if coated.any():
            points = np.repeat(coated, len(TRIANGLE_RULES[2][1]))

            def coat(system: WeightedResidual, sample: Sample) -> Floats:
                thin = max(stiffness - young * thickness, 0.0)
                return coat_form(system, sample, points, thin, poisson)

        return Patch(WeightedResidual(boundary, young, poisson, options, coat=coat), tets, young, poisson)

    def _coated(self, tets: Ints, faces: Ints, fixed: Bools) -> tuple[Bools, float, float]:
        """Return which boundary faces are skin, Young's modulus times thickness of the skin [kPa mm], and thickness."""
        none = np.zeros(len(faces), dtype=bool), 0.0, 0.0
        if self.layer is None:
            return none
        outer = np.zeros(len(self.solid.mesh.points), dtype=bool)
        outer[self.layer.outer] = True
        skin = outer[faces].all(axis=1)
        mine = tets[self.solid.region[tets] == self.layer.region]
        corner = self.solid.mesh.points[faces[skin]]
        cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = 0.5 * float(np.linalg.norm(cross, axis=1).sum())
        if not len(mine) or not area:
            return none
        thickness = float(self.solid.mesh.volumes[mine].sum()) / area
        return skin & ~fixed, float(self.young[mine].mean()) * thickness, thickness


def coat_form(system: WeightedResidual, sample: Sample, points: Bools, stiffness: float, poisson: float) -> Floats:
    """Return the energy form of an elastic coat (plane stress) of `stiffness` [kPa mm] on the boundary `points`.

    In scaled units: the stretch of the two tangents and their shear, integrated over the coated area.
    """
    normal = system.boundary.normals[points]
    helper = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(normal, first)
    gradient = sample.gradient[points]
    strain = [np.einsum("na,nabm,nb->nm", p, gradient, q) for p, q in ((first, first), (second, second))]
    shear = 0.5 * sum(np.einsum("na,nabm,nb->nm", p, gradient, q) for p, q in ((first, second), (second, first)))
    weight = (system.boundary.weights[points] / system.length**2)[:, None]
    factor = stiffness / (system.young * system.length) / (1.0 - poisson**2)

    def product(a: Floats, b: Floats) -> Floats:
        return np.asarray(a.T @ (weight * b))

    mean = strain[0] + strain[1]
    square = product(strain[0], strain[0]) + product(strain[1], strain[1]) + 2.0 * product(shear, shear)
    return np.asarray(factor * ((1.0 - poisson) * square + poisson * product(mean, mean)))


def _keys(faces: Ints, n: int) -> Floats:
    a, b, c = np.sort(faces, axis=1).astype(np.int64).T
    return np.asarray((a * n + b) * n + c)


def _faces(tets: Ints, n: int) -> Floats:
    """Return the keys of the faces that belong to one element only; `n` nodes."""
    keys, count = np.unique(_keys(tets[:, FACES].reshape(-1, 3), n), return_counts=True)
    return np.asarray(keys[count == 1])


def _boundary(mesh: TetMesh, faces: Ints, fixed: Bools) -> Boundary:
    """Return boundary points on `faces` (t, 3) with displacement 0 where `fixed` (t,), else traction 0."""
    local, share = TRIANGLE_RULES[2]
    corner = mesh.points[faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    double = np.linalg.norm(cross, axis=1)
    many = len(share)
    given = np.broadcast_to(np.repeat(fixed, many)[:, None], (many * len(faces), 3))
    points = np.einsum("qa,tai->tqi", local, corner).reshape(-1, 3)
    return Boundary(
        points, np.repeat(cross / double[:, None], many, axis=0), (0.5 * double[:, None] * share).ravel(), given
    )
