"""The modal warping backend behind the `Solver` protocol."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from faceanim.backends.modal_warping.build import Modes, compute_modes, muscle_forces, with_held
from faceanim.backends.modal_warping.display import SkinWarp
from faceanim.backends.modal_warping.loads import Loads, MuscleStiffness
from faceanim.backends.modal_warping.manipulation import Manipulation
from faceanim.backends.modal_warping.options import Options
from faceanim.backends.modal_warping.recurrence import Recurrence, make_recurrence
from faceanim.backends.modal_warping.shape import make_shape
from faceanim.backends.modal_warping.statics import Balance, equilibrium, growth_rate
from faceanim.backends.modal_warping.twist import FARTHEST, twist_of
from faceanim.backends.nodal import push_out, solid_of
from faceanim.backends.solver import Energy, Notices, State, StepReport
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import DivergenceError, UserError
from faceanim.kernels import warp


@dataclass(eq=False)
class StateModalWarping(State):
    """Modal amplitudes `q` (m,) and their rates `qd` (m,), with where the bones are.

    twist, twist_rate : (bones, 6) rotation vector [rad] and velocity [mm] of the bones that hold nodes, and their rates
    pose : (n_bone, 4, 4) the poses themselves
    """

    twist: Floats = field(default_factory=lambda: np.zeros((0, 6)))
    twist_rate: Floats = field(default_factory=lambda: np.zeros((0, 6)))
    pose: Floats = field(default_factory=lambda: np.zeros((0, 4, 4)))

    def copy(self) -> StateModalWarping:
        """Return an independent copy."""
        return StateModalWarping(
            self.q.copy(), self.qd.copy(), self.t, self.twist.copy(), self.twist_rate.copy(), self.pose.copy()
        )


class SolverModalWarping:
    """Vibration modes of a solid, warped; see `Options` for the variants.

    `modes` are its modes, `manipulation` (None, or a `Manipulation`) what drags and turns nodes in every step,
    `static_report` how the last `solve_static` went, `notices` what is worth telling the user, each once.
    A step never fails for being long: `dt_max` is infinite (accuracy is another matter).
    Modes feel no contact: where flesh would enter an eyeball, only the surface that is shown is moved out of it.
    """

    Options: ClassVar[type] = Options

    def __init__(self, body: Body, options: Any = None) -> None:
        self.body = body
        self.options: Options = Options() if options is None else options
        self.solid = with_held(solid_of(body, "modal_warping"), self.options.held)
        loads = muscle_forces(body, self.solid) if self.options.muscle_modes else None
        self.modes: Modes = compute_modes(self.solid, self.options, loads=loads)
        self.damping = self.solid.damping + self.solid.stiffness_damping * self.modes.squared
        self.shape = make_shape(self.solid, self.modes, self.options.variant)
        self.loads = Loads(body, self.solid)
        self._muscle_stiffness = MuscleStiffness(body, self.loads, self.modes.shapes())
        self.manipulation: Manipulation | None = None
        self.static_report = StepReport()
        self.notices = Notices()
        self.dt_max = np.inf
        self._recurrence: dict[float, Recurrence] = {}
        self._rate = np.zeros((len(self.solid.mesh.points), 6))
        self._drift = np.zeros_like(self.solid.mesh.points)
        self._skin = SkinWarp(self) if self.options.precision == "single" and self._by_node else None
        self._horizon = 1e4 * float(np.ptp(self.solid.mesh.points, axis=0).max())

    @property
    def _by_node(self) -> bool:
        return not self.options.variant.startswith("rotation_strain")

    def rest(self) -> StateModalWarping:
        """Return a new state: the body at rest."""
        m, bones = self.modes.count, len(self.modes.bone)
        pose = np.tile(np.eye(4), (len(self.body.bones), 1, 1))
        return StateModalWarping(np.zeros(m), np.zeros(m), 0.0, np.zeros((bones, 6)), np.zeros((bones, 6)), pose)

    def check(self, control: Control) -> None:
        """Raise `UserError` unless `control` fits the body and holds only finite numbers."""
        control.reject_unfit(self.body)

    def twists(self, pose: Floats, state: StateModalWarping) -> Floats:
        """Return the twists (bones, 6) of the bones at `pose`, nearest to those of `state`."""
        if np.array_equal(pose, state.pose):
            return state.twist.copy()
        return np.array([twist_of(pose[b], int(b), near) for b, near in zip(self.modes.bone, state.twist)]).reshape(
            -1, 6
        )

    def recurrence(self, dt: float) -> Recurrence:
        """Return the step of length `dt` [s] for every mode; kept."""
        if dt not in self._recurrence:
            if len(self._recurrence) > 8:
                self._recurrence.clear()
            self._recurrence[dt] = make_recurrence(self.options.integrator, self.modes.squared, self.damping, dt)
        return self._recurrence[dt]

    def nodes(self, state: State) -> Floats:
        """Return the positions of the solid's nodes, (n, 3) [mm]; overwritten by the next call that places nodes."""
        assert isinstance(state, StateModalWarping)
        return self.shape.place(state.q, state.twist, state.pose)

    def rotations(self, state: State) -> Floats:
        """Return the rotation vectors of the solid's nodes, (n, 3) [rad] (Eq. 8); a view, as `nodes`."""
        self.nodes(state)
        return self.shape.moved[:, 3:]

    def surface(self, state: State, out: np.ndarray) -> None:
        """Write the body's surface points (n, 3) [mm] into `out`."""
        assert isinstance(state, StateModalWarping)
        if self._skin is not None:
            self._skin.points(state, out)
        else:
            out[:] = self.loads.matrix @ self.nodes(state)
        push_out(out, self.body)

    def generalised_force(self, state: State, control: Control) -> Floats:
        """Return the force on the modes, (m,), of muscles, loads and gravity in `state`."""
        force = self.loads.force(control, self.nodes(state))
        return np.zeros(self.modes.count) if force is None else self.shape.project(force).copy()

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Advance by `dt` [s]; `state_out` may be `state_in`.

        Raises `UserError` for a control that does not fit or a step that is not positive, `DivergenceError` when the
        amplitudes leave the finite numbers or run away.
        """
        assert isinstance(state_in, StateModalWarping) and isinstance(state_out, StateModalWarping)
        self.check(control)
        if not (np.isfinite(dt) and dt > 0):
            raise UserError(f"dt = {dt} s: the step must be positive and finite")
        started = perf_counter()
        twist = self.twists(control.bone_pose, state_in)
        rate = (twist - state_in.twist) / dt
        force = self.generalised_force(state_in, control)
        force -= self.modes.coupling @ ((rate - state_in.twist_rate) / dt + self.solid.damping * rate).ravel()
        if self.options.coriolis:
            force -= self._coriolis(state_in)
        move = self.recurrence(dt)
        q = move.a * state_in.q + move.b * state_in.qd + move.g * force
        stiff = self._muscle_stiffness.at(control, self.loads.surface)
        if stiff is not None:
            system = np.eye(len(q)) + move.g[:, None] * stiff
            give = stiff @ np.linalg.solve(system, q - state_in.q)
            force -= give
            q -= move.g * give
        qd = move.c * state_in.q + move.d * state_in.qd + move.e * force
        report = StepReport(iterations=1)
        between = perf_counter()
        if self.manipulation is not None:
            q = self.manipulation.correct(q, state_in, twist, move.g, report)
            qd = (q - state_in.q) / dt
        state_out.t = state_in.t + dt
        state_out.q, state_out.qd = q, qd
        state_out.twist, state_out.twist_rate, state_out.pose = twist, rate, control.bone_pose.copy()
        report.seconds["dynamic"] = between - started
        report.seconds["constraints"] = perf_counter() - between
        self._watch(state_out)
        return report

    def _coriolis(self, state: StateModalWarping) -> Floats:
        """Return Phi^T M R^T R' uL', (m,) (Eq. 14, footnote 2)."""
        self.nodes(state)
        z = np.concatenate([state.qd, state.twist_rate.ravel()])
        warp.local(self.modes.basis, z, len(z), self._rate)
        warp.coriolis(self.shape.moved, self._rate, self._drift)
        return np.asarray(self.modes.shapes().T @ (self.modes.mass @ self._drift.ravel()))

    def _watch(self, state: StateModalWarping) -> None:
        """Raise `DivergenceError` for amplitudes that ran away, note rotations near the end of what can be warped."""
        points = self.nodes(state) if np.isfinite(state.q).all() else np.full((1, 3), np.nan)
        if not np.isfinite(points).all() or np.abs(points).max() > self._horizon:
            raise DivergenceError(
                f"t = {state.t:.4g} s: the modal amplitudes ran away; take shorter steps, more damping, lower loads, "
                "or variant 'consistent'"
            )
        if float((self.shape.moved[:, 3:] ** 2).sum(axis=1).max()) > FARTHEST**2 and self.shape.warped:
            self.notices.once("a node has turned by nearly a full turn or more, where warping loses a direction")

    def solve_static(self, control: Control, guess: State | None = None) -> StateModalWarping:
        """Return the equilibrium of the chosen variant, near `guess` (default: rest).

        `static_report` tells how it went; if no equilibrium was found, or one about which the body would oscillate by
        itself, a notice says so. Raises `DivergenceError` if the search leaves the finite numbers.
        """
        self.check(control)
        state = self.rest()
        if guess is not None:
            assert isinstance(guess, StateModalWarping)
            state.q[:], state.twist, state.pose = guess.q, guess.twist, guess.pose
        state.twist, state.pose = self.twists(control.bone_pose, state), control.bone_pose.copy()
        balance = self._balance(state, control)
        q, error = equilibrium(balance, state.q, self.options.static_tolerance, self.options.static_most)
        if not np.isfinite(q).all():
            raise DivergenceError("the equilibrium search left the finite numbers; lower the loads or the activations")
        state.q[:] = q
        converged = error < 10.0 * self.options.static_tolerance
        self.static_report = StepReport(balance.evaluations, error, converged)
        if not converged:
            self.notices.once(
                f"no equilibrium of variant {self.options.variant!r} was found (relative residual {error:.1e}): the "
                "load is too high for it; variant 'consistent' or 'rotation_strain' bears more"
            )
        elif balance.energy is None and growth_rate(balance, q, self.damping) > 1e-3 * balance.root[0]:
            self.notices.once(
                f"variant {self.options.variant!r} would oscillate by itself about this equilibrium: its force has no "
                "energy (Eq. 18); variant 'consistent' does not"
            )
        return state

    def _balance(self, state: StateModalWarping, control: Control) -> Balance:
        trial = state.copy()

        def force(q: Floats) -> Floats:
            trial.q[:] = q
            return self.generalised_force(trial, control)

        def energy(q: Floats) -> float:
            trial.q[:] = q
            return self.loads.energy(control, self.nodes(trial))

        conservative = self.options.variant in ("linear", "consistent", "rotation_strain")
        return Balance(self.modes.squared, force, energy if conservative else None)

    def energy(self, state: State, control: Control) -> Energy:
        """Return the energies of `state` in the local frames (Eq. 16) [uJ]; loads count with the muscles."""
        assert isinstance(state, StateModalWarping)
        self.check(control)
        modes, xi, rate = self.modes, state.twist.ravel(), state.twist_rate.ravel()
        kinetic = 0.5 * state.qd @ state.qd + state.qd @ modes.coupling @ rate + 0.5 * rate @ modes.lift_mass @ rate
        elastic = 0.5 * state.q @ (modes.squared * state.q) + 0.5 * xi @ modes.lift_stiffness @ xi
        return Energy(float(kinetic), float(elastic), 0.0, 0.0, self.loads.energy(control, self.nodes(state)))
