"""Maps of bad starts: vertices at random, flattened bodies, inverted elements; then the body must come back to rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from faceanim.bench.atlas.cells import REFUSED, Axis, Cell, Plan
from faceanim.bench.atlas.maps import FRAME, Effort, map_of, warmed_all
from faceanim.bench.atlas.schemes import Contender
from faceanim.bench.atlas.trials import Goal, holds_positions, said_of, settling_steps, stepped, surface
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.ground.arrays import Floats, Ints

STARTS = ("noise 5 %", "random", "plane", "line", "point", "one inverted", "half inverted")
LIPS = "lips 10 mm inside"
TOLERANCE = 0.01
"""In sizes of the body."""
Corners = Ints
"""(e, 3 | 4) the elements that are turned inside out."""


def spoilt(x: Floats, start: str, free: Ints, corners: Corners) -> Floats:
    """Return the positions `x` (n, 3) [mm] spoilt as `start` says; only the `free` vertices are moved."""
    rng = np.random.default_rng(2)
    out, middle, size = x.copy(), x.mean(axis=0), np.ptp(x, axis=0).max()
    if start.startswith("noise"):
        out[free] += 0.05 * size * rng.standard_normal((len(free), 3))
    elif start == "random":
        out[free] = middle + size * (rng.random((len(free), 3)) - 0.5)
    elif start in ("plane", "line", "point"):
        flat = {"plane": 1, "line": 2, "point": 3}[start]
        across = np.argsort(np.ptp(x, axis=0), kind="stable")[:flat]
        out[np.ix_(free, across)] = middle[across]
    else:
        may = np.isin(corners, free)
        chosen = np.flatnonzero(may.any(axis=1))
        chosen = chosen[len(chosen) // 2 :][:1] if start == "one inverted" else chosen[::2]
        for e in chosen:
            _mirror(out, corners[e], int(np.argmax(may[e])))
    return out


def _mirror(x: Floats, corner: Ints, which: int) -> None:
    """Reflect one corner of an element in the side that faces it, in place."""
    others = np.delete(corner, which)
    a, rest = x[others[0]], x[others[1:]] - x[others[0]]
    away = x[corner[which]] - a
    if len(rest) == 2:
        normal = np.cross(rest[0], rest[1])
        x[corner[which]] -= 2.0 * normal * (normal @ away) / max(float(normal @ normal), 1e-30)
    else:
        along = rest[0] * (rest[0] @ away) / max(float(rest[0] @ rest[0]), 1e-30)
        x[corner[which]] -= 2.0 * (away - along)


def spoil(solver: Any, body: Body, start: str) -> Any:
    """Return the solver's state at rest spoilt as `start` says, None if its unknowns cannot hold such a shape."""
    state = solver.rest()
    if not holds_positions(solver, state, body):
        if start not in ("noise 5 %", "random"):
            return None
        size = 0.05 if start.startswith("noise") else 0.5
        state.q[:] = np.random.default_rng(2).standard_normal(state.q.shape)
        reach = np.abs(surface(solver, state, body) - body.surface.points).max()
        state.q *= size * np.ptp(body.surface.points, axis=0).max() / reach
        return state
    free, corners = _free_and_elements(solver, state, body)
    if start == LIPS:
        lips = [pair.node for pair in body.pairs if "lip" in pair.name]
        state.q[np.intersect1d(np.concatenate([*lips, free[:0]]), free), 2] -= 10.0
        return state
    state.q[:] = spoilt(state.q, start, free, corners)
    return state


def _free_and_elements(solver: Any, state: Any, body: Body) -> tuple[Ints, Corners]:
    """Return which of the unknown positions are free, and the elements over them."""
    if body.solid is not None and hasattr(solver, "elements"):
        return np.flatnonzero(~body.solid.held).astype(np.int32), body.solid.mesh.tets
    if hasattr(solver, "rig"):
        rig = solver.rig(state.level)
        return np.flatnonzero(rig.inverse_mass > 0.0).astype(np.int32), rig.model.tables.cells.corner[:, [0, 1, 2, 4]]
    return np.flatnonzero(~body.pinned).astype(np.int32), body.surface.triangles


def starts_plans(
    kind: str, scene: str, make: Callable[[], Body], whom: Sequence[Contender], effort: Effort, *, lips: bool = False
) -> list[Plan]:
    """Return one map, start against contender: recovery by steps of 1/60 s ("starts") or by a static search ("statics")."""
    by_label = {who.label: who for who in whom}
    words = effort.pick(STARTS[1:4] + STARTS[5:], STARTS) + ([LIPS] if lips else [])
    body_of: list[Body] = []

    def trial(start: str, label: str) -> Cell:
        body = body_of[0] if body_of else make()
        body_of[:] = [body]
        return recovery(by_label[label], body, start, effort, static=kind == "statics")

    how = (
        "sought from there by a static search" if kind == "statics" else "stepped by 1/60 s until it should be at rest"
    )
    planned = map_of(kind, scene, None, Axis.of_words("start", words), Axis.of_words("scheme", list(by_label)),
                     tolerance=TOLERANCE, measure="largest distance from rest over the body's size",
                     caption=f"Nothing acts, the start is spoilt, the rest shape is {how}.")  # fmt: skip
    return [Plan(planned, trial, None, effort.guard, lambda: warmed_all(whom, make()))] if by_label else []


def recovery(who: Contender, body: Body, start: str, effort: Effort, *, static: bool) -> Cell:
    """Return whether a spoilt body comes back to rest."""
    solver, control = who.make(body), Control.rest(body)
    rest = surface(solver, solver.rest(), body)
    goal = Goal(body, rest, float(np.ptp(rest, axis=0).max()), TOLERANCE)
    state = spoil(solver, body, start)
    if state is None:
        return Cell(REFUSED, "its unknowns are amplitudes, which cannot hold such a shape")
    if static:
        found = solver.solve_static(control, guess=state)
        return goal.judged(solver, found, goal.error(surface(solver, found, body)), 1, said_of(solver))
    steps = min(600, 2 * settling_steps(body, FRAME))
    return stepped(solver, state, goal, control=lambda k: control, dt=FRAME, steps=steps, deadline=effort.seconds)
