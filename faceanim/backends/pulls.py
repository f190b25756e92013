"""What acts on the elements besides their own stress: muscles, forces on the surface, gravity, inertia and drag."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy import sparse

from faceanim.backends.nodal import fibre_table
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.elements import shapes
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.embedding import Embedding
from faceanim.ground.arrays import Floats, Ints
from faceanim.kernels import muscles
from faceanim.kernels.tables import F8, I4


class Aimed(NamedTuple):
    """The fibres of the muscles that act, packed by surface vertex, as `kernels.muscles.aim` writes them.

    first : (n + 1,)   target : (e, 3) [mm] or unit vector   pull : (e,) [mN]   softening : (e,) [mm], negative = along
    """

    first: I4
    target: F8
    pull: F8
    softening: F8


def coupled(body: Body, skin: Embedding) -> Ints:
    """Return the pairs of corner nodes, (k, 2), that carry a surface vertex which a muscle pulls."""
    node = skin.node[np.unique(body.muscles.node)]
    w = node.shape[1]
    return np.stack([np.repeat(node, w, axis=1).ravel(), np.tile(node, (1, w)).ravel()], axis=1)


def carried_by(elements: Elements, skin: Embedding) -> Embedding:
    """Return the points of `skin`, which corner nodes carry, as carried by the shape functions of `elements`.

    A point whose nodes are not all corners of one element keeps its linear weights.
    """
    if elements.order == 1 or skin.node.shape[1] != 4:
        return skin
    span = len(elements.mesh.points)
    pairs = np.sort(skin.node[:, shapes.TET_EDGES], axis=2).astype(np.int64)
    known = elements.edges[:, 0].astype(np.int64) * span + elements.edges[:, 1]
    key = pairs[:, :, 0] * span + pairs[:, :, 1]
    at = np.minimum(np.searchsorted(known, key), len(known) - 1)
    within = (known[at] == key).all(axis=1)
    weight = np.concatenate([skin.weight, np.zeros((len(skin.weight), 6))], axis=1)
    weight[within] = shapes.shape_values(2, skin.weight[within], shapes.TET_EDGES)
    node = np.concatenate([skin.node, np.where(within[:, None], span + at, skin.node[:, :1])], axis=1)
    return Embedding(np.ascontiguousarray(node, dtype=np.int32), np.ascontiguousarray(weight))


class Carrier(Protocol):
    """Elements whose tangent has room for what pulls them; `points` (n, 3) are the rest positions [mm]."""

    points: Floats

    def entries(self, i: Ints, j: Ints) -> Ints:
        """Return where the blocks of the node pairs are in the tangent's values, (k, 3, 3)."""


class Pulls:
    """The muscles of a body on the surface that its elements carry: a `newton.Term`; `dead` are the constant forces."""

    def __init__(self, body: Body, elements: Carrier, skin: Embedding, *, mass: Floats) -> None:
        """Compile the tables; `mass` (n,) [kg] is what gravity acts on."""
        n = len(body.surface.points)
        self.elements = elements
        self.skin = skin
        self.matrix = skin.matrix(len(elements.points))
        self._spread = self.matrix.T.tocsr()
        self.fibres = fibre_table(body.muscles, n)
        e = len(self.fibres.muscle)
        self.aimed = Aimed(np.zeros(n + 1, dtype=np.int32), np.zeros((e, 3)), np.zeros(e), np.zeros(e))
        self.mass = mass
        self.dead = np.zeros_like(elements.points)
        self._force = np.zeros((n, 4))
        self._block = np.zeros((n, 6))
        self._places()

    def _places(self) -> None:
        """Find where the pulled vertices' blocks go in the tangent."""
        self._pulled = np.flatnonzero(np.diff(self.fibres.start))
        node, weight = self.skin.node[self._pulled], self.skin.weight[self._pulled]
        w = node.shape[1]
        product = (weight[:, :, None] * weight[:, None, :]).reshape(-1, w * w)
        row, pair = np.nonzero(product)
        i = node[row, pair // w]
        j = node[row, pair % w]
        self._row, self._product = row, product[row, pair]
        self._at = self.elements.entries(i, j).reshape(-1, 9)

    def surface(self, x: Floats) -> Floats:
        """Return where the surface vertices are, (n_surface, 3) [mm]."""
        return np.asarray(self.matrix @ x)

    def spread(self, x: Floats, force: Floats) -> Floats:
        """Return forces on the surface vertices, (n_surface, 3), as forces on the nodes, (n, 3) [mN]."""
        return np.asarray(self._spread @ force)

    @property
    def acts(self) -> bool:
        """Whether any muscle pulls now."""
        return bool(self.aimed.first[-1])

    def apply(self, control: Control) -> None:
        """Take the activations, poses and loads of `control`; they hold until the next call."""
        muscles.aim(self.fibres, control.activation, control.bone_pose, self.aimed)
        self.dead[:] = self.mass[:, None] * control.gravity
        if control.force is not None:
            self.dead += self._spread @ control.force

    def energy(self, x: Floats) -> float:
        """Return the muscles' energy [uJ]."""
        if not self.acts:
            return 0.0
        return float(muscles.fibre_energy(self.surface(x), self.aimed, len(self._force)))

    def forces(self, x: Floats) -> Floats:
        """Return the muscles' forces on the nodes, (n, 3) [mN]."""
        if not self.acts:
            return np.zeros_like(x)
        self._force[:] = 0.0
        muscles.fibre_force(self.surface(x), self.aimed, len(self._force), self._force)
        return self.spread(x, self._force[:, :3])

    def _blocks(self, x: Floats) -> Floats:
        """Return the Hessians of the pulls on the pulled vertices, row by row, (p, 9) [mN/mm]."""
        self._block[:] = 0.0
        muscles.fibre_blocks(self.surface(x), self.aimed, len(self._force), self._block)
        return self._block[self._pulled][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]]

    def add_tangent(self, x: Floats, values: Floats) -> None:
        """Add w_a w_b F (I - d d^T / r^2) / r for all nodes a, b of each pulled vertex."""
        if not self.acts:
            return
        full = self._blocks(x)
        values += np.bincount(self._at.ravel(), (self._product[:, None] * full[self._row]).ravel(), len(values))


@dataclass
class Quadratic:
    """The energy 1/2 (x - centre)^T A (x - centre): a `newton.Term`; inertia and drag over one time step are such."""

    matrix: sparse.csr_matrix
    centre: Floats

    def energy(self, x: Floats) -> float:
        """Return the energy [uJ]."""
        away = (x - self.centre).ravel()
        return float(0.5 * away @ (self.matrix @ away))

    def forces(self, x: Floats) -> Floats:
        """Return minus its gradient, (n, 3) [mN]."""
        return np.asarray(-(self.matrix @ (x - self.centre).ravel())).reshape(-1, 3)

    def add_tangent(self, x: Floats, values: Floats) -> None:
        """Add A, which has the pattern of the elements' own freedoms, the first of the values."""
        values[: len(self.matrix.data)] += self.matrix.data
