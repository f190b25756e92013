"""A solver that follows bones for a while and then finds no balance, to test what is kept of a run that fails."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from faceanim.backends.nodal import carried
from faceanim.backends.solver import State
from faceanim.ground.errors import RunError


@dataclass(frozen=True)
class Options:
    """steps : how many balances are found"""

    steps: int = 1


@dataclass
class Report:
    """fraction : of the last step"""

    fraction: float = 1.0


class SolverHalting:
    """Held nodes go with their bones, the others stay; after `steps` balances it stops half-way to the next."""

    Options: ClassVar[type] = Options

    def __init__(self, body: Any, options: Any = None) -> None:
        self.body, self.options = body, options or Options()
        self.solid, self.found = body.solid, 0
        self.static_report, self.last_static = Report(), self.rest()

    def rest(self) -> State:
        """Return the nodes at rest."""
        points = self.solid.mesh.points
        return State(points.copy(), np.zeros_like(points))

    def solve_static(self, control: Any, guess: State | None = None) -> State:
        """Carry the held nodes, all the way or half of it."""
        begin = self.rest() if guess is None else guess.copy()
        goal = begin.copy()
        goal.q[self.solid.held] = carried(self.solid, control.bone_pose)
        if self.found == self.options.steps:
            self.static_report, self.last_static = Report(0.5), State(0.5 * (begin.q + goal.q), goal.qd)
            raise RunError("halting: no equilibrium beyond 50 %; it never goes farther")
        self.found += 1
        self.last_static = goal
        return goal.copy()

    def surface(self, state: State, out: np.ndarray) -> None:
        """Write the skin that the nodes carry."""
        out[:] = self.solid.skin.apply(state.q)
