"""The mass-spring backend behind the `Solver` protocol."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from faceanim.backends.mass_spring import kernels, partition
from faceanim.backends.mass_spring.build import Tables
from faceanim.backends.mass_spring.load import Load
from faceanim.backends.mass_spring.newton import Newton, NewtonReport
from faceanim.backends.mass_spring.options import Options
from faceanim.backends.mass_spring.partition import Partition, content_key
from faceanim.backends.mass_spring.schemes import Explicit, Motion, QuasiStatic, Scheme, make_scheme
from faceanim.backends.mass_spring.symmetry import find_symmetry
from faceanim.backends.solver import Energy, State, StepReport
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import DivergenceError, UserError
from faceanim.kernels import attachment
from faceanim.kernels.tables import Tethers


@dataclass(eq=False)
class StateMassSpring(State):
    """Positions `q` (n, 3) [mm] and velocities `qd` (n, 3) [mm/s], with the step before for two-step schemes.

    q_before, qd_before : the same one step earlier;  dt_before : that step [s], 0 = none yet
    pose, pose_before : (n_bone, 4, 4) of the bones at these two times, None = not known
    """

    q_before: Floats | None = None
    qd_before: Floats | None = None
    dt_before: float = 0.0
    pose: Floats | None = None
    pose_before: Floats | None = None

    def copy(self) -> StateMassSpring:
        """Return an independent copy."""
        known = (self.q_before, self.qd_before, self.pose, self.pose_before)
        q, qd, pose, pose_before = (None if a is None else a.copy() for a in known)
        return StateMassSpring(self.q.copy(), self.qd.copy(), self.t, q, qd, self.dt_before, pose, pose_before)


class Pins:
    """The vertices that the bones carry rigidly: `node` (p,)."""

    def __init__(self, body: Body) -> None:
        self.node = np.flatnonzero(body.pinned).astype(np.int32)
        self.table = Tethers(
            body.surface.points[self.node], np.ascontiguousarray(body.attachment.bone_weight[self.node]),
            np.zeros(len(self.node)), 1.0, 1.0, np.zeros(len(self.node) + 1, dtype=np.int32),
            np.zeros(0, dtype=np.int32), np.zeros(0), np.zeros(len(self.node)),
        )  # fmt: skip
        self.pose = np.zeros((len(body.bones), 4, 4))
        self.place = np.zeros((len(self.node), 3))

    def places(self, control: Control) -> Floats:
        """Return where the bones carry them, (p, 3) [mm]."""
        if not np.array_equal(self.pose, control.bone_pose):
            self.pose[:] = control.bone_pose
            attachment.carry(self.table, self.pose, self.place)
        return self.place

    def move(self, control: Control, motion: Motion, h: float) -> None:
        """Write their new positions and velocities into `motion`."""
        kernels.put(self.places(control), motion.q, self.node, h, motion.q_new, motion.qd_new)


class SolverMassSpring:
    """Masses and nonlinear springs under muscles, bones and contact.

    See `Options` for the schemes. `dt_max` [s] is infinite except for "explicit": its largest stable step at rest
    (larger ones are divided). `worked_on` tells how many vertices the last step computed, mirror images left out.
    """

    Options: ClassVar[type] = Options
    skin_contact: ClassVar[bool] = True

    def __init__(self, body: Body, options: Any = None) -> None:
        self.body = body
        self.options: Options = Options() if options is None else options
        self.tables = Tables(body)
        self.dt_max = np.inf
        self.static_report = NewtonReport()
        self.worked_on = 0
        self.pins = Pins(body)
        self._motion = Motion(len(body.surface.points))
        self._horizon = 1000.0 + 2.0 * float(np.abs(body.surface.points).max(initial=0.0))
        self._free = np.flatnonzero(~body.pinned).astype(np.int32)
        self._statics: Newton | None = None
        self._everything: Load | None = None
        self.partition: Partition | None = None
        self._moving = self._free
        self._schemes: dict[bool, Scheme] = {}
        self._quasi_static: QuasiStatic | None = None
        self._symmetry = find_symmetry(body) if self.options.symmetric else None
        if self.options.scheme == "explicit":
            whole = self._scheme(False)
            assert isinstance(whole, Explicit)
            self.dt_max = whole.largest_step()

    def rest(self) -> StateMassSpring:
        """Return a new state: the body at rest."""
        q = self.body.surface.points.copy()
        return StateMassSpring(q, np.zeros_like(q), 0.0, q.copy(), np.zeros_like(q), 0.0)

    def check(self, control: Control) -> None:
        """Raise `UserError` unless `control` fits the body, holds only finite numbers and asks for no loads."""
        control.reject_unfit(self.body)
        if control.loaded:
            raise UserError(
                "mass_spring: gravity and forces are not modelled, since the skin's rest shape already hangs; "
                "choose another backend, or a muscle that pulls along a direction"
            )

    def surface(self, state: State, out: np.ndarray) -> None:
        """Write the surface points (n, 3) [mm] into `out`."""
        out[:] = state.q

    def solve_static(self, control: Control, guess: State | None = None) -> StateMassSpring:
        """Return the equilibrium under a constant control; `guess` (default: rest, carried by the bones) starts it.

        `static_report` tells how it went (steps, residual, whether it converged). Raises `DivergenceError` when the
        positions leave the finite numbers.
        """
        self.check(control)
        if self._statics is None:
            self._statics = self._newton(self._free)
        return self._settle(self._statics, control, None if guess is None else guess.q)

    def _newton(self, free: Ints) -> Newton:
        return Newton(Load(self.tables.patch(free)))

    def _settle(self, newton: Newton, control: Control, guess: Floats | None) -> StateMassSpring:
        """Return the equilibrium of the free vertices of `newton`; the other ones at rest or with their bones."""
        load, patch = newton.load, newton.load.patch
        load.apply(control)
        if guess is None:
            load.x[:] = load.moment.anchor
        else:
            load.x[: patch.m] = guess[patch.nodes[: patch.m]]
            load.x[patch.m :] = self.body.surface.points[patch.nodes[patch.m :]]
            load.x[patch.held] = load.moment.anchor[patch.held]
        report = newton.minimise(load.x, tolerance=self.options.newton_tolerance, most=self.options.newton_most)
        self.static_report = report
        if not (np.isfinite(report.residual) and np.isfinite(load.x).all()):
            raise DivergenceError(
                f"the equilibrium search left the finite numbers after {report.steps} Newton steps; lower the "
                "activations or check the body for crossings at rest"
            )
        state = self.rest()
        state.q[self.pins.node] = self.pins.places(control)
        state.q[patch.nodes[: patch.m]] = load.x[: patch.m]
        return state

    def _whole(self, control: Control) -> Load:
        """Return all vertices, pinned ones too, under `control`."""
        if self._everything is None:
            everyone = np.arange(len(self.body.surface.points), dtype=np.int32)
            self._everything = Load(self.tables.patch(everyone))
        self._everything.apply(control)
        return self._everything

    def forces(self, state: State, control: Control) -> Floats:
        """Return the force on every vertex, pinned or not, without drag, (n, 3) [mN]; for tests."""
        self.check(control)
        load = self._whole(control)
        load.touch(state.q, 1.0)
        return load.forces(np.ascontiguousarray(state.q))[:, :3].copy()

    def energy(self, state: State, control: Control) -> Energy:
        """Return the energies of `state` [uJ]; for tests, never in the frame loop."""
        self.check(control)
        load = self._whole(control)
        load.touch(state.q, 1.0)
        e = load.energy(np.ascontiguousarray(state.q))
        kinetic = 0.5 * float((self.body.mass * (state.qd**2).sum(axis=1)).sum())
        return Energy(kinetic, e.elastic, e.attachment, e.contact, e.muscle)

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Advance by `dt` [s]; `state_out` may be `state_in`.

        Raises `UserError` for a control that does not fit, `DivergenceError` when positions leave the finite numbers
        or run away.
        """
        self.check(control)
        if not (np.isfinite(dt) and dt > 0):
            raise UserError(f"dt = {dt} s: the step must be positive and finite")
        report = StepReport()
        if self.options.adaptive:
            self._adapt(state_in, control)
        started = perf_counter()
        self._recall(state_in)
        self.pins.move(control, self._motion, dt)
        half = self._halves(state_in, control)
        scheme = self._scheme(half)
        self.worked_on = scheme.load.patch.m
        scheme.load.apply(control)
        scheme.advance(self._motion, dt, report)
        if half and self._symmetry is not None:
            patch, motion = scheme.load.patch, self._motion
            kernels.mirror_out(patch.nodes, patch.m, self._symmetry.vertex, motion.q_new, motion.qd_new)
        between = perf_counter()
        if self._quasi_static is not None:
            self._quasi_static.load.apply(control)
            self._quasi_static.advance(self._motion, dt, report)
        done = perf_counter()
        self._commit(state_in, state_out, dt, control)
        report.seconds["dynamic"] = between - started
        report.seconds["quasi_static"] = done - between
        report.seconds["rest"] = perf_counter() - done
        self._watch(state_out, report)
        return report

    def prepare(self, controls: Control | Sequence[Control]) -> Partition | None:
        """Compute, or read from the cache, the adaptive partition for these peak controls, and use it from now on.

        Without `Options(adaptive=True)` there is nothing to prepare: returns None. The union of what they
        activate is integrated; see `Partition`. A step prepares itself
        when a muscle or bone acts that no partition was made for, then as if every acting muscle reached 1.
        """
        peaks = [controls] if isinstance(controls, Control) else list(controls)
        for control in peaks:
            self.check(control)
        if not self.options.adaptive:
            return None
        peaks = peaks or [Control.rest(self.body)]
        key = content_key(self.body, peaks, self.options.tolerance)
        found = partition.load(key, len(self.body.mass))
        if found is None:
            found = partition.compute(self.body, peaks, self.options.tolerance, self._equilibrium)
            partition.save(key, found)
        self.use(found)
        return found

    def _equilibrium(self, control: Control, free: Ints | None, guess: Floats | None) -> Floats:
        newton = self._newton(self._free if free is None else free)
        return self._settle(newton, control, guess).q

    def _adapt(self, state: State, control: Control) -> None:
        muscles, bones = partition.acting(control)
        known = self.partition
        if known is not None and known.covers(muscles, bones):
            return
        found = self.prepare(partition.full_blast(control))
        assert found is not None
        wide = partition.widened(self.body, found, state.q)
        if wide is not found:
            self.use(wide)

    def use(self, found: Partition) -> None:
        """Use this partition from now on: build the patches of dynamic, and of quasi-static vertices in wave order."""
        self.partition = found
        free = ~self.body.pinned
        dynamic = np.flatnonzero((found.node_set == partition.DYNAMIC) & free).astype(np.int32)
        quasi = np.flatnonzero((found.node_set == partition.QUASI_STATIC) & free).astype(np.int32)
        if self.options.quasi_static == "integrated":
            dynamic, quasi = np.union1d(dynamic, quasi).astype(np.int32), quasi[:0]
        if self.options.quasi_static == "waves":
            quasi = quasi[np.argsort(found.wave[quasi], kind="stable")]
        self._moving = dynamic
        self._schemes.clear()
        self._quasi_static = None
        if len(quasi):
            self._quasi_static = QuasiStatic(Load(self.tables.patch(quasi)), self.body.damping, self.options)

    def _halves(self, state: State, control: Control) -> bool:
        """Return whether one half of the body is enough for the step from `state`."""
        if self._symmetry is None or self.options.scheme != "conjugate_gradient" or self._quasi_static is not None:
            return False
        return self._symmetry.holds(state.q, state.qd, control)

    def _scheme(self, half: bool) -> Scheme:
        """Return the scheme for what moves, or for the half of it that has x >= 0; made when first needed."""
        if half not in self._schemes:
            free, mirror = self._moving, None
            if half and self._symmetry is not None:
                mirror = self._symmetry.vertex
                whole = np.union1d(free, mirror[free])
                free = whole[(self.body.surface.points[whole, 0] > 0.0) | (mirror[whole] == whole)].astype(np.int32)
            self._schemes[half] = make_scheme(Load(self.tables.patch(free, mirror)), self.body.damping, self.options)
        return self._schemes[half]

    def _recall(self, state: State) -> None:
        motion = self._motion
        motion.q, motion.qd, motion.t = state.q, state.qd, state.t
        before, rate = getattr(state, "q_before", None), getattr(state, "qd_before", None)
        known = before is not None and rate is not None
        motion.q_before = before if before is not None and known else state.q
        motion.qd_before = rate if rate is not None and known else state.qd
        motion.dt_before = getattr(state, "dt_before", 0.0) if known else 0.0
        motion.pose, motion.pose_before = getattr(state, "pose", None), getattr(state, "pose_before", None)
        motion.q_new[:] = state.q
        motion.qd_new[:] = 0.0

    def _commit(self, state_in: State, state_out: State, dt: float, control: Control) -> None:
        motion = self._motion
        if isinstance(state_out, StateMassSpring):
            state_out.pose_before = motion.pose
            state_out.pose = control.bone_pose.copy()
            if state_out.q_before is None or state_out.qd_before is None:
                state_out.q_before, state_out.qd_before = np.empty_like(state_in.q), np.empty_like(state_in.q)
            state_out.q_before[:] = state_in.q
            state_out.qd_before[:] = state_in.qd
            state_out.dt_before = dt
        state_out.q[:] = motion.q_new
        state_out.qd[:] = motion.qd_new
        state_out.t = state_in.t + dt

    def _watch(self, state: State, report: StepReport) -> None:
        farthest = max(float(state.q.max(initial=0.0)), -float(state.q.min(initial=0.0)))
        if not farthest < self._horizon:
            remedy = {
                "paper": "this scheme is unstable for large steps: use scheme='conjugate_gradient' or a smaller step",
                "explicit": "lower `safety` or use scheme='conjugate_gradient'",
            }.get(self.options.scheme, "use a smaller step or more sweeps, or lower the activations")
            raise DivergenceError(
                f"the skin ran away (farthest vertex {farthest:.3g} mm) at t = {state.t:.4g} s with scheme "
                f"{self.options.scheme!r} after {report.iterations} iterations; {remedy}"
            )
