"""Backends that are wrong on purpose, to see that comparisons and maps notice."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from faceanim.backends.finite_elements.options import Options
from faceanim.backends.finite_elements.solver import SolverFiniteElements
from faceanim.backends.solver import State, StepReport
from faceanim.body.control import Control


class Broken(SolverFiniteElements):
    """Takes no step at all: the state stays at rest."""

    Options: ClassVar[type] = Options

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Only time goes on."""
        state_out.q[:], state_out.qd[:] = state_in.q, state_in.qd
        state_out.t = state_in.t + dt
        return StepReport(1)


class Exploding(Broken):
    """Every step makes the displacement, and a little noise, twenty times larger."""

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Grow."""
        rest = self.elements.points
        offset = state_in.q - rest + 1e-3 * np.sin(np.arange(rest.size)).reshape(rest.shape)
        out = super().step(state_in, state_out, control, dt)
        state_out.q[:] = rest + 20.0 * offset
        return out


class NotANumber(Broken):
    """Every step gives NaN."""

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Lose it."""
        out = super().step(state_in, state_out, control, dt)
        state_out.q[:] = np.nan
        return out


class InsideOut(Broken):
    """Mirrors the body: finite, and inside out."""

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Shake every other node by more than an element's size."""
        out = super().step(state_in, state_out, control, dt)
        state_out.q[::2] = self.elements.points[::2] + np.array([25.0, -25.0, 25.0])
        return out


class Starving(Broken):
    """Runs out of memory."""

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Give up."""
        raise MemoryError("no room")


def registry() -> dict[str, Any]:
    """Return the entries for `BACKENDS`."""
    kinds = {"frozen": Broken, "exploding": Exploding, "nan": NotANumber, "inside_out": InsideOut, "starving": Starving}
    return {name: f"broken:{cls.__name__}" for name, cls in kinds.items()}
