"""The skin after an operation: a body whose flesh goes with the pieces of bone, and its equilibrium."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from faceanim.backends import backend_class, make_solver
from faceanim.body.body import Body, Bone, BoneContact
from faceanim.body.control import Control
from faceanim.body.solid import Solid
from faceanim.face import attach
from faceanim.face.tissue_carry import four_weights
from faceanim.face.tissue_volume import flesh
from faceanim.geometry.closing import together
from faceanim.geometry.distance import DistanceGrid
from faceanim.geometry.distance_field import signed_distance_grid
from faceanim.geometry.embedding import Embedding
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import RunError
from faceanim.ground.notes import tell
from faceanim.surgery import cut
from faceanim.surgery.operation import Operation, bone_shares, operate
from faceanim.surgery.plan import Plan

if TYPE_CHECKING:
    from faceanim.backends.solver import State
    from faceanim.face.face import Face

BLEND = 8.0
"""Width of the change from a piece of bone to its neighbour, for the flesh on them [mm]."""
CLEAR = 0.05
"""A bone with less than this share of a node does not carry it: rigid skin needs nodes that only one bone carries."""
LOAD_STEP = 3.0
"""Bones go at most so far before the flesh finds its balance [mm]; steps below 3 mm are the paper's."""


CONTACT_SPACING, CONTACT_BAND = 1.75, 8.0
"""Of the distance grids with which skin meets the bones [mm]."""


def surgical_body(operation: Operation, *, contact: bool = True) -> Body:
    """Return the head with the bones of an operation: cranium, jaw, and every piece that was cut out of them.

    Flesh, skin and muscles on a bone go to the piece of it on which they sit; scalp, ears and collar stay.
    contact : whether skin and bones know of each other, as backends without a volume need; it takes a second or two
    """
    face = operation.face
    body = face.body()
    stays = _stays(face)
    skin = _weights(operation, face.mesh.points, face.bone_weight, stays)
    muscles = body.muscles
    on = np.eye(2)[np.minimum(muscles.bone, 1)]
    carrier = bone_shares(operation, muscles.point, on, BLEND).argmax(axis=1)
    grids = _contact_grids(operation) if contact else None
    return replace(
        body,
        bones=tuple(
            Bone(name, grids[k] if grids else None, together([operation.bones[k], *operation.teeth(k)]))
            for k, name in enumerate(operation.names)
        ),
        attachment=replace(body.attachment, bone_weight=skin),
        muscles=replace(muscles, bone=carrier.astype(np.int32)),
        bone_contact=_bone_contact(face, grids) if grids else None,
        volume=lambda: surgical_flesh(operation),
    )


def _contact_grids(operation: Operation) -> tuple[DistanceGrid, ...]:
    """Return the signed distance to every bone with its teeth and gums, at rest."""
    return tuple(
        signed_distance_grid(
            [cut.joined([bone, *operation.teeth(k)])], spacing=CONTACT_SPACING, margin=CONTACT_BAND, band=CONTACT_BAND
        )
        for k, bone in enumerate(operation.bones)
    )


def _bone_contact(face: Face, grids: tuple[DistanceGrid, ...]) -> BoneContact:
    movable = np.isin(face.region, (attach.SKIN, attach.LIP)) & ~face.pinned
    clearance = face.tissue.contact.bone_clearance
    return attach.bone_contact(face.mesh.points, movable, grids, 0.99 * CONTACT_BAND, clearance)


def _stays(face: Face) -> Bools:
    """Return the skin that no operation moves: scalp, ears, the collar and the depth of the lids, (n,).

    Lids end on the eyeball, which stays where it is.
    """
    ends = np.isin(face.region, (attach.NECK, attach.LID)) & face.pinned
    return np.asarray((face.region == attach.SCALP) | (face.region == attach.EAR) | ends)


def _weights(operation: Operation, points: Floats, weight: Floats, stays: Bools) -> Floats:
    """Return the share of every bone in carrying `points`, from those of cranium and jaw, (n, n_bone)."""
    out = np.zeros((len(points), len(operation.names)))
    out[stays, :2] = weight[stays]
    out[~stays] = bone_shares(operation, points[~stays], weight[~stays], BLEND)
    return out


def surgical_flesh(operation: Operation) -> Solid:
    """Return the flesh of a head with its held nodes on the bones of an operation."""
    face = operation.face
    made = flesh(face)
    solid, points = made.solid, made.solid.mesh.points
    column = np.repeat(np.arange(len(made.vertex)), len(points) // len(made.vertex))
    weight = held_weights(operation, points, solid.bone_weight, made.vertex[column])
    return replace(solid, bone_weight=weight, skin=_carrier(operation, solid, weight))


def held_weights(operation: Operation, points: Floats, weight: Floats, vertex: Ints) -> Floats:
    """Return the share of every bone of an operation in holding nodes of the flesh, (k, n_bone).

    points : (k, 3) [mm] at rest   weight : (k, 2) of cranium and jaw   vertex : (k,) skin vertex above each node
    """
    return _clear(_weights(operation, points, weight, _stays(operation.face)[vertex]))


def _clear(weight: Floats) -> Floats:
    """Return shares (n, n_bone) in which a bone with nearly all of a node has it whole, and one with hardly any none."""
    total = weight.sum(axis=1, keepdims=True)
    clear = np.clip((weight - CLEAR) / (1.0 - 2.0 * CLEAR), 0.0, 1.0)
    return np.asarray(np.where(total > 0.5, clear / np.maximum(clear.sum(axis=1, keepdims=True), 1e-12), 0.0))


def _carrier(operation: Operation, solid: Solid, weight: Floats) -> Embedding:
    """Return what carries the skin: its flesh as before, and where bone carries it, four nodes of each bone."""
    face, old = operation.face, solid.skin
    amount = np.stack([old.weight[:, 4 + 4 * b : 8 + 4 * b].sum(axis=1) for b in range(2)], axis=1)
    share = _weights(operation, face.mesh.points, amount, _stays(face))
    nodes, weights = [old.node[:, :4]], [old.weight[:, :4].copy()]
    for bone in range(len(operation.names)):
        held = np.flatnonzero(weight[:, bone] > 1.0 - 1e-12)
        frame = held[_far_apart(solid.mesh.points[held])] if len(held) > 3 else held
        if not _spans(solid.mesh.points[frame]):  # too little of that bone carries flesh: its parent takes the skin
            share[:, operation.parents[bone]] += share[:, bone] if bone > 1 else 0.0
            continue
        corner = np.broadcast_to(solid.mesh.points[frame], (len(share), 4, 3))
        nodes.append(np.broadcast_to(frame.astype(np.int32), (len(share), 4)))
        weights.append(share[:, bone, None] * four_weights(corner, face.mesh.points))
    weight = np.concatenate(weights, axis=1)
    return Embedding(
        np.ascontiguousarray(np.concatenate(nodes, axis=1), dtype=np.int32),
        np.ascontiguousarray(weight / weight.sum(axis=1, keepdims=True)),
    )


def _far_apart(points: Floats) -> Ints:
    """Return four points, (4,), that span a large tetrahedron: each is as far as can be from those before it."""
    middle = points - points.mean(axis=0)
    basis = np.zeros((0, 3))
    chosen = [int(np.argmax((middle**2).sum(axis=1)))]
    for _ in range(3):
        side = points - points[chosen[0]]
        left = side - side @ basis.T @ basis
        chosen.append(int(np.argmax((left**2).sum(axis=1))))
        basis = np.concatenate([basis, left[chosen[-1:]] / max(float(np.linalg.norm(left[chosen[-1]])), 1e-12)])
    return np.array(chosen, dtype=np.int32)


def _spans(points: Floats) -> bool:
    """Whether four points span a tetrahedron of a cubic millimetre at least."""
    return len(points) == 4 and abs(float(np.linalg.det(points[1:] - points[0]))) > 6.0


@dataclass
class Prediction:
    """The skin that an operation gives.

    points : (n, 3) [mm], the skin of the face   fraction : of the bones' way that was reached; 1 = all
    failure : why it ended before the end, None = it did not   reports : of each load step, as the backend tells it
    seconds : wall time of "body", "solver", "solve"
    """

    operation: Operation
    body: Body
    backend: str
    options: Any
    solver: Any
    state: State
    points: Floats
    fraction: float = 0.0
    failure: str | None = None
    steps: int = 1
    reports: list[Any] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def poses(self) -> Floats:
        """Poses of the bones that the flesh has followed, (n_bone, 4, 4)."""
        return self.operation.poses(self.fraction)

    @property
    def nodes(self) -> Floats | None:
        """Positions of the flesh's nodes, (n_node, 3) [mm]; None for a backend that has none."""
        if hasattr(self.solver, "nodes"):
            return np.asarray(self.solver.nodes(self.state))
        solid, q = self.body.solid if self.body.volume is not None else None, self.state.q
        if solid is None or q.ndim != 2 or q.shape[1:] != (3,) or len(q) < len(solid.mesh.points):
            return None
        return np.asarray(q[: len(solid.mesh.points)])

    def raise_failure(self) -> None:
        """Raise `RunError` if the end was not reached."""
        if self.failure is not None:
            raise RunError(self.failure)


def predict(
    face: Face,
    plan: Plan | Operation,
    *,
    backend: str = "finite_elements",
    options: Any = None,
    steps: int | None = None,
    body: Body | None = None,
    heard: Callable[[int, int], None] | None = None,
) -> Prediction:
    """Return the skin of `face` after the operation, muscles at rest.

    backend, options : who finds the balance, as `make_solver` takes them   body : another body for the same bones
    steps : load steps over which the bones move evenly; None = so many that none moves farther than `LOAD_STEP`
    heard : is told after each of them how many of how many are done
    A balance that cannot be found ends the search: the last one found is returned with its `fraction` and `failure`.
    Raises `UserError` for a plan that does not fit the skull.
    """
    started = perf_counter()
    operation = plan if isinstance(plan, Operation) else operate(face, plan)
    if body is None:
        body = surgical_body(operation, contact=getattr(backend_class(backend), "skin_contact", False))
    if body.volume is not None:
        assert body.solid is not None
    seconds = {"body": perf_counter() - started}
    started = perf_counter()
    solver = make_solver(backend, body, options)
    seconds["solver"] = perf_counter() - started
    steps = max(1, math.ceil(operation.travel / LOAD_STEP - 1e-9)) if steps is None else steps
    out = Prediction(operation, body, backend, solver.options, solver, solver.rest(), np.array(body.surface.points))
    out.steps, out.seconds = steps, seconds
    started = perf_counter()
    _follow(out, heard or (lambda done, total: tell("moving the bones", done, total)))
    solver.surface(out.state, out.points)
    seconds["solve"] = perf_counter() - started
    return out


def _follow(out: Prediction, heard: Callable[[int, int], None]) -> None:
    """Move the bones step by step, the flesh in balance after each, as far as that goes."""
    control = Control.rest(out.body)
    heard(0, out.steps)
    for k in range(out.steps):
        control.bone_pose[:] = out.operation.poses((k + 1) / out.steps)
        try:
            out.state = out.solver.solve_static(control, out.state)
        except RunError as error:
            _give_up(out, k, error)
            return
        out.reports.append(getattr(out.solver, "static_report", None))
        out.fraction = (k + 1) / out.steps
        heard(k + 1, out.steps)


def _give_up(out: Prediction, k: int, error: RunError) -> None:
    """Keep the last balance on the way and say how far it is."""
    report, last = getattr(out.solver, "static_report", None), getattr(out.solver, "last_static", None)
    if last is not None and np.isfinite(last.q).all():
        out.state = last.copy()
        part = float(getattr(report, "fraction", 0.0))
        out.fraction = (k + part) / out.steps
    cause = str(error).split(";")[0]
    out.failure = (
        f"{out.operation.plan.title}: the flesh followed {out.fraction:.1%} of the bones' way, then no balance was "
        f"found ({cause}); move the bones less, take more --steps, a finer --density or another --backend"
    )
