"""From a body to a lattice: leaves with tissue, held points, and how its surface hangs in a model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from faceanim.backends.nodal import carried, carry, fibre_table, solid_of
from faceanim.backends.octree_mass_spring.cut import box_cut, budget_cut, important_cut, safe_cut
from faceanim.backends.octree_mass_spring.lattice import Lattice
from faceanim.backends.octree_mass_spring.model import Model, Points, assemble, tied
from faceanim.backends.octree_mass_spring.options import Options
from faceanim.backends.octree_mass_spring.simplify import YOUNG
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.geometry import octree
from faceanim.geometry.embedding import Embedding, embed
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import UserError
from faceanim.kernels import muscles


class Flesh:
    """A body as a lattice: what does not depend on the cut.

    lattice : leaves with tissue   skin_leaf : (n_surface,) the leaf of each surface vertex   held : what bones hold
    node_leaf : (n_node,) the leaf of each node of the solid   skin : (n_surface, n_node) how these carry the surface
    drag : [1/s]
    """

    def __init__(self, body: Body, options: Options) -> None:
        self.body, self.options = body, options
        solid = self.solid = solid_of(body, "octree_mass_spring")
        extent = float(np.ptp(solid.mesh.points, axis=0).max())
        side = extent / options.cells if options.cell_size is None else options.cell_size
        self.firm = self._firm_elements()
        self.mesh = TetMesh(solid.mesh.points, np.ascontiguousarray(solid.mesh.tets[self.firm]))
        self.within = np.zeros(len(solid.mesh.points), dtype=bool)
        self.within[self.mesh.tets] = True
        tree = octree.from_tets(self.mesh, side, options.levels)
        self.lattice = self._lattice(tree)
        self.node_leaf = self._node_leaf(tree)
        self.skin = solid.skin.matrix(len(solid.mesh.points))
        heaviest = solid.skin.node[np.arange(len(solid.skin.node)), np.argmax(solid.skin.weight, axis=1)]
        self.skin_leaf = self.node_leaf[heaviest]
        firm = self._firm(tree)
        place = firm.apply(solid.mesh.points)
        self.held = Points.at(tree, tree.locate_in(self.mesh, firm, place), place)
        self.hold = self._hold()
        self._held_weight = firm.matrix(len(solid.mesh.points))[:, np.flatnonzero(solid.held)].tocsr()
        self.drag = solid.damping

    def _firm(self, tree: octree.Octree) -> Embedding:
        """Return the points that bones carry: the held nodes of the solid, and corners of leaves on held faces between."""
        mesh, held = self.mesh, self.solid.held & self.within
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

    def _firm_elements(self) -> Bools:
        """Return which elements are flesh (e,): not a film far softer than the body's mean modulus."""
        solid = self.solid
        young = np.array([m.young_modulus for m in solid.materials])[solid.region]
        return young >= self.options.film * np.average(young, weights=solid.mesh.volumes)

    def _node_leaf(self, tree: octree.Octree) -> Ints:
        """Return the leaf of each node of the solid, (n_node,); one in films alone goes with the flesh nearest to it."""
        points, known = self.solid.mesh.points, np.flatnonzero(self.within)
        node = np.arange(len(points), dtype=np.int32)
        _, near = cKDTree(points[known]).query(points[~self.within])
        node[~self.within] = known[near]
        return tree.locate_in(self.mesh, Embedding.of_nodes(node), points)

    def _hold(self) -> Floats:
        """Return the stiffness of the tie of each held point, (p,) [mN/mm]: that of its leaf times an option, shared out."""
        leaf = self.held.leaf
        crowd = np.bincount(leaf, minlength=len(self.lattice.stiffness))[leaf]
        return self.options.hold * self.lattice.stiffness[leaf] / crowd

    def carried(self, pose: Floats) -> Floats:
        """Return where the bones at `pose` (n_bone, 4, 4) carry the held points, (p, 3) [mm]."""
        return np.asarray(self._held_weight @ carried(self.solid, pose))

    def _lattice(self, tree: octree.Octree) -> Lattice:
        """Return the lattice: stiffness by the mean modulus in a leaf and its fill, mass by what lies in it."""
        solid, options = self.solid, self.options
        over = tree.overlap
        assert over is not None
        count, cube = len(tree.leaves.index), tree.leaves.side**3
        young = np.array([m.young_modulus for m in solid.materials])[solid.region[self.firm]]
        volume = np.bincount(over.cell, over.volume, count)
        modulus = np.bincount(over.cell, over.volume * young[over.tet], count) / volume
        mass = np.bincount(over.cell, over.volume * solid.density[self.firm][over.tet], count)
        counted = np.clip(tree.fill, options.floor, 1.0)
        barrier = 0.0 if options.dynamic else options.barrier
        raised = mass * np.maximum(1.0, options.floor * cube / volume)
        return Lattice(
            tree, modulus * tree.leaves.side / YOUNG * counted, raised * mass.sum() / raised.sum(), options.rule,
            options.chain, options.low, options.high, options.ramp, barrier, options.least,
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
        return Rig(self, model).load(control, model.points).copy()

    def rig(self, level: Ints) -> Rig:
        """Return what is stepped at the leaf levels `level` (c,)."""
        o = self.options
        model = assemble(self.lattice, level, ks=o.ks, hard=o.hard, held=self.held)
        model, loose = tied(model, self.held, self.hold)
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


class _Pull:
    """Some muscles of a rig, the numbers `active` (m,), on the vertices that they pull and the cells that carry these."""

    def __init__(self, rig: Rig, active: Ints) -> None:
        self.rig, self.active = rig, active
        muscle = rig.flesh.body.muscles
        mine = np.isin(muscle.muscle, active) & ~rig.flesh.body.pinned[muscle.node]
        self.vertex, row = np.unique(muscle.node[mine], return_inverse=True)
        some = replace(
            muscle, muscle=muscle.muscle[mine], node=row.astype(np.int32), weight=muscle.weight[mine],
            kind=muscle.kind[mine], point=muscle.point[mine], bone=muscle.bone[mine], softening=muscle.softening[mine],
        )  # fmt: skip
        self.fibres = fibre_table(some, len(self.vertex))
        self._row = np.repeat(np.arange(len(self.vertex)), np.diff(self.fibres.start))
        if len(self.vertex):
            self._by_cells, self._by_bones = rig.by_cells[self.vertex], rig.by_bones[self.vertex]
            self._spread = self._by_cells.T.tocsr()
            size = abs(self._by_cells)
            self._lump = (size.T @ sparse.diags(np.asarray(size.sum(axis=1)).ravel())).tocsr()
        self._force = np.zeros((len(self.vertex), 3))

    def _place(self, x: Floats, pose: Floats) -> Floats:
        """Return where the pulled vertices are, (p, 3) [mm]."""
        out = np.asarray(self._by_cells @ x)
        if self._by_bones.nnz:
            out += self._by_bones @ carried(self.rig.flesh.solid, pose)
        return out

    def add(self, x: Floats, control: Control, out: Floats) -> None:
        """Add the nodal forces [mN] at `x` (n, 3) to `out` (n, 3)."""
        if len(self.vertex):
            self._force[:] = 0.0
            place = self._place(x, control.bone_pose)
            muscles.pull(self.fibres, control.activation, control.bone_pose, place, self._force)
            out += self._spread @ self._force

    def energy(self, x: Floats, control: Control) -> float:
        """Return the potential [uJ]."""
        if not len(self.vertex):
            return 0.0
        pose = control.bone_pose
        return float(muscles.pull_energy(self.fibres, control.activation, pose, self._place(x, pose)))

    def stiffness(self, x: Floats, control: Control) -> Floats | None:
        """Return the sums of the rows of the stiffness across the fibres, in size, (n,) [mN/mm]; None if there is none."""
        if not len(self.vertex):
            return None
        f, pose = self.fibres, control.bone_pose
        away = np.einsum("eij,ej->ei", pose[f.bone, :3, :3], f.point) + pose[f.bone, :3, 3]
        away -= self._place(x, pose)[self._row]
        pull = control.activation[f.muscle] * f.strength
        across = np.where(f.kind == 0, pull / np.sqrt((away**2).sum(axis=1) + f.softening**2), 0.0)
        return np.asarray(self._lump @ np.bincount(self._row, across, len(self.vertex)))


class Rig:
    """A model in its body: surface, muscles, bones, and room to step in.

    The nodes of the solid lie inside cells and are carried by their corners, or by bones; they carry the surface.

    loose : (t',) held points that ties pull, the last ties of the model   dt_max : [s] largest stable step at rest
    """

    def __init__(self, flesh: Flesh, model: Model, loose: Ints | None = None) -> None:
        self.flesh, self.model = flesh, model
        self.loose = np.zeros(0, dtype=np.int32) if loose is None else loose
        n, held = len(model.points), flesh.solid.held
        node, weight = model.embed(flesh.node_leaf, flesh.solid.mesh.points)
        self._nodes = Embedding(np.ascontiguousarray(node), weight).matrix(n)
        free = sparse.diags((~held).astype(np.float64))
        self.by_cells = (flesh.skin @ free @ self._nodes).tocsr()
        self.by_bones = flesh.skin[:, np.flatnonzero(held)].tocsr()
        movable = sparse.diags((~flesh.body.pinned).astype(np.float64))
        self._spread = (movable @ self.by_cells).T.tocsr()
        self._pull = _Pull(self, np.zeros(0, dtype=np.int32))
        self.inverse_mass = np.zeros(n)
        moves = model.free_mask()
        self.inverse_mass[moves] = 1.0 / model.mass[moves]
        cells = len(model.corner)
        a, b, c, d, e, f = np.zeros((6, n, 3))
        self.room = _Room(a, b, c, d, e, f, np.zeros(cells), np.zeros(cells))
        self._dt_max: float | None = None

    @cached_property
    def skin(self) -> sparse.csr_matrix:
        """How cells alone would carry the surface, bones or not, (n_surface, n)."""
        return (self.flesh.skin @ self._nodes).tocsr()

    @property
    def dt_max(self) -> float:
        """Largest stable step at rest [s]."""
        if self._dt_max is None:
            self._dt_max = self.model.largest_step(self.flesh.drag)
        return self._dt_max

    def surface(self, x: Floats, pose: Floats) -> Floats:
        """Return the surface (n_surface, 3) [mm] for nodes at `x` (n, 3); pinned vertices exactly where `pose` puts them."""
        body, solid = self.flesh.body, self.flesh.solid
        out = np.asarray(self.by_cells @ x + self.by_bones @ carried(solid, pose))
        pinned = body.pinned
        out[pinned] = carry(body.surface.points[pinned], body.attachment.bone_weight[pinned], pose)
        return out

    def load(self, control: Control, x: Floats) -> Floats:
        """Return outer forces (n, 3) [mN] with the nodes at `x` (n, 3); they are overwritten by the next call."""
        out = self.room.load
        out[:] = self.model.mass[:, None] * control.gravity
        if control.force is not None:
            out += self._spread @ control.force
        self._acting(control).add(x, control, out)
        return out

    def potential(self, control: Control, x: Floats) -> float:
        """Return the potential [uJ] of the outer forces with the nodes at `x` (n, 3)."""
        total = -float((self.model.mass @ x) @ control.gravity)
        if control.force is not None:
            total -= float((control.force * self.surface(x, control.bone_pose)).sum())
        return total + self._acting(control).energy(x, control)

    def lag(self, control: Control, x: Floats, span: float) -> Floats:
        """Return the inverse masses (n,) [1/kg] with which nodes move while the muscles' pull is frozen for `span` [s].

        A muscle close to the point at which it aims holds its nodes by a stiffness k across, often far above that of
        the light cells there; with less mass than 2 k span^2 they would swing about it. Equilibria are not changed.
        """
        hold = self._acting(control).stiffness(x, control)
        if hold is None:
            return self.inverse_mass
        return np.asarray(np.minimum(self.inverse_mass, 0.5 / np.maximum(hold * span**2, 1e-300)))

    def _acting(self, control: Control) -> _Pull:
        """Return the pull of the muscles that are active; kept until others are."""
        active = np.flatnonzero(control.activation).astype(np.int32)
        if not np.array_equal(active, self._pull.active):
            self._pull = _Pull(self, active)
        return self._pull

    def targets(self, held: Floats) -> Floats:
        """Return the targets (t, 3) of all ties when bones carry the held points to `held` (p, 3)."""
        out = np.zeros((len(self.model.tables.ties.stiffness), 3))
        if len(self.loose):
            out[-len(self.loose) :] = held[self.loose]
        return out
