"""Amplitudes of a body under the weighted residual method: how loads drive them and what they do to the surface.

Two models speak the same few words (`Model`). A body in one patch keeps every combination of its trial fields as a
vibration mode, so that it takes any load; a larger body, a face, has one answer per muscle.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy import linalg
from scipy.spatial import cKDTree

from faceanim.backends.nodal import fibre_table
from faceanim.backends.weighted_residual import kernels
from faceanim.backends.weighted_residual.answers import muscle_answers
from faceanim.backends.weighted_residual.kernels import Answers
from faceanim.backends.weighted_residual.options import Options
from faceanim.backends.weighted_residual.patches import Cutter
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.body.solid import Solid
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.cache import content_key, load_arrays, save_arrays
from faceanim.ground.errors import UserError
from faceanim.kernels import muscles

VERSION = "weighted residual answers 5"
NEGLIGIBLE = 0.003
"""Share of an answer's largest displacement that nobody sees."""
STEPS = 64
"""Samples of the curve from activation to amplitude."""


class Model(Protocol):
    """squared : (r,) [1/s^2] of every mode, mass-normalised   answers : what the modes do to the surface [mm]"""

    squared: Floats
    answers: Answers

    def carried(self, pose: Floats, out: Floats) -> None: ...

    def amplitudes(self, q: Floats) -> Floats: ...

    def goal(self, control: Control, carried: Floats) -> Floats: ...

    def work(self, control: Control, q: Floats, carried: Floats) -> float: ...


def _vibrations(mass: Floats, stiff: Floats) -> tuple[Floats, Floats]:
    """Return eigenvalues and vectors of mass against stiffness; raise `UserError` where fields do not fit the body."""
    try:
        period, shape = linalg.eigh(mass, stiff)
    except linalg.LinAlgError:
        raise UserError(
            "weighted_residual: these trial fields are too many for this surface, so that the stiffness is not positive "
            "definite; choose a lower degree (5) or fewer terms, or a finer mesh"
        ) from None
    return period, shape


def packed(fields: Floats, weight: Floats) -> Answers:
    """Return displacements `fields` (r, n, 3) as a table by vertex; what is exactly zero is left out."""
    mode_of = np.abs(fields).max(axis=2) > 0.0
    vertex, mode = np.nonzero(mode_of.T)
    start = np.concatenate([[0], np.cumsum(mode_of.sum(axis=0))]).astype(np.int32)
    value = np.ascontiguousarray(fields[mode, vertex])
    return Answers(start, mode.astype(np.int32), value, np.ascontiguousarray(weight))


class WholeModel:
    """A body in one patch: the modes of its trial fields under their energy and mass, and answers to moving bones.

    Muscles, forces and gravity act on the modes; muscles pull as at the surface that the bones carry, so that the answer
    is linear in the activations.
    """

    def __init__(self, body: Body, solid: Solid, options: Options) -> None:
        self.body, self.solid = body, solid
        mesh = solid.mesh
        cutter = Cutter(solid, options)
        patch = cutter.patch(np.arange(len(mesh.tets), dtype=np.int32), options)
        self.system = system = patch.system
        length = system.length
        nodes = length * system.shapes(mesh.points)  # (n, 3, m)
        rows = nodes.reshape(-1, nodes.shape[2])
        mass = rows.T @ (np.repeat(solid.node_mass, 3)[:, None] * rows)
        stiff = system.young * length**3 * system.matrix
        period, shape = _vibrations(mass, stiff)
        good = period > 1e-12 * period[-1]
        self.squared = 1.0 / period[good]
        self.modes = shape[:, good] * np.sqrt(self.squared)
        self.gravity = np.einsum("n,nam->ma", solid.node_mass, nodes @ self.modes)
        skin = length * system.shapes(body.surface.points) @ self.modes
        skin[body.pinned] = 0.0
        self.skin = np.ascontiguousarray(skin.reshape(-1, len(self.squared)).T)
        self._main = int(np.argmax(solid.bone_weight.sum(axis=0)))
        self._carriage()
        fields = self.skin.reshape(len(self.squared), -1, 3)
        self.answers = packed(fields, self._turning)
        self._fibres = fibre_table(body.muscles, len(body.surface.points))
        self._force = np.zeros_like(body.surface.points)

    def _carriage(self) -> None:
        """Compute what the surface does when each bone moves by each of its 12 affine coefficients."""
        body, system = self.body, self.system
        boundary, bones = system.boundary, len(body.bones)
        held = np.asarray(boundary.prescribed[:, 0])
        weight = np.zeros((len(held), bones))
        weight[held] = self._held_weights(boundary.points[held])
        x = np.concatenate([boundary.points, np.ones((len(held), 1))], axis=1)
        drive = np.einsum("nb,nj->nbj", weight, x)
        points = body.surface.points
        self.travel = np.zeros((points.size, bones * 12))
        shapes = system.length * system.shapes(points)
        for b in range(bones):
            for a in range(3):
                for j in range(4):
                    values = np.zeros_like(boundary.points)
                    values[:, a] = drive[:, b, j]
                    self.travel[:, 12 * b + 4 * a + j] = (shapes @ system.resolve(values)).ravel()
        own = np.concatenate([points, np.ones((len(points), 1))], axis=1)
        pinned = np.flatnonzero(body.pinned)
        table = self.travel.reshape(len(points), 3, bones, 3, 4)
        for a in range(3):
            table[pinned, a] = 0.0
            table[pinned, a, :, a] = body.attachment.bone_weight[pinned][:, :, None] * own[pinned][:, None]
        self._turning = np.einsum("naba->nb", table[..., 3]) / 3.0

    def _held_weights(self, points: Floats) -> Floats:
        """Return the weights of the bones at `points` on held faces, (k, n_bone), from the three nodes around each."""
        mesh, solid = self.solid.mesh, self.solid
        faces = mesh.boundary_triangles[solid.held[mesh.boundary_triangles].all(axis=1)]
        centre = mesh.points[faces].mean(axis=1)
        _, near = cKDTree(centre).query(points)
        corner = mesh.points[faces[near]]
        e1, e2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        normal = np.cross(e1, e2)
        d = points - corner[:, 0]
        square = (normal**2).sum(axis=1)
        v = (np.cross(d, e2) * normal).sum(axis=1) / square
        w = (np.cross(e1, d) * normal).sum(axis=1) / square
        share = np.stack([1.0 - v - w, v, w], axis=1)
        return np.asarray(np.einsum("kc,kcb->kb", share, solid.bone_weight[faces[near]]))

    def carried(self, pose: Floats, out: Floats) -> None:
        """Write where the bones at `pose` take the surface, (n, 3).

        Exact for motions of all bones together; linear in how they move relative to the bone that holds most.
        """
        main = pose[self._main]
        change = (np.linalg.inv(main) @ pose)[:, :3]
        change[:, :, :3] -= np.eye(3)
        local = self.body.surface.points + (self.travel @ change.ravel()).reshape(-1, 3)
        out[:] = local @ main[:3, :3].T + main[:3, 3]

    def _loads(self, control: Control, carried: Floats) -> Floats:
        """Return the generalised forces on the modes, (r,)."""
        force = self._force
        force[:] = 0.0 if control.force is None else control.force
        muscles.pull(self._fibres, control.activation, control.bone_pose, carried, force)
        turn = np.einsum("nb,bij->nij", self.answers.weight, control.bone_pose[:, :3, :3])
        local = np.einsum("nij,ni->nj", turn, force)
        return np.asarray(self.skin @ local.ravel() + self.gravity @ control.gravity)

    def amplitudes(self, q: Floats) -> Floats:
        """Return the amplitudes of the answers in the modal state `q` (r,): the modes are the answers."""
        return q

    def goal(self, control: Control, carried: Floats) -> Floats:
        """Return the modal state at equilibrium, (r,)."""
        return self._loads(control, carried) / self.squared

    def work(self, control: Control, q: Floats, carried: Floats) -> float:
        """Return the work that the loads have done in the modal state `q` [uJ]."""
        return float(self._loads(control, carried) @ q)


class MuscleModel:
    """A body larger than a patch: one answer per muscle, and how far each goes at which activation.

    The compliance and the mass of the answers make modes of them. The amplitude of a muscle is where its pull along its
    own answer, which wanes as fibres reach what they pull towards, balances flesh that stiffens as the strain of its skin
    nears `Options.limit` (see `saturation`). Takes neither gravity nor forces.
    """

    def __init__(self, body: Body, solid: Solid, options: Options) -> None:
        self.body = body
        fields, compliance, mass = kept_answers(body, solid, options)
        acting = np.diag(compliance) > 1e-9 * float(np.diag(compliance).max(initial=0.0))
        self.acting = np.flatnonzero(acting)
        fields = fields[self.acting]
        compliance, mass = (matrix[np.ix_(self.acting, self.acting)] for matrix in (compliance, mass))
        self.activation = np.linspace(0.0, 1.0, STEPS + 1)
        self.curve = np.array(
            [
                saturation(body, int(k), field, compliance[j, j], options.limit, self.activation)
                for j, (k, field) in enumerate(zip(self.acting, fields, strict=True))
            ]
        ).reshape(len(fields), STEPS + 1)
        compliance = 0.5 * (compliance + compliance.T)
        period, shape = linalg.eigh(mass, compliance) if len(fields) else (np.zeros(0), np.zeros((0, 0)))
        self.squared = np.asarray(1.0 / np.maximum(period, 1e-12 * period.max(initial=0.0)))
        self.shape = np.ascontiguousarray(shape * np.sqrt(self.squared))
        self.project = np.ascontiguousarray(self.shape.T @ compliance / self.squared[:, None])
        self.answers = packed(shrunk(fields), body.attachment.bone_weight)
        self._reached = np.zeros(len(fields))

    def carried(self, pose: Floats, out: Floats) -> None:
        """Write where the bones at `pose` take the surface, (n, 3), by the weights of the attachment."""
        kernels.carry(self.body.surface.points, self.body.attachment.bone_weight, pose, out)

    def amplitudes(self, q: Floats) -> Floats:
        """Return the amplitudes of the answers in the modal state `q` (r,)."""
        return np.asarray(self.shape @ q)

    def goal(self, control: Control, carried: Floats) -> Floats:
        """Return the modal state at equilibrium, (r,)."""
        if control.loaded:
            raise UserError(
                "weighted_residual: gravity and forces are taken by bodies no larger than two reaches only; this one "
                "answers its muscles and bones; take finite_elements, or a larger `reach` for a simple shape"
            )
        for j, k in enumerate(self.acting):
            self._reached[j] = np.interp(control.activation[k], self.activation, self.curve[j])
        return np.asarray(self.project @ self._reached)

    def work(self, control: Control, q: Floats, carried: Floats) -> float:
        """Return the work that the muscles have done in the modal state `q` [uJ]."""
        return float((self.squared * self.goal(control, carried)) @ q)


def saturation(body: Body, muscle: int, field: Floats, compliance: float, limit: float, activation: Floats) -> Floats:
    """Return the amplitude of a muscle's answer `field` (n, 3) [mm] at each `activation`.

    Flesh resists amplitude q with compliance * q (1 + (q strain / limit)^2), the muscle pulls along the answer from
    where it has got to. Without either effect the amplitude equals the activation.
    """
    x, edges = body.surface.points, edge_list(body.surface)
    stretch = np.linalg.norm(field[edges[:, 0]] - field[edges[:, 1]], axis=1)
    stretch /= np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    strain = float(np.percentile(stretch[stretch > 1e-3 * stretch.max()], 98.0)) if stretch.max() > 0 else 0.0
    table, pose = fibre_table(body.muscles, len(x)), np.tile(np.eye(4), (len(body.bones), 1, 1))
    full = np.eye(len(body.muscles.names))[muscle]
    amplitude = np.linspace(0.0, 1.5, 4 * STEPS + 1)
    needed = np.zeros_like(amplitude)
    force = np.empty_like(x)
    for i, q in enumerate(amplitude):
        force[:] = 0.0
        muscles.pull(table, full, pose, x + q * field, force)
        pull = max(float((force * field).sum()), 1e-9 * compliance)
        needed[i] = compliance * q * (1.0 + (q * strain / limit) ** 2) / pull
    return np.asarray(np.interp(activation, np.maximum.accumulate(needed), amplitude))


def edge_list(surface: TriMesh) -> Ints:
    """Return the edges of `surface`, those inside it twice, (k, 2)."""
    t = surface.triangles
    return np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])


def shrunk(fields: Floats) -> Floats:
    """Return `fields` (m, n, 3) with what is below `NEGLIGIBLE` of each one's largest displacement taken off smoothly."""
    size = np.linalg.norm(fields, axis=2)
    floor = NEGLIGIBLE * size.max(axis=1, initial=0.0)[:, None]
    factor = np.where(size > floor, 1.0 - (floor / np.where(size > floor, size, 1.0)) ** 2, 0.0)
    return np.asarray(fields * factor[:, :, None])


def kept_answers(body: Body, solid: Solid, options: Options) -> tuple[Floats, Floats, Floats]:
    """Return `muscle_answers`, read from the cache if they were computed before."""
    u, m = body.muscles, solid.mesh
    arrays = (u.max_force, u.muscle, u.node, u.kind, u.bone, u.weight, u.point, u.softening, body.surface.points)
    parts = (body.surface.triangles, body.pinned, m.points, m.tets, solid.region, solid.bone_weight, solid.skin.node)
    key = content_key(VERSION, *arrays, *parts, solid.skin.weight, solid.materials, solid.layer is None, options)
    found = load_arrays("weighted_residual", key) if options.cache else None
    if found is None:
        fields, compliance, mass = muscle_answers(body, solid, options)
        found = {"fields": fields, "compliance": compliance, "mass": mass}
        if options.cache:
            save_arrays("weighted_residual", key, **found)
    return found["fields"], found["compliance"], found["mass"]


def make_model(body: Body, solid: Solid, options: Options) -> Model:
    """Return the model for `body`: whole if it is no larger than two reaches, else by its muscles."""
    size = float(np.linalg.norm(np.ptp(solid.mesh.points, axis=0)))
    whole = size <= 2.0 * options.reach and int(solid.mesh.parts.max()) == 0
    return WholeModel(body, solid, options) if whole else MuscleModel(body, solid, options)
