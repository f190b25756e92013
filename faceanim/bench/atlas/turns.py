"""Maps over rotation angles: all supports turned, one end twisted, one end bent round; the answer is kinematics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from faceanim.bench.atlas import bodies
from faceanim.bench.atlas.cells import Axis, Cell, Limit, Plan
from faceanim.bench.atlas.limits import turn_of_loss
from faceanim.bench.atlas.maps import FRAME, Effort, map_of, warmed_all
from faceanim.bench.atlas.schemes import Contender
from faceanim.bench.atlas.trials import Goal, settling_steps, stepped
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.ground.arrays import Floats

OBLIQUE = (1.0, 1.0, 0.5)
"""Axis about which all supports turn."""
LENGTH = bodies.SLENDER[0]
DEGREES = {"turn": (45, 90, 135, 180, 270, 360), "twist": (45, 90, 180, 360, 720, 1080, 1440),
           "bend": (30, 60, 90, 120, 180, 270, 360)}  # fmt: skip
A_STEP = 10.0
"""The bones turn by so many degrees in a step."""
TOLERANCE = 0.05
"""In lengths of the bar: half of its width."""
CAPTIONS = {
    "turn": "Both bones turn together about an oblique axis: the answer is the turned rest shape.",
    "twist": "One end is twisted: the answer is every section turned in proportion to its place.",
    "bend": "One end is led round a circle: the answer is the circular arc of the bar's length (no bar of the mechanics "
    "of materials, but within the tolerance of one).",
}


def _rotation(axis: tuple[float, float, float], angle: float) -> Floats:
    n = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -n[2], n[1]], [n[2], 0.0, -n[0]], [-n[1], n[0], 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross))


def _section(kind: str, share: float, angle: float) -> tuple[Floats, Floats]:
    """Return rotation and place of the section at `share` of the length when the far end goes by `angle` [rad]."""
    if kind == "twist":
        return _rotation((1.0, 0.0, 0.0), angle * share), np.array([share * LENGTH, 0.0, 0.0])
    bend = angle * share
    place = np.array([np.sinc(bend / np.pi), 0.5 * bend * np.sinc(0.5 * bend / np.pi) ** 2, 0.0]) * share * LENGTH
    return _rotation((0.0, 0.0, 1.0), bend), place


def moved(kind: str, points: Floats, angle: float) -> Floats:
    """Return where the answer has the `points` (n, 3) [mm]."""
    out = np.empty_like(points)
    if kind == "turn":
        return np.asarray(points @ _rotation(OBLIQUE, angle).T)
    for i, p in enumerate(points):
        turn, place = _section(kind, p[0] / LENGTH, angle)
        out[i] = place + turn @ np.array([0.0, p[1], p[2]])
    return out


def posed(kind: str, body: Body, angle: float) -> Control:
    """Return the control that holds both ends where the answer has them."""
    control = Control.rest(body)
    if kind == "turn":
        control.bone_pose[:, :3, :3] = _rotation(OBLIQUE, angle)
        return control
    for bone, share in enumerate((0.0, 1.0)):
        turn, place = _section(kind, share, angle)
        control.bone_pose[bone, :3, :3] = turn
        control.bone_pose[bone, :3, 3] = place - turn @ np.array([share * LENGTH, 0.0, 0.0])
    return control


def turn_plans(kind: str, scene: str, whom: Sequence[Contender], effort: Effort) -> list[Plan]:
    """Return one map, angle against contender; the scene "sheet" turns skin on bone, others a bar."""
    body = bodies.skin() if scene == "sheet" else bodies.slender()
    degrees = effort.pick(DEGREES[kind][1:5:2] + DEGREES[kind][-1:], DEGREES[kind])
    by_label = {who.label: who for who in whom}
    x, y = Axis("angle", "degrees", [float(d) for d in degrees]), Axis.of_words("scheme", list(by_label))

    def trial(angle: float, label: str) -> Cell:
        solver = by_label[label].make(body)
        goal = Goal(body, moved(kind, body.surface.points, math.radians(angle)), LENGTH, TOLERANCE)
        steps = max(1, math.ceil(angle / A_STEP))
        controls = [posed(kind, body, math.radians(angle) * (k + 1) / steps) for k in range(steps)]
        rest = min(240, settling_steps(body, FRAME))
        return stepped(solver, solver.rest(), goal, control=lambda k: controls[min(k, steps - 1)], dt=FRAME,
                       steps=steps + rest, deadline=effort.seconds)  # fmt: skip

    planned = map_of(kind, scene, None, x, y, tolerance=TOLERANCE, measure="largest error over the bar's length",
                     caption=f"{CAPTIONS[kind]} {A_STEP:g} degrees a step of 1/60 s, then rest.")  # fmt: skip
    warm = partial(warmed_all, whom, body)
    return [Plan(planned, trial, lambda: _limits(kind, y), effort.guard, warm)] if by_label else []


def _limits(kind: str, y: Axis) -> list[Limit]:
    """Return where warping by one rotation per node is singular and, bent, where it has lost the tolerated length."""
    rows = [k for k, word in enumerate(y.words) if word.split(": ")[-1] in ("warped", "consistent")]
    if not rows or kind == "turn":
        return []
    places = [float(k) for k in rows]
    out = [Limit("warp singular (2 pi)", [360.0] * len(rows), places)]
    if kind == "bend":
        lost = math.degrees(turn_of_loss(TOLERANCE))
        out.append(Limit(f"{TOLERANCE:.0%} of the length lost by a free end", [lost] * len(rows), places))
    return out
