"""A stand-in for patients: the same head and the same bone moves computed by a finer model of other elements.

Declared before any model was run on it, and not tuned afterwards:
- geometry: the head at its finest density, with columns of its own (another triangulation than the models'), quadratic
  in all directions (18-node wedges, solid skin), one side of the head with the middle plane as a mirror
- tissue: skin, muscle and fat with the published constants under the stable law; the muscles' edges are smoothed, and
  all moduli vary by up to 20 % in patches some 30 mm wide that no model knows
- boundary: flesh is bonded to bone, but for the moist gap between the wall of the mouth and the teeth
- noise: correlated (normal direction, sigma 0.4 mm, correlation length 4 mm), three seeds, plus what a rigid
  registration on the unmoved skin leaves of it
The truth shares with the models the law, the constants and the bone moves, which favours them: no statement about patients.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from faceanim.elements import shapes
from faceanim.elements.newton import Newton, Report, newton
from faceanim.elements.wedges import Wedges, line_values
from faceanim.face.columns import grow, layer_shares, stacked
from faceanim.face.face import Face
from faceanim.face.tissue_carry import Carrier, carry
from faceanim.face.tissue_layers import muscular
from faceanim.face.tissue_volume import bone_shares
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import RunError
from faceanim.ground.notes import tell
from faceanim.tissue.material import Material

EDGE, LAYERS = 6.0, 3
"""Edge of the columns' triangles [mm] and layers, quadratic both: half of that between nodes."""
QUALITY = 0.06
SMOOTHINGS = 2
"""How often the share of muscle is averaged with that of the neighbouring wedges."""
PATCH, SPREAD, TISSUE_SEED = 30.0, 0.2, 1
"""Width of patches of stiffer and softer flesh [mm], by how much, and which."""
SIGMA, LENGTH, SEEDS = 0.4, 4.0, (1, 2, 3)
"""Of the noise: [mm], [mm]."""
_EXTRAPOLATED = -0.3
"""A skin vertex with a weight below this lies too far outside its wedge for its quadratic functions."""


@dataclass(frozen=True, eq=False)
class Tissues:
    """The three materials and the gap: skin, fat, muscle, gap."""

    skin: Material
    fat: Material
    muscle: Material
    gap: Material


class SyntheticTruth:
    """The finer model of a head that is its own mirror image, bonded to bones that move symmetrically.

    face : at its finest density   report : of the last solution
    """

    def __init__(self, face: Face, tissues: Tissues) -> None:
        self.face, self.tissues = face, tissues
        self.report = Report()
        self.columns = grow(face, EDGE, LAYERS, QUALITY, half=True)
        c = self.columns
        share = layer_shares(np.linalg.norm(c.foot - c.top, axis=1), c.wall, LAYERS)
        levels = c.top[:, None] + share[:, :, None] * (c.foot - c.top)[:, None]
        e = len(c.triangles) * LAYERS
        self.wedges = Wedges(levels, c.triangles, self._materials(), np.arange(e, dtype=np.int32), law="tension")

    def _materials(self) -> list[Material]:
        """Return the material of every wedge: smoothed between muscle and fat, and varied."""
        c, t = self.columns, self.tissues
        mesh = TetMesh(*stacked(c.top, c.foot, c.wall, c.triangles, LAYERS))
        muscle = muscular(self.face, c, mesh, LAYERS).reshape(-1, 3)[:, 0].astype(np.float64)
        neighbours = _neighbours(c.triangles)
        for _ in range(SMOOTHINGS):
            muscle = (neighbours @ muscle.reshape(-1, LAYERS)).ravel()
        layer = np.tile(np.arange(LAYERS), len(c.triangles))
        gap = (layer == LAYERS - 1) & np.repeat(c.gap[c.triangles].all(axis=1), LAYERS)
        centre = mesh.points[mesh.tets].mean(axis=1).reshape(-1, 3, 3).mean(axis=1)
        stiffer = 1.0 + SPREAD * patches(centre, PATCH, TISSUE_SEED)
        out = []
        for k in range(len(muscle)):
            if gap[k]:
                out.append(t.gap)
            elif layer[k] == 0:
                out.append(_blend(t.skin, t.skin, 0.0, stiffer[k]))
            else:
                out.append(_blend(t.fat, t.muscle, muscle[k], stiffer[k]))
        return out

    @cached_property
    def held(self) -> Ints:
        """The nodes that bones hold, (h,)."""
        return np.flatnonzero(self._shares.sum(axis=1) > 0.5).astype(np.int32)

    @property
    def held_shares(self) -> Floats:
        """Share of cranium and jaw in holding them, (h, 2)."""
        return self._shares[self.held]

    @cached_property
    def _shares(self) -> Floats:
        base = bone_shares(self.face, self.columns, LAYERS).reshape(-1, LAYERS + 1, 2)
        m = len(base)
        ends = base[self.wedges.edges]
        mid = np.where((ends.sum(axis=3) > 0.5).all(axis=1)[..., None], ends.mean(axis=1), 0.0)
        both = np.concatenate([base, mid])
        out = np.zeros((len(both), 2 * LAYERS + 1, 2))
        out[:, ::2] = both
        pair = (both[:, 1:].sum(axis=2) > 0.5) & (both[:, :-1].sum(axis=2) > 0.5)
        out[:, 1::2] = np.where(pair[..., None], 0.5 * (both[:, 1:] + both[:, :-1]), 0.0)
        assert len(both) == m + len(self.wedges.edges)
        return out.reshape(-1, 2)

    def column_vertex(self, node: Ints) -> Ints:
        """Return the skin vertex of the column of each node, (k,); between two columns, of the first."""
        base = node // (2 * LAYERS + 1)
        m = len(self.columns.vertex)
        column = np.where(base < m, base, self.wedges.edges[np.maximum(base - m, 0), 0])
        return np.asarray(self.columns.vertex[column])

    def solve(self, goal: Floats, first_step: float) -> Floats:
        """Return the skin, (n, 3) [mm], when the held nodes are at `goal` (h, 3).

        first_step : share of the way that is tried at once   Raises `RunError` if the end is not reached.
        """
        wedges = self.wedges
        fixed = np.zeros(wedges.points.shape, dtype=bool)
        fixed[self.held] = True
        fixed[wedges.points[:, 0] == 0.0, 0] = True
        values = wedges.points.copy()
        values[self.held] = goal
        values[wedges.points[:, 0] == 0.0, 0] = 0.0
        tell(f"the truth: {int((~fixed).sum())} freedoms")
        search = Newton(wedges, ~fixed, tolerance=1e-6)
        x, self.report = newton(wedges, fixed=fixed, values=values, first_step=first_step, solver=search)
        if not self.report.converged:
            raise RunError(f"the truth was found up to {self.report.fraction:.0%} of the move only; move less")
        return self._skin(x)

    def _skin(self, x: Floats) -> Floats:
        """Return the skin's vertices, (n, 3), mirrored to the other side."""
        matrix, done = self.skin
        points, mirror = self.face.mesh.points, self.face.mirror
        moved = points + matrix @ (x - self.wedges.points)
        return np.where(done[:, None], moved, moved[mirror] * [-1.0, 1.0, 1.0])

    @cached_property
    def skin(self) -> tuple[sparse.csr_matrix, Bools]:
        """The weights (n, nodes) by which the nodes carry the skin at x >= 0, and which vertices that is, (n,)."""
        c = self.columns
        mesh = TetMesh(*stacked(c.top, c.foot, c.wall, c.triangles, LAYERS))
        shares = bone_shares(self.face, c, LAYERS)
        carrier, _ = carry(self.face, c, mesh, shares, LAYERS, half=True)
        return self._carried(carrier), carrier.done

    def _carried(self, carrier: Carrier) -> sparse.csr_matrix:
        """Return a carrier of linear tetrahedra as one of the wedges: quadratic where a vertex lies within its wedge."""
        height, layers = 2 * LAYERS + 1, LAYERS + 1
        column, level = carrier.node // layers, carrier.node % layers
        weight = carrier.weight.copy()
        quadratic = self._within(column[:, :4], level[:, :4], weight[:, :4])
        weight[quadratic[0], :4] = 0.0
        n = len(weight)
        row = np.repeat(np.arange(n), 12)
        linear = sparse.coo_matrix(
            (weight.ravel(), (row, (column * height + 2 * level).ravel())), (n, len(self.wedges.points))
        )
        which, node, value = quadratic
        curved = sparse.coo_matrix((value.ravel(), (np.repeat(which, 18), node.ravel())), linear.shape)
        return (linear + curved).tocsr()

    def _within(self, column: Ints, level: Ints, weight: Floats) -> tuple[Ints, Ints, Floats]:
        """Return the vertices carried by one wedge (k,), its nodes (k, 18) and their weights (k, 18)."""
        known = {tuple(sorted(t)): k for k, t in enumerate(self.columns.triangles.tolist())}
        rows, nodes, values = [], [], []
        total = weight.sum(axis=1)
        for i in np.flatnonzero((total > 1e-9) & (weight.min(axis=1) > _EXTRAPOLATED)):
            t = known.get(tuple(sorted(set(column[i].tolist()))))
            if t is None:
                continue
            share = weight[i] / total[i]
            at = np.array([[share[column[i] == corner].sum() for corner in self.columns.triangles[t]]])
            depth = float(share @ level[i])
            layer = int(np.clip(depth, 0, LAYERS - 1))
            flat = shapes.shape_values(2, at, shapes.TRIANGLE_EDGES)
            line = line_values(np.array([depth - layer]))
            rows.append(i)
            nodes.append(self.wedges.node[t * LAYERS + layer])
            values.append(total[i] * np.einsum("qk,qa->ka", line, flat).ravel())
        return np.array(rows, dtype=np.int32), np.array(nodes), np.array(values)


def _neighbours(triangles: Ints) -> sparse.csr_matrix:
    """Return the matrix (t, t) that takes the mean of each triangle and those that share an edge with it."""
    pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, edge = np.unique(pairs, axis=0, return_inverse=True)
    t = len(triangles)
    touch = sparse.coo_matrix((np.ones(3 * t), (np.repeat(np.arange(t), 3), edge.ravel()))).tocsr()
    both = ((touch @ touch.T) > 0).astype(np.float64)
    return sparse.diags(1.0 / np.asarray(both.sum(axis=1)).ravel()) @ both


def _blend(a: Material, b: Material, share: float, factor: float) -> Material:
    """Return the mean of two materials, `share` of it `b`, with all moduli times `factor`."""

    def mean(p: float, q: float) -> float:
        return factor * ((1.0 - share) * p + share * q)

    return Material.mooney_rivlin(
        "mixture", a.density, mean(a.c10, b.c10), mean(a.c01, b.c01), mean(a.bulk_modulus, b.bulk_modulus)
    )


def patches(points: Floats, width: float, seed: int) -> Floats:
    """Return a smooth random field, (n,) in [-1, 1], at `points` (n, 3): waves in 24 directions about 2 `width` long."""
    random = np.random.default_rng(seed)
    way = random.normal(size=(24, 3))
    way *= (np.pi / width) / np.linalg.norm(way, axis=1, keepdims=True)
    waves = np.cos(points @ way.T + random.uniform(0.0, 2.0 * np.pi, 24)).sum(axis=1)
    return np.clip(waves / np.sqrt(24.0), -1.0, 1.0)


def noise(points: Floats, normals: Floats, seed: int) -> Floats:
    """Return the error of a segmented surface, (n, 3) [mm]: `SIGMA` along the normal, correlated over `LENGTH`."""
    random = np.random.default_rng(seed)
    tree = cKDTree(points)
    near = tree.sparse_distance_matrix(tree, 3.0 * LENGTH, output_type="coo_matrix").tocsr()
    near.data = np.exp(-2.0 * (near.data / LENGTH) ** 2)
    field = near @ random.normal(size=len(points)) / np.sqrt(np.asarray(near.multiply(near).sum(axis=1)).ravel())
    return SIGMA * field[:, None] * normals
