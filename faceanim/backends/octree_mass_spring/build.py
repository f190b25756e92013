"""From a body to a lattice: leaves with tissue, held points, and how its surface hangs in a model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from faceanim.backends.nodal import carried, fibre_table, solid_of
from faceanim.backends.octree_mass_spring.cut import box_cut, budget_cut, important_cut, safe_cut
from faceanim.backends.octree_mass_spring.lattice import Lattice
from faceanim.backends.octree_mass_spring.model import Model, Points, assemble, tied
from faceanim.backends.octree_mass_spring.options import Options
from faceanim.backends.octree_mass_spring.simplify import YOUNG
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.geometry import octree
from faceanim.geometry.embedding import Embedding, embed
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import UserError
from faceanim.kernels import muscles


class Flesh:
    """A body as a lattice: what does not depend on the cut.

    lattice : leaves with tissue   skin_leaf : (n_surface,) the leaf of each surface vertex   held : what bones hold
    """

    def __init__(self, body: Body, options: Options) -> None:
        self.body, self.options = body, options
        solid = self.solid = solid_of(body, "octree_mass_spring")
        if not solid.held.any():
            raise UserError(
                "octree_mass_spring: nothing is held, so the body would float away; hold at least three nodes"
            )
        extent = float(np.ptp(solid.mesh.points, axis=0).max())
        side = extent / options.cells if options.cell_size is None else options.cell_size
        tree = octree.from_tets(solid.mesh, side, options.levels)
        self.lattice = self._lattice(tree)
        self.skin_leaf = tree.locate_in(solid.mesh, solid.skin, body.surface.points)
        firm = self._firm(tree)
        place = firm.apply(solid.mesh.points)
        self.held = Points.at(tree, tree.locate_in(solid.mesh, firm, place), place)
        self._held_weight = firm.matrix(len(solid.mesh.points))[:, np.flatnonzero(solid.held)].tocsr()
        self.fibres = fibre_table(body.muscles, len(body.surface.points))

    def _firm(self, tree: octree.Octree) -> Embedding:
        """Return the points that bones carry: the held nodes of the solid, and corners of leaves on held faces between."""
        mesh, held = self.solid.mesh, self.solid.held
        own = np.flatnonzero(held).astype(np.int32)
        node, weight = np.repeat(own[:, None], 4, axis=1), np.tile([1.0, 0.0, 0.0, 0.0], (len(own), 1))
        near = np.flatnonzero(held[mesh.tets].sum(axis=1) >= 2).astype(np.int32)
        if len(near):
            other = embed(mesh, tree.leaves.points, among=near)
            loose = np.where(held[other.node], 0.0, np.abs(other.weight))
            firm = (
                (other.weight > -1e-9).all(axis=1) & (loose < 1e-9).all(axis=1) & (other.weight < 1 - 1e-9).all(axis=1)
            )
            node = np.concatenate([node, other.node[firm]])
            cleaned = np.where(held[other.node[firm]], other.weight[firm], 0.0)
            weight = np.concatenate([weight, cleaned / cleaned.sum(axis=1, keepdims=True)])
        return Embedding(node, weight)

    def carried(self, pose: Floats) -> Floats:
        """Return where the bones at `pose` (n_bone, 4, 4) carry the held points, (p, 3) [mm]."""
        return np.asarray(self._held_weight @ carried(self.solid, pose))

    def _lattice(self, tree: octree.Octree) -> Lattice:
        """Return the lattice: stiffness by the mean modulus in a leaf and its fill, mass by what lies in it."""
        solid, options = self.solid, self.options
        over = tree.overlap
        assert over is not None
        count, cube = len(tree.leaves.index), tree.leaves.side**3
        young = np.array([m.young_modulus for m in solid.materials])[solid.region]
        volume = np.bincount(over.cell, over.volume, count)
        modulus = np.bincount(over.cell, over.volume * young[over.tet], count) / volume
        mass = np.bincount(over.cell, over.volume * solid.density[over.tet], count)
        counted = np.clip(tree.fill, options.floor, 1.0)
        raised = mass * np.maximum(1.0, options.floor * cube / volume)
        return Lattice(
            tree, modulus * tree.leaves.side / YOUNG * counted, raised * mass.sum() / raised.sum(), options.rule,
            options.chain, options.low, options.high, options.ramp,
        )  # fmt: skip

    def first_cut(self, dt: float) -> Ints:
        """Return the leaf levels (c,) that the options ask for; `dt` [s] is the step that "force" must survive."""
        o, lattice = self.options, self.lattice
        tree, coarsest = lattice.tree, min(o.level, lattice.top)
        uniform = np.full(len(lattice.stiffness), coarsest, dtype=np.int32)
        if o.cut == "force":
            return safe_cut(lattice, self.full_pull, dt, o.beta)
        painted = None if o.importance is None else np.asarray(o.importance, dtype=np.float64)
        if painted is not None and painted.shape != (len(self.skin_leaf),):
            raise UserError(f"importance has shape {painted.shape}; ({len(self.skin_leaf)},) is needed")
        if o.cut == "importance":
            if painted is not None:
                return important_cut(tree, self.skin_leaf, painted, coarsest or lattice.top)
            return box_cut(tree, np.asarray(o.box, dtype=np.float64), coarsest or lattice.top)
        if o.cut == "budget":
            value = np.zeros(len(uniform))
            if painted is not None:
                np.maximum.at(value, self.skin_leaf, painted)
            return budget_cut(lattice, o.budget, value)
        return uniform

    def full_pull(self, model: Model) -> Floats:
        """Return the nodal forces (n, 3) [mN] at rest with every muscle at its full pull."""
        control = Control.rest(self.body)
        control.activation[:] = 1.0
        return Rig(self, model).load(control, model.points)[0].copy()

    def rig(self, level: Ints) -> Rig:
        """Return what is stepped at the leaf levels `level` (c,)."""
        o = self.options
        model = assemble(self.lattice, level, ks=o.ks, hard=o.hard, held=self.held)
        model, loose = tied(model, self.held, o.hold * float(np.median(self.lattice.stiffness)))
        return Rig(self, model, loose)


@dataclass(eq=False)
class _Room:
    """Work arrays of a rig."""

    x: Floats
    v: Floats
    x_before: Floats
    v_before: Floats
    force: Floats
    load: Floats
    volume: Floats
    reach: Floats


class Rig:
    """A model in its body: surface, muscles, bones, and room to step in.

    loose : (t',) held points that ties pull, the last ties of the model   dt_max : [s] largest stable step at rest
    """

    def __init__(self, flesh: Flesh, model: Model, loose: Ints | None = None) -> None:
        self.flesh, self.model = flesh, model
        self.loose = np.zeros(0, dtype=np.int32) if loose is None else loose
        node, weight = model.embed(flesh.skin_leaf, flesh.body.surface.points)
        n = len(model.points)
        self.skin = Embedding(np.ascontiguousarray(node), weight).matrix(n)
        self._spread = (sparse.diags((~flesh.body.pinned).astype(np.float64)) @ self.skin).T.tocsr()
        self._surface_force = np.zeros_like(flesh.body.surface.points)
        self.inverse_mass = np.zeros(n)
        free = model.free_mask()
        self.inverse_mass[free] = 1.0 / model.mass[free]
        cells = len(model.corner)
        a, b, c, d, e, f = np.zeros((6, n, 3))
        self.room = _Room(a, b, c, d, e, f, np.zeros(cells), np.zeros(cells))
        self._dt_max: float | None = None

    @property
    def dt_max(self) -> float:
        """Largest stable step at rest [s]."""
        if self._dt_max is None:
            self._dt_max = self.model.largest_step()
        return self._dt_max

    def surface(self, x: Floats, pose: Floats) -> Floats:
        """Return the surface (n_surface, 3) [mm] for nodes at `x` (n, 3); pinned vertices exactly where `pose` puts them."""
        body = self.flesh.body
        out = np.asarray(self.skin @ x)
        rest, weight = body.surface.points[body.pinned], body.attachment.bone_weight[body.pinned]
        moved = np.einsum("bij,nj->nbi", pose[:, :3, :3], rest) + pose[None, :, :3, 3]
        out[body.pinned] = np.einsum("nb,nbi->ni", weight, moved)
        return out

    def load(self, control: Control, x: Floats) -> tuple[Floats, float]:
        """Return outer forces (n, 3) [mN] with the nodes at `x` (n, 3), and their potential [uJ]."""
        body, fibres = self.flesh.body, self.flesh.fibres
        surface, force = self.surface(x, control.bone_pose), self._surface_force
        force[:] = 0.0 if control.force is None else control.force
        potential = -float((force * surface).sum()) - float((self.model.mass @ x) @ control.gravity)
        muscles.pull(fibres, control.activation, control.bone_pose, surface, force)
        nodal = np.asarray(self._spread @ force) + self.model.mass[:, None] * control.gravity
        self.room.load[:] = nodal
        return self.room.load, potential + self._muscle_energy(control, surface) if len(
            body.muscles.names
        ) else potential

    def _muscle_energy(self, control: Control, surface: Floats) -> float:
        """Return the potential of all muscles at `surface` (n_surface, 3) [uJ]."""
        u, pose = self.flesh.body.muscles, control.bone_pose
        pull = control.activation[u.muscle] * u.max_force[u.muscle] * u.weight
        turned = np.einsum("eij,ej->ei", pose[u.bone, :3, :3], u.point)
        away = turned + pose[u.bone, :3, 3] - surface[u.node]
        soft = np.maximum(u.softening, 1e-3)
        near = pull * np.sqrt((away**2).sum(axis=1) + soft**2)
        along = -pull * (turned * surface[u.node]).sum(axis=1)
        return float(np.where(u.kind == 0, near, along).sum())

    def targets(self, held: Floats) -> Floats:
        """Return the targets (t, 3) of all ties when bones carry the held points to `held` (p, 3)."""
        out = np.zeros((len(self.model.tables.ties.stiffness), 3))
        if len(self.loose):
            out[-len(self.loose) :] = held[self.loose]
        return out
