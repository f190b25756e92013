"""One solver with its state: what the live simulation steps, and exchanges as a whole when a choice changes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np

from faceanim.backends import backend_class, make_solver
from faceanim.backends.solver import State, StepReport
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.expression.action_units import Jaw
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import DivergenceError

STEP = 1.0 / 30.0
"""Time from one update to the next [s]."""
FARTHEST = 1000.0
"""A vertex farther from its place at rest than this [mm] means that the simulation has diverged."""


@dataclass(frozen=True, eq=False)
class Setup:
    """What is simulated: a `body` by a `backend` with its `options` (None = the backend's own)."""

    body: Body
    backend: str = "mass_spring"
    options: Any = None

    def with_scheme(self, scheme: str) -> Setup:
        """Return a copy with another time stepping scheme; raise `UserError` for one that the backend lacks."""
        options = backend_class(self.backend).Options() if self.options is None else self.options
        return replace(self, options=replace(options, scheme=scheme))


def scheme_names(backend: str) -> tuple[str, ...]:
    """Return the time stepping schemes of `backend`, empty if it has no choice."""
    from importlib import import_module

    cls = backend_class(backend)
    if not hasattr(cls.Options(), "scheme"):
        return ()
    return tuple(getattr(import_module(cls.Options.__module__), "SCHEMES", (cls.Options().scheme,)))


class Engine:
    """A solver that is ready to step by `STEP`, its state, and the control it sees.

    points : (n, 3) [mm], the skin after the last step   control : what the last step was asked for
    """

    def __init__(self, setup: Setup, jaw_motion: Any) -> None:
        self.setup, self.names = setup, setup.body.muscles.names
        self.solver = make_solver(setup.backend, setup.body, setup.options)
        self.state: State = self.solver.rest()
        self.control = Control.rest(setup.body)
        self.points: Floats = setup.body.surface.points.copy()
        self.steps = max(1, math.ceil(STEP / min(self.solver.dt_max, STEP) - 1e-9))
        self._jaw_motion = jaw_motion
        self._jaw = next((k for k, bone in enumerate(setup.body.bones) if bone.name == "jaw"), None)

    def warm(self) -> None:
        """Compile and build what stepping needs, on a state that is thrown away."""
        state, control = self.solver.rest(), Control.rest(self.setup.body)
        for most in (0.0, 0.02):
            control.activation[:] = most * np.linspace(0.0, 1.0, len(control.activation))
            self.solver.step(state, state, control, STEP / self.steps)
        self.solver.surface(state, self.points)
        self.points[:] = self.setup.body.surface.points

    def inherit(self, other: Engine) -> None:
        """Go on where `other` is, if both solvers keep the same unknowns; else stay at rest."""
        if type(self.solver) is type(other.solver) and self.state.q.shape == other.state.q.shape:
            self.state = other.state.copy()
            self.points[:] = other.points

    def aim(self, activation: Floats, jaw: Jaw) -> None:
        """Set the control: `activation` (m,) in [0, 1] and the jaw."""
        np.clip(activation, 0.0, 1.0, out=self.control.activation)
        if self._jaw is not None:
            self.control.bone_pose[self._jaw] = self._jaw_motion.pose(jaw.opening, jaw.lateral, jaw.protrusion)

    @property
    def jaw_pose(self) -> Floats:
        """Where the jaw is, (4, 4)."""
        return np.eye(4) if self._jaw is None else self.control.bone_pose[self._jaw]

    def step(self) -> tuple[StepReport, float]:
        """Advance by `STEP`; return the report, iterations added up, and the wall time [s].

        Raises `DivergenceError` when the skin runs away.
        """
        start, total, report = perf_counter(), 0, StepReport()
        for _ in range(self.steps):
            report = self.solver.step(self.state, self.state, self.control, STEP / self.steps)
            total += report.iterations
        self.solver.surface(self.state, self.points)
        farthest = np.abs(self.points - self.setup.body.surface.points).max(initial=0.0)
        if not farthest < FARTHEST:
            raise DivergenceError(f"a vertex has moved {farthest:.3g} mm")
        return replace(report, iterations=total), perf_counter() - start

    def reset(self) -> None:
        """Go back to rest."""
        self.state = self.solver.rest()
        self.control = Control.rest(self.setup.body)
        self.points[:] = self.setup.body.surface.points
