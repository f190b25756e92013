"""The weighted residual backend behind the `Solver` protocol."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from faceanim.backends.nodal import push_out, solid_of
from faceanim.backends.solver import Energy, Notices, State, StepReport
from faceanim.backends.weighted_residual import kernels
from faceanim.backends.weighted_residual.model import Model, make_model
from faceanim.backends.weighted_residual.options import Options
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import DivergenceError, UserError


@dataclass(eq=False)
class StateWeightedResidual(State):
    """Modal amplitudes `q` (r,), their rates `qd` (r,), and the poses of the bones, (n_bone, 4, 4)."""

    pose: Floats = field(default_factory=lambda: np.zeros((0, 4, 4)))

    def copy(self) -> StateWeightedResidual:
        """Return an independent copy."""
        return StateWeightedResidual(self.q.copy(), self.qd.copy(), self.t, self.pose.copy())


class SolverWeightedResidual:
    """Linear elasticity from exact fields fitted at the boundary; see `Options`.

    The surface goes with its bones at once; what loads add to it is a sum of answers, turned with the bones, whose
    amplitudes follow their equilibrium as the body's damped vibrations do, exactly for loads constant over a step
    (`dt_max` is infinite). Modes feel no contact: where the surface would enter an eyeball it is only shown outside.
    notices : what the user should know, each once
    """

    Options: ClassVar[type] = Options

    def __init__(self, body: Body, options: Any = None) -> None:
        self.body = body
        self.options: Options = Options() if options is None else options
        self.solid = solid_of(body, "weighted_residual")
        self.model: Model = make_model(body, self.solid, self.options)
        self.damping = self.solid.damping + self.solid.stiffness_damping * self.model.squared
        self.notices = Notices()
        self.dt_max = np.inf
        self._pose = np.zeros((len(body.bones), 4, 4))
        self._carried = np.empty_like(body.surface.points)
        self._steps: dict[float, Floats] = {}
        self._still = np.tile(np.eye(4), (len(body.bones), 1, 1))

    def rest(self) -> StateWeightedResidual:
        """Return a new state: the body at rest."""
        r = len(self.model.squared)
        return StateWeightedResidual(np.zeros(r), np.zeros(r), 0.0, self._still.copy())

    def carried(self, pose: Floats) -> Floats:
        """Return where the bones at `pose` take the surface, (n, 3) [mm]; overwritten by the next call."""
        if not np.array_equal(pose, self._pose):
            self._pose[:] = pose
            self.model.carried(self._pose, self._carried)
        return self._carried

    def surface(self, state: State, out: np.ndarray) -> None:
        """Write the surface points (n, 3) [mm] into `out`."""
        assert isinstance(state, StateWeightedResidual)
        out[:] = self.carried(state.pose)
        turned = not np.array_equal(state.pose, self._still)
        kernels.add_answers(self.model.answers, self.model.amplitudes(state.q), state.pose, turned, out)
        push_out(out, self.body)

    def propagator(self, dt: float) -> Floats:
        """Return the exact step of length `dt` [s] of every damped mode, (r, 4); kept."""
        if dt not in self._steps:
            if len(self._steps) > 8:
                self._steps.clear()
            self._steps[dt] = propagator(self.model.squared, self.damping, dt)
        return self._steps[dt]

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Advance by `dt` [s]; `state_out` may be `state_in`.

        Raises `UserError` for a control that does not fit, loads that this body does not take or a step that is not
        positive, `DivergenceError` when the state is not finite.
        """
        assert isinstance(state_in, StateWeightedResidual) and isinstance(state_out, StateWeightedResidual)
        control.reject_unfit(self.body)
        if not (np.isfinite(dt) and dt > 0):
            raise UserError(f"dt = {dt} s: the step must be positive and finite")
        started = perf_counter()
        goal = self.model.goal(control, self.carried(control.bone_pose))
        step = self.propagator(dt)
        kernels.advance(step, goal, state_in.q, state_in.qd, state_out.q, state_out.qd)
        state_out.pose[:] = control.bone_pose
        state_out.t = state_in.t + dt
        self._watch(state_out)
        return StepReport(1, 0.0, True, {"dynamic": perf_counter() - started})

    def _watch(self, state: State) -> None:
        if not np.isfinite(state.q).all() or not np.isfinite(state.qd).all():
            raise DivergenceError(
                f"weighted_residual: the amplitudes are not finite at t = {state.t:.4g} s; start from rest() "
                "and lower the loads"
            )

    def solve_static(self, control: Control, guess: State | None = None) -> StateWeightedResidual:
        """Return the equilibrium; there is only one, so `guess` lends nothing but its time."""
        control.reject_unfit(self.body)
        state = self.rest()
        state.t = 0.0 if guess is None else guess.t
        state.pose[:] = control.bone_pose
        state.q[:] = self.model.goal(control, self.carried(control.bone_pose))
        return state

    def energy(self, state: State, control: Control) -> Energy:
        """Return the energies of `state` [uJ]; loads count with the muscles, elastic energy above that of moved bones."""
        control.reject_unfit(self.body)
        kinetic = 0.5 * float(state.qd @ state.qd)
        elastic = 0.5 * float(state.q @ (self.model.squared * state.q))
        work = self.model.work(control, state.q, self.carried(control.bone_pose))
        return Energy(kinetic, elastic, 0.0, 0.0, -work)


def propagator(squared: Floats, damping: Floats, dt: float) -> Floats:
    """Return the four numbers (r, 4) that take q - goal and q' over `dt` [s]: q'' + damping q' + squared (q - goal) = 0."""
    spread = np.sqrt(0.25 * damping**2 - squared + 0j)
    spread = np.where(np.abs(spread) < 1e-6 * np.sqrt(squared), 1e-6 * np.sqrt(squared), spread)
    fast = -0.5 * damping - spread
    slow = squared / fast
    a, b = np.exp(fast * dt), np.exp(slow * dt)
    parts = (fast * b - slow * a, a - b, fast * slow * (b - a), fast * a - slow * b)
    return np.ascontiguousarray(np.stack([(part / (fast - slow)).real for part in parts], axis=1))
