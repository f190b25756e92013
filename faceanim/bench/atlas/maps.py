"""Which maps are made of a scene, and the maps over time step, stiffness, mass ratio and activation."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from faceanim.bench.atlas import bodies, limits
from faceanim.bench.atlas.bodies import Tune
from faceanim.bench.atlas.cells import Axis, Cell, Limit, Map, Plan
from faceanim.bench.atlas.schemes import Contender
from faceanim.bench.atlas.trials import (
    SHAKE,
    Goal,
    carried_rest,
    goal_of,
    settling_steps,
    shaken,
    stepped,
    surface,
)
from faceanim.body.body import Body

KINDS = {
    "time": "time step and stiffness",
    "mass": "time step and mass ratio",
    "activation": "activation in one frame and mesh density",
    "force": "force and cell size",
    "poisson": "Poisson's ratio and mesh density",
    "turn": "turning all supports",
    "twist": "twisting one end",
    "bend": "bending one end",
    "starts": "recovering from a bad start by steps",
    "statics": "recovering from a bad start by a static search",
    "stretch": "stretch of elastic laws",
    "nuisance": "things that should not matter",
}
"""Kind of map -> what it is over."""
SCENES = {
    "sheet": ("time", "mass", "activation", "turn", "starts", "statics", "nuisance"),
    "bar": ("time", "mass", "activation", "turn", "twist", "bend", "poisson", "starts", "statics", "nuisance"),
    "block": ("force", "stretch"),
    "face": ("time", "activation", "starts", "statics"),
}
"""Scene -> the maps that are made of it."""
TOLERANCE = 0.05
ACTIVE = 0.5
"""Activation under which time steps are tried."""
FRAME = 1.0 / 60.0
"""Step of the other maps [s]."""


@dataclass(frozen=True)
class Effort:
    """How fine the maps are: "quick", "usual" or "full"; `seconds` of computing for one cell, `idle` steps without drift."""

    name: str
    seconds: float
    idle: int

    @property
    def guard(self) -> float:
        """Seconds by the clock after which a cell is given up, however busy the machine is with other things."""
        return 10.0 * self.seconds + 5.0

    def pick(self, quick: Sequence[Any], usual: Sequence[Any], full: Sequence[Any] | None = None) -> list[Any]:
        """Return what belongs to this effort."""
        return list(quick if self.name == "quick" else usual if self.name == "usual" or full is None else full)


QUICK, USUAL, FULL = Effort("quick", 3.0, 300), Effort("usual", 10.0, 10_000), Effort("full", 900.0, 1_000_000)


@dataclass(frozen=True)
class Scene:
    """A body that can be made again: `make(tune)`, and by its mesh's fineness: `dense(number)`, `densities` in words."""

    name: str
    make: Callable[[Tune], Body]
    dense: Callable[[int], Body]
    densities: list[int] = field(default_factory=list)
    what: str = ""


def small_scene(name: str, effort: Effort) -> Scene:
    """Return the sheet or the bar."""
    if name == "sheet":
        return Scene(name, lambda tune: bodies.skin(tune=tune), lambda n: bodies.skin(bodies.skin_mesh(n)),
                     effort.pick([6, 10], [6, 8, 12, 16], [6, 8, 12, 16, 24, 32]), "squares along a side")  # fmt: skip
    return Scene(
        name, lambda tune: bodies.bar(tune=tune),
        lambda n: bodies.bar(bodies.bar_mesh((n, max(1, n // 3), max(1, n // 3)))),
        effort.pick([4, 6], [4, 6, 9, 12], [4, 6, 9, 12, 18]), "cells along the bar",
    )  # fmt: skip


def map_of(kind: str, scene: str, who: Contender | None, x: Axis, y: Axis, **more: Any) -> Map:
    """Return an empty map; `who` is None where an axis lists the contenders."""
    known: dict[str, Any] = {"tolerance": TOLERANCE, "measure": "largest error over the largest movement"}
    known |= {"title": KINDS[kind] if who is None else who.label} | more
    backend, scheme = ("", "") if who is None else (who.backend, who.scheme)
    key = "/".join(part for part in (scene, kind, backend, scheme, known.pop("of", "")) if part)
    return Map(key, kind, scene, backend=backend, scheme=scheme, x=x, y=y, **known)


def steps_axis(effort: Effort, scene: str) -> Axis:
    """Return time steps from 1/1000 to 1/10 s."""
    count = effort.pick([5 if scene == "sheet" else 3], [13 if scene == "sheet" else 9], [13])[0]
    return Axis("time step", "s", [float(f"{dt:.4g}") for dt in np.geomspace(1e-3, 0.1, count)], log=True)


def time_plans(scene: Scene, whom: Sequence[Contender], effort: Effort) -> list[Plan]:
    """Return the maps over time step and stiffness."""
    coarse = [0.01, 0.1, 1.0, 10.0, 1000.0] if scene.name == "sheet" else [0.01, 1.0, 1000.0]
    factors = effort.pick(coarse, [float(f"{k:.4g}") for k in np.geomspace(0.01, 1000.0, 11)])
    y = Axis("stiffness", "x", factors, log=True)
    x, goals = steps_axis(effort, scene.name), _goals(scene, "stiffness")

    def trial(who: Contender, dt: float, k: float) -> Cell:
        return time_trial(who, goals(who, k), dt, effort)

    return [
        Plan(map_of("time", scene.name, who, x, y, caption=_time_words(scene.name)), partial(trial, who),
             partial(time_limits, scene, who, x, y), effort.guard, partial(_warm_scene, scene, who))
        for who in whom
    ]  # fmt: skip


def _goals(scene: Scene, what: str) -> Callable[[Contender, float], Goal]:
    """Return the equilibrium of a contender by the value of one field of `Tune`, each computed once."""
    return lru_cache(maxsize=None)(lambda who, value: answer(who, scene.make(Tune(**{what: value})), ACTIVE))


def _warm_scene(scene: Scene, who: Contender) -> None:
    warmed(who, scene.make(bodies.PLAIN))


def mass_plans(scene: Scene, whom: Sequence[Contender], effort: Effort) -> list[Plan]:
    """Return the maps over time step and mass ratio: one half of the body lighter, at stiffness 1."""
    y = Axis("mass ratio", "", effort.pick([1.0, 1e4], [1.0, 10.0, 100.0, 1e3, 1e4]), log=True)
    x = Axis("time step", "s", effort.pick([1e-3, 0.01, 0.1], [1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1]), log=True)
    goals = _goals(scene, "light")

    def trial(who: Contender, dt: float, ratio: float) -> Cell:
        return time_trial(who, goals(who, ratio), dt, effort)

    return [
        Plan(map_of("mass", scene.name, who, x, y, caption=_time_words(scene.name)), partial(trial, who), None,
             effort.guard, partial(_warm_scene, scene, who))
        for who in whom
    ]  # fmt: skip


def _time_words(scene: str) -> str:
    return (
        f"The {scene} is shaken at random by {SHAKE:.0%} of its movement, all muscles go to {ACTIVE:g} at once, and it is "
        "stepped until its slowest vibration has died: right if it then stands at its equilibrium."
    )


def answer(who: Contender, body: Body, activation: float, tolerance: float = TOLERANCE) -> Goal:
    """Return the equilibrium of the contender's own model under all muscles, by its static search from rest."""
    control = bodies.pull(body, activation)
    solver = who.make(body)
    points = surface(solver, solver.solve_static(control), body)
    return goal_of(body, points, carried_rest(body, control), tolerance)


def time_trial(who: Contender, goal: Goal, dt: float, effort: Effort, activation: float = ACTIVE) -> Cell:
    """Return whether steps of `dt` [s] from a shaken rest come to the equilibrium."""
    body = goal.body
    solver = who.make(body)
    state = shaken(solver, solver.rest(), body, SHAKE * goal.scale)
    control = bodies.pull(body, activation)
    return stepped(solver, state, goal, control=lambda k: control, dt=dt, steps=settling_steps(body, dt),
                   deadline=effort.seconds)  # fmt: skip


def time_limits(scene: Scene, who: Contender, x: Axis, y: Axis) -> list[Limit]:
    """Return the predicted limits of a scheme, as far as there are any."""
    body = scene.make(bodies.PLAIN)
    solver = who.make(body)
    if hasattr(solver, "rig"):
        made = [scene.make(Tune(stiffness=k)) for k in y.values]
        solvers = [who.make(one) for one in made]
        return [Limit("dt_crit: longer steps are divided", [s.rig(s.base).dt_max for s in solvers], y.values)]
    if not hasattr(solver, "skin_contact") or len(body.mass) > MOST_LINEARISED:
        return []
    control = bodies.pull(body, ACTIVE)
    skin = limits.linearised(body, solver.solve_static(control).q, control)
    dts = np.geomspace(x.values[0], x.values[-1], 25).tolist()
    lines = {
        "explicit": lambda: explicit_lines(skin, dts, "dt = 2 / w_max: longer steps are divided"),
        "explicit, undivided": lambda: explicit_lines(skin, dts, "dt = 2 / w_max"),
        "paper": lambda: paper_lines(skin, dts, secant=True),
        "paper, tangent": lambda: [*paper_lines(skin, dts, secant=False), lag_line(scene, skin, dts, ahead=True)],
        "semi_implicit": lambda: [lag_line(scene, skin, dts, ahead=False)],
    }
    return lines.get(who.scheme, list)()


MOST_LINEARISED = 400
"""Vertices of a skin whose limits are computed."""


def explicit_lines(skin: limits.Linearised, dts: list[float], label: str) -> list[Limit]:
    """Return the limit of leapfrog."""
    square = limits.largest_square(skin)
    return [Limit(label, dts, [limits.explicit_limit(square, skin.drag, dt) for dt in dts])]


def paper_lines(skin: limits.Linearised, dts: list[float], *, secant: bool) -> list[Limit]:
    """Return the limit by the characteristic polynomial or, where a secant sum is negative, by the denominator."""
    vanishing = [limits.secant_limit(skin, dt) for dt in dts]
    if secant and np.isfinite(vanishing).all():
        return [Limit("vanishing denominator", dts, vanishing)]
    if secant:
        few = np.geomspace(dts[0], dts[-1], 7).tolist()
        return [Limit("unstable, by eigenvalues", few, [limits.grown_limit(skin, dt, secant=True) for dt in few])]
    found = limits.modes(skin)
    return [Limit("unstable, closed form", dts, [limits.paper_limit(found, dt, skin.drag) for dt in dts])]


def lag_line(scene: Scene, skin: limits.Linearised, dts: list[float], *, ahead: bool) -> Limit:
    """Return where the schemes with a denominator per vertex are too slow: the price of their artificial inertia."""
    found, body = limits.modes(skin), scene.make(bodies.PLAIN)

    def steps(dt: float, factor: float) -> int:
        return settling_steps(replace(body, attachment=replace(body.attachment,
                              stiffness=factor * body.attachment.stiffness)), dt)  # fmt: skip

    held = [limits.lag_limit(found, dt, skin.drag, partial(steps, dt), TOLERANCE, ahead=ahead) for dt in dts]
    return Limit("lags, closed form", dts, held)


def activation_plans(scene: Scene, whom: Sequence[Contender], effort: Effort) -> list[Plan]:
    """Return the maps over activation, put on in one frame by all muscles, and mesh density."""
    x = Axis("activation", "", effort.pick([-0.5, 0.5, 1.0, 1.5], [-1.0, -0.5, 0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0]))
    y = Axis(scene.what, "", [float(n) for n in scene.densities])
    made = lru_cache(maxsize=None)(lambda n: scene.dense(int(n)))
    goals = lru_cache(maxsize=None)(lambda who, n, a: answer(who, made(n), a))
    caption = (
        "All muscles in one frame, steps of 1/60 s until rest. Outside 0..1 the program should refuse, or answer as at "
        "the nearer end: anything else counts as wrong."
    )

    def trial(who: Contender, a: float, n: float) -> Cell:
        goal = goals(who, n, float(np.clip(a, 0.0, 1.0)))
        if goal.scale < 1e-6:
            goal = Goal(goal.body, goal.points, goals(who, n, 1.0).scale, TOLERANCE)
        return time_trial(who, goal, FRAME, effort, a)

    return [
        Plan(map_of("activation", scene.name, who, x, y, caption=caption), partial(trial, who), None,
             effort.guard, partial(_warm_scene, scene, who))
        for who in whom
    ]  # fmt: skip


def warmed_all(whom: Sequence[Contender], body: Body) -> None:
    """Warm all contenders on `body`."""
    for who in whom:
        warmed(who, body)


_WARM: set[str] = set()


def warmed(who: Contender, body: Body) -> None:
    """Have everything compiled that a contender needs, once; whatever fails here will fail in a trial, with a reason."""
    if who.label in _WARM:
        return
    _WARM.add(who.label)
    with suppress(Exception), warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        solver, control = who.make(body), bodies.pull(body, ACTIVE)
        solver.solve_static(control)
        state = solver.rest()
        for _ in range(3):
            solver.step(state, state, control, FRAME)
