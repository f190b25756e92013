"""Backends that minimise an energy over positions by Newton's method: statics and implicit dynamics."""

from __future__ import annotations

from time import perf_counter
from typing import Any, ClassVar

import numpy as np
from scipy import sparse

from faceanim.backends.pulls import Pulls, Quadratic
from faceanim.backends.solver import Energy, Notices, State, StepReport
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.elements.newton import Newton, Report, System, Term, newton
from faceanim.ground.arrays import Bools, Floats
from faceanim.ground.errors import DivergenceError, RunError, UserError

HALVINGS = 5
"""A time step that does not converge is halved up to this many times."""


class SolverNewton:
    """What such backends share; each builds its own `elements`, `pulls`, `free`, `mass` and `drag`, and says where bones
    carry what they hold.

    State: positions and velocities of all nodes, (n, 3).
    static_report : how the last `solve_static` went   last_static : where it got
    inverted : elements turned inside out in the last result   notices : what the user should know
    """

    name: ClassVar[str]
    options: Any
    elements: System
    pulls: Pulls
    free: Bools
    mass: sparse.csr_matrix
    drag: sparse.csr_matrix

    def __init__(self, body: Body) -> None:
        self.body = body
        self.dt_max = np.inf
        self.notices = Notices()
        self.inverted = 0
        self.static_report = Report()
        self.last_static: State | None = None
        self._statics: Newton | None = None
        self._dynamics: Newton | None = None

    @property
    def terms(self) -> tuple[Term, ...]:
        """What has energy besides the elements."""
        return (self.pulls,)

    def _placed(self, pose: Floats, x: Floats) -> Floats:
        """Return `x` with the held nodes where the bones at `pose` carry them."""
        raise NotImplementedError

    def _carried_rest(self, pose: Floats) -> Floats:
        """Return the rest shape moved rigidly with the bone that holds most of it."""
        raise NotImplementedError

    def _apply(self, control: Control) -> None:
        """Take loads and poses of `control`; they hold until the next call."""
        self.pulls.apply(control)

    def _first_step(self, control: Control, guess: State | None) -> float:
        """Return the share of a static load that is tried at once."""
        return 1.0

    def _largest_step(self, control: Control, start: Floats) -> float:
        """Return the largest share of a static load that may be tried at once."""
        return 1.0

    def rest(self) -> State:
        """Return a new state: the body at rest."""
        return State(self.elements.points.copy(), np.zeros_like(self.elements.points))

    def solve_static(self, control: Control, guess: State | None = None) -> State:
        """Return the equilibrium under a constant control, reached from `guess` (default: rest, moved with the bone
        that holds most).

        `static_report` tells how it went. An inverted element under a law without barrier leaves a notice and
        `static_report.valid` false; a balance that is not stable, a notice and `static_report.definite` false.
        Raises `UserError` for a control that does not fit, `RunError` if no equilibrium is found: then `last_static` is
        the last one on the way and `static_report.fraction` how far that is.
        """
        control.reject_unfit(self.body)
        self._apply(control)
        if self._statics is None:
            self._statics = self._newton(())
        start = self._start(control, guess)
        largest_step = self._largest_step(control, start)
        first_step = self._first_step(control, guess)
        x, report = newton(
            self.elements, fixed=~self.free, values=self._placed(control.bone_pose, start), force=self.pulls.dead,
            start=start, first_step=first_step, least_step=self.options.least_step, largest_step=largest_step,
            check_definite=True, solver=self._statics,
        )  # fmt: skip
        self.static_report = report
        self.last_static = State(x, np.zeros_like(x), 0.0 if guess is None else guess.t)
        if not report.converged:
            raise RunError(
                f"{self.name}: no equilibrium beyond {report.fraction:.1%} of the load and bone movement (residual "
                f"{report.residual:.3g} mN after {report.iterations} Newton steps); lower the forces or activations, "
                "use a stiffer or finer mesh, or start from a nearer state"
            )
        self._note_doubts(report)
        return self.last_static.copy()

    def _newton(self, terms: tuple[Any, ...]) -> Newton:
        settings = {"tolerance": self.options.tolerance, "most": self.options.most}
        return Newton(self.elements, self.free, (*self.terms, *terms), **settings)

    def _fit(self, state: State) -> State:
        shape = self.elements.points.shape
        if state.q.shape != shape or state.qd.shape != shape:
            raise UserError(f"{self.name}: the state has shape {state.q.shape}; {shape} is needed")
        if not (np.isfinite(state.q).all() and np.isfinite(state.qd).all()):
            raise UserError(f"{self.name}: the state holds a number that is not finite; start from rest()")
        return state

    def _start(self, control: Control, guess: State | None) -> Floats:
        """Return where a static search begins: `guess`, or the rest shape moved with the bones if that is of no use."""
        if guess is not None and np.isfinite(self.elements.energy(self._fit(guess).q)):
            return guess.q
        if guess is not None:
            self.notices.once("the guess has inverted elements, so the search for equilibrium began at rest")
        return self._carried_rest(control.bone_pose)

    def _note_doubts(self, report: Report) -> None:
        if report.definite is False:
            self.notices.once("the equilibrium found is not stable: the flesh may buckle to a lower energy from there")
        self._note_inversion(0 if report.valid else report.inverted)

    def _note_inversion(self, count: int) -> None:
        if count and not self.inverted:
            self.notices.once(
                f"{count} elements are inverted: their law means nothing there; take one that resists inversion, such "
                "as 'neo_hookean', or less load"
            )
        self.inverted = count

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Advance by `dt` [s] with the control held constant; `state_out` may be `state_in`.

        A step that does not converge is halved, the held nodes moving evenly. Raises `UserError` for a control, state
        or step that does not fit, `DivergenceError` where halving does not help; `state_out` is then untouched.
        """
        control.reject_unfit(self.body)
        self._fit(state_in)
        if not (np.isfinite(dt) and dt > 0):
            raise UserError(f"dt = {dt} s: the step must be positive and finite")
        started = perf_counter()
        self._apply(control)
        goal = self._placed(control.bone_pose, state_in.q)
        report = Report()
        found = self._advance(state_in.q, state_in.qd, goal, dt, HALVINGS, report)
        if found is None:
            raise DivergenceError(
                f"{self.name}: the step from t = {state_in.t:.6g} s by {dt:.3g} s did not converge, not even in "
                f"{2**HALVINGS} parts; lower the loads, the bones' speed or dt"
            )
        state_out.q[:], state_out.qd[:] = found
        state_out.t = state_in.t + dt
        if not (self.elements.linear or self.elements.barrier):
            self._note_inversion(int((self.elements.volume_ratio(state_out.q) <= 0.0).sum()))
        seconds = {"dynamic": perf_counter() - started}
        return StepReport(max(1, report.iterations), report.residual, True, seconds)

    def _advance(
        self, x: Floats, v: Floats, goal: Floats, h: float, halvings: int, report: Report
    ) -> tuple[Floats, Floats] | None:
        """Return positions and velocities after `h`, the held nodes at `goal`, or None if that does not converge."""
        found = self._one_step(x, v, goal, h, report)
        if found is not None or halvings == 0:
            return found
        half = self._advance(x, v, np.where(self.free, goal, 0.5 * (x + goal)), 0.5 * h, halvings - 1, report)
        if half is None:
            return None
        return self._advance(*half, goal, 0.5 * h, halvings - 1, report)

    def _one_step(self, x: Floats, v: Floats, goal: Floats, h: float, report: Report) -> tuple[Floats, Floats] | None:
        inertia, drag, force = self._inertia(x, v, goal, h)
        if self._dynamics is None:
            self._dynamics = self._newton((inertia, drag))
        search = self._dynamics
        search.terms = (*self.terms, inertia, drag)
        search.forget()
        trial = np.where(self.free, x + h * v, goal)
        if not np.isfinite(search.energy(trial, force)):
            trial = np.where(self.free, x, goal)
        if not (np.isfinite(search.energy(trial, force)) and search.minimise(trial, force, report)):
            search.forget()
            lifted = search.lifted(x, np.where(self.free, 0.0, goal - x), force)
            if lifted is None or not search.minimise(lifted, force, report):
                return None
            trial = lifted
        moved = (trial - x) / h
        if self.options.integrator == "trapezoid":
            return trial, np.where(self.free, 2.0 * moved - v, moved)
        return trial, moved

    def _inertia(self, x: Floats, v: Floats, goal: Floats, h: float) -> tuple[Quadratic, Quadratic, Floats]:
        """Return inertia and drag over a step `h` as energies of the new positions, and the constant forces.

        Backward Euler: M (v1 - v0) = h (F(x1) - D v1), v1 = (x1 - x0) / h.
        Trapezoid: M (v1 - v0) = h/2 (F(x0) - D v0 + F(x1) - D v1), v1 = 2 (x1 - x0) / h - v0; held nodes move evenly.
        """
        force = self.pulls.dead
        if self.options.integrator == "backward_euler":
            return *self._scaled(1.0 / h**2, x + h * v, 1.0 / h, x), force
        evenly = (goal - x) / h
        inertia_centre = np.where(self.free, x + h * v, goal - 0.5 * h * (evenly - v))
        drag_centre = np.where(self.free, x + 0.5 * h * v, goal - 0.5 * h * evenly)
        before = self.elements.forces(x) + sum(term.forces(x) for term in self.terms) + force
        before -= np.asarray(self.drag @ v.ravel()).reshape(-1, 3)
        return *self._scaled(4.0 / h**2, inertia_centre, 2.0 / h, drag_centre), force + before

    def _scaled(self, mass: float, centre: Floats, drag: float, drag_centre: Floats) -> tuple[Quadratic, Quadratic]:
        return Quadratic(mass * self.mass, centre), Quadratic(drag * self.drag, drag_centre)

    def energy(self, state: State, control: Control) -> Energy:
        """Return the energies of `state` [uJ]; `muscle` holds the work of muscles, surface forces and gravity."""
        control.reject_unfit(self.body)
        self._apply(control)
        v = state.qd.ravel()
        kinetic = 0.5 * float(v @ (self.mass @ v))
        pull = self.pulls.energy(state.q) - float((self.pulls.dead * (state.q - self.elements.points)).sum())
        others = sum(term.energy(state.q) for term in self.terms if term is not self.pulls)
        return Energy(kinetic, self.elements.energy(state.q) + others, 0.0, 0.0, pull)
