"""The skin of a solid as a shell that rides on the flesh beneath, in the flesh's own freedoms and its own rotations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from faceanim.backends.mixed_fem.flesh import Flesh
from faceanim.backends.pulls import Pulls
from faceanim.body.body import Body
from faceanim.body.solid import Solid, ThinLayer
from faceanim.elements.shells import Sheet, Shells
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.embedding import Embedding
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import UserError
from faceanim.tissue.material import Material

DRILLING = 0.5
"""Share of the shear stiffness that holds a node's turn about the normal, large: else muscles, which pull at arms that
lean, and bends of more than a radian turn nodes on the spot."""
THINNEST = 0.1
"""Least thickness of a shell [mm], where the layer's columns lean steeply."""


class Skin:
    """A solid divided into the flesh beneath its layer and the layer as a shell.

    Positions `x` (k + m, 3): the k rows of `rest`, then the rotation vectors of the layer's m pairs. The outer nodes of
    the layer are carried: x_outer = x_inner + R arm, and the shell's middle lies half-way.

    carrier : (m,) rows of the inner nodes   arm : (m, 3) [mm]
    """

    def __init__(self, rest: Flesh, solid: Solid, layer: ThinLayer, material: Material, law: str) -> None:
        mesh, row = solid.mesh, rest.row
        if (row[layer.inner] < 0).any() or (row[layer.outer] >= 0).any():
            raise UserError("the skin's layer must lie on other flesh, pair by pair; this one cannot become a shell")
        self.rest, self.flesh, self.layer = rest, rest.mesh, layer
        self.carrier = row[layer.inner]
        self.arm = mesh.points[layer.outer] - mesh.points[layer.inner]
        self.rows = np.concatenate([self.carrier, len(rest.points) + np.arange(len(self.arm))]).astype(np.int32)
        thickness, offset = self._middle()
        sheets = [sheet_of(material, law, float(h)) for h in thickness]
        every = np.arange(len(sheets), dtype=np.int32)
        self.shells = Shells(mesh.points[layer.inner], layer.triangles, sheets, every, offset=offset)
        self.node = self.rows[self.shells.node]

    def _middle(self) -> tuple[Floats, Floats]:
        """Return the thickness of the layer at each triangle, (t,), and the way from the inner nodes to its middle, (m, 3).

        The way is along the normal: a leaning arm would let the membrane turn the nodes about it, which hardly resist.
        """
        surface = TriMesh(self.rest.points[self.carrier] + 0.5 * self.arm, self.layer.triangles)
        height = np.maximum(np.einsum("mi,mi->m", self.arm, surface.vertex_normals), THINNEST)
        return height[self.layer.triangles].mean(axis=1), 0.5 * height[:, None] * surface.vertex_normals

    def full(self, x: Floats) -> Floats:
        """Return where all nodes of the solid are, (n, 3) [mm]."""
        out = self.rest.full(x)
        out[self.layer.outer] = self.shells.attached(x[self.rows], self.arm)
        return out

    def inner(self, surface: Embedding) -> Embedding:
        """Return what carries `surface` with the inner node in place of every outer one, as rows of `x`."""
        row = self.rest.row.copy()
        row[self.layer.outer] = self.carrier
        return Embedding(np.ascontiguousarray(row[surface.node]), surface.weight.copy())

    @staticmethod
    def turned(weight: Floats, pose: Floats) -> Floats:
        """Return the rotation vectors, (k, 3), of what the bones at `pose` hold by `weight` (k, n_bone)."""
        turn = np.einsum("kb,bij->kij", weight, pose[:, :3, :3])
        return np.asarray(Rotation.from_matrix(turn).as_rotvec())

    @property
    def coupled(self) -> Ints:
        """Pairs of rows that the shell couples, (p, 2)."""
        return pairs(self.node)


def sheet_of(material: Material, law: str, thickness: float) -> Sheet:
    """Return a sheet of a tissue; under "linear" and "neo_hookean" its first constant is the whole shear modulus."""
    half = 0.5 * material.shear_modulus
    c10, c01 = (half, 0.0) if law in ("linear", "neo_hookean") else (material.c10, material.c01)
    return Sheet(law, thickness, material.young_modulus, material.poisson_ratio, c10, c01, DRILLING)


def pairs(node: Ints) -> Ints:
    """Return all pairs within each row of `node` (t, a), (t a^2, 2)."""
    a = node.shape[1]
    return np.unique(np.stack([np.repeat(node, a, axis=1).ravel(), np.tile(node, (1, a)).ravel()], axis=1), axis=0)


class ShellTerm:
    """The energy of a shell: a `newton.Term` of the system that has its rows."""

    def __init__(self, skin: Skin, system: Elements) -> None:
        self.skin, self.shells = skin, skin.shells
        node = skin.node
        i, j = np.repeat(node, 6, axis=1).ravel(), np.tile(node, (1, 6)).ravel()
        self._at = system.entries(i, j).ravel()

    def energy(self, x: Floats) -> float:
        """Return the energy [uJ]."""
        return float(self.shells.energies(x[self.skin.rows]).sum())

    def forces(self, x: Floats) -> Floats:
        """Return minus its gradient, (k + m, 3): forces [mN] and moments [mN mm]."""
        part = self.shells.forces(x[self.skin.rows])
        out = np.empty_like(x)
        for i in range(3):
            out[:, i] = np.bincount(self.skin.node.ravel(), part[:, :, i].ravel(), len(x))
        return out

    def add_tangent(self, x: Floats, values: Floats) -> None:
        """Add its Hessian."""
        self._add(x, values, definite=False)

    def add_definite_tangent(self, x: Floats, values: Floats) -> None:
        """Add its Hessian with the negative eigenvalues of every triangle raised to zero."""
        self._add(x, values, definite=True)

    def _add(self, x: Floats, values: Floats, *, definite: bool) -> None:
        block = self.shells.stiffnesses(x[self.skin.rows], definite=definite)
        split = block.reshape(-1, 6, 3, 6, 3).transpose(0, 1, 3, 2, 4)
        values += np.bincount(self._at, split.ravel(), len(values))


class ShellPulls(Pulls):
    """The muscles of a body whose skin is a shell: they pull at the shell's inner side, as fibres do that end in the dermis.

    Pulls at the outer side would tip the shell's normals over: its bending is softer than a pull on a lever of 2 mm.
    """

    def __init__(self, body: Body, solid: Solid, skin: Skin, system: Elements) -> None:
        inner = skin.inner(solid.skin)
        self.shift: Floats = np.zeros_like(body.surface.points)
        super().__init__(body, system, inner, mass=node_mass(solid, skin))
        self.shift = solid.skin.apply(solid.mesh.points) - np.asarray(self.matrix @ system.points)

    def surface(self, x: Floats) -> Floats:
        """Return where the surface vertices are for the muscles, (n_surface, 3) [mm]: they go along but do not turn."""
        return super().surface(x) + self.shift


def node_mass(solid: Solid, skin: Skin) -> Floats:
    """Return the mass of each row, (k + m,) [kg]: what the outer nodes have is on the inner ones, rotations have none."""
    out = np.concatenate([skin.rest.mass(solid), np.zeros(len(skin.arm))])
    np.add.at(out, skin.carrier, solid.node_mass[skin.layer.outer])
    return out
