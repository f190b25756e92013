"""The one interface that every backend speaks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np

from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.ground.arrays import Floats


@dataclass(eq=False)
class State:
    """A backend's unknowns: `q` positions or coordinates, `qd` their rates, `t` time [s]."""

    q: Floats
    qd: Floats
    t: float = 0.0

    def copy(self) -> State:
        """Return an independent copy."""
        return State(self.q.copy(), self.qd.copy(), self.t)


@dataclass
class StepReport:
    """What one step cost and how well it ended.

    iterations : sweeps, substeps or Newton steps;  residual : largest unbalanced nodal force [mN]
    seconds : wall time per phase, e.g. {"dynamic": ..., "quasi_static": ...}
    """

    iterations: int = 0
    residual: float = 0.0
    converged: bool = True
    seconds: dict[str, float] = field(default_factory=dict)


class Notices(list[str]):
    """What a solver has left out or has had to do to go on, in words, each said once."""

    def once(self, text: str) -> None:
        """Add `text` unless it is there."""
        if text not in self:
            self.append(text)


@dataclass(frozen=True)
class Energy:
    """Energies [uJ = mN mm]; `total` is what a static solution minimises plus the kinetic part."""

    kinetic: float
    elastic: float
    attachment: float
    contact: float
    muscle: float

    @property
    def total(self) -> float:
        return self.kinetic + self.elastic + self.attachment + self.contact + self.muscle


class Solver(Protocol):
    """A backend bound to one body. All tables are made in the constructor; a step allocates nothing."""

    Options: ClassVar[type]
    dt_max: float

    def __init__(self, body: Body, options: Any) -> None: ...

    def rest(self) -> State:
        """Return a new state: the body at rest."""

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Advance by `dt` [s]; `state_out` may be `state_in`."""

    def solve_static(self, control: Control, guess: State | None = None) -> State:
        """Return the converged equilibrium under a constant control, near `guess` (default: rest) if there are several."""

    def surface(self, state: State, out: np.ndarray) -> None:
        """Write the body's surface points (n, 3) [mm] into `out`: the narrow waist."""

    def energy(self, state: State, control: Control) -> Energy:
        """Return the energies of `state`; for tests, never in the frame loop."""
