"""The octree backend behind the `Solver` protocol."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from faceanim.backends.nodal import push_out
from faceanim.backends.octree_mass_spring.build import Flesh, Rig
from faceanim.backends.octree_mass_spring.motion import Moment, Motion
from faceanim.backends.octree_mass_spring.options import Options
from faceanim.backends.octree_mass_spring.static import StaticReport, equilibrium
from faceanim.backends.octree_mass_spring.transfer import transfer
from faceanim.backends.solver import Energy, Notices, State, StepReport
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import DivergenceError, UserError
from faceanim.kernels import lattice as kernels

NEWTON_NODES = 2500
"""Up to so many nodes an equilibrium is sought by Newton's method first; beyond, coming to rest is faster."""
RELAX_STEP = 1.0 / 30.0
"""Step of coming to rest [s]."""
EASE = 12
"""Steps over which loads are put on."""


@dataclass(eq=False)
class StateOctree(State):
    """Nodes of a cut: `q` (n, 3) [mm], `qd` (n, 3) [mm/s].

    level : (c,) the cut, the level of the active cell over each leaf   quiet : (c,) steps since it was last in danger
    pose : (n_bone, 4, 4) of the bones
    """

    level: Ints = None  # type: ignore[assignment]
    quiet: Ints = None  # type: ignore[assignment]
    pose: Floats = None  # type: ignore[assignment]

    def copy(self) -> StateOctree:
        """Return an independent copy."""
        level, quiet, pose = self.level.copy(), self.quiet.copy(), self.pose.copy()
        return StateOctree(self.q.copy(), self.qd.copy(), self.t, level, quiet, pose)


class SolverOctreeMassSpring:
    """Masses and springs on the cells of an octree, explicit in time, with cells of several sizes.

    See `Options`. Steps of any length are divided into stable ones; `substep` [s] is the largest stable step of the first
    cut times the safety.
    `notices` tells once what the body asks for and this backend leaves out, and what was done to go on safely.
    The lattice's Poisson ratio is 1/4 and its only damping is by mass: `Solid.damping`, raised so that the slowest
    vibration also dies as `Solid.stiffness_damping` would have it. Contact is not modelled, but for skin put out of
    spheres when it is shown.
    """

    Options: ClassVar[type] = Options

    def __init__(self, body: Body, options: Any = None) -> None:
        self.body = body
        self.options: Options = Options() if options is None else options
        self.notices = Notices()
        self.static_report = StaticReport()
        self.flesh = Flesh(body, self.options)
        self.solid = self.flesh.solid
        self.lattice = self.flesh.lattice
        self._rigs: dict[bytes, Rig] = {}
        leaves = np.zeros(len(self.lattice.stiffness), dtype=np.int32)
        dt = self.rig(leaves).dt_max * self.options.safety if self.options.cut == "force" else 0.0
        self.base = self.rig(self.flesh.first_cut(dt)).model.level
        self._replace_stiffness_damping()
        self.dt_max = np.inf
        self.substep = self.rig(self.base).dt_max * self.options.safety
        self.motion = Motion(self.options, self.notices.once)
        self._say_what_is_missing()

    def _replace_stiffness_damping(self) -> None:
        """Raise the drag by zeta w^2: the slowest vibration then dies as with the missing damping by stiffness, zeta K v."""
        if not self.solid.stiffness_damping:
            return
        slowest = self.rig(self.base).model.slowest()
        self.flesh.drag += self.solid.stiffness_damping * slowest**2
        self._rigs.clear()
        self.notices.once(
            f"damping by stiffness is not modelled; damping by mass was raised from {self.solid.damping:.4g} to "
            f"{self.flesh.drag:.4g} / s, so that the slowest vibration ({slowest:.4g} / s) dies as fast"
        )

    def _say_what_is_missing(self) -> None:
        body = self.body
        if any(abs(m.poisson_ratio - 0.25) > 0.01 for m in self.solid.materials):
            self.notices.once("a lattice of springs has Poisson's ratio 1/4; the materials' own ratios are not used")
        if body.bone_contact is not None or body.spheres or body.pairs:
            self.notices.once("contact is not modelled")

    def rig(self, level: Ints) -> Rig:
        """Return what is stepped at the leaf levels `level` (c,); the last few are kept."""
        key = np.asarray(level, dtype=np.int32).tobytes()
        if key not in self._rigs:
            if len(self._rigs) >= 12:
                self._rigs.pop(next(iter(self._rigs)))
            self._rigs[key] = self.flesh.rig(level)
        return self._rigs[key]

    def rest(self) -> StateOctree:
        """Return a new state: the body at rest in the first cut."""
        q = self.rig(self.base).model.points.copy()
        pose = np.tile(np.eye(4), (len(self.body.bones), 1, 1))
        return StateOctree(q, np.zeros_like(q), 0.0, self.base.copy(), np.zeros_like(self.base), pose)

    def surface(self, state: State, out: np.ndarray) -> None:
        """Write the surface points (n, 3) [mm] into `out`; those that enter a sphere (an eyeball) are put on it."""
        assert isinstance(state, StateOctree)
        out[:] = self.rig(state.level).surface(state.q, state.pose)
        push_out(out, self.body)

    def recut(self, state: StateOctree, level: Ints) -> StateOctree:
        """Return `state` in another cut, the leaf levels `level` (c,); its momentum is kept."""
        old, new = self.rig(state.level), self.rig(level)
        q, qd = transfer(old.model, new.model, state.q, state.qd)
        self._put_carried(new, q, state.pose)
        return StateOctree(q, qd, state.t, new.model.level.copy(), state.quiet.copy(), state.pose.copy())

    def _put_carried(self, rig: Rig, q: Floats, pose: Floats) -> None:
        q[rig.model.carried] = self.flesh.carried(pose)[rig.model.carried_by]

    def solve_static(self, control: Control, guess: State | None = None) -> StateOctree:
        """Return the equilibrium under a constant control in the cut of `guess` (default: rest, moved by the bones).

        `static_report` tells how it went. Raises `DivergenceError` when the positions leave the finite numbers.
        """
        control.reject_unfit(self.body)
        state = self.rest() if guess is None else guess.copy()
        assert isinstance(state, StateOctree)
        start = state.copy()
        if len(state.q) <= NEWTON_NODES:
            self._newton(state, control)
        else:
            self.static_report = StaticReport(converged=False)
        if not self.static_report.converged:
            state = self._relaxed(start, control)
        if not self.static_report.converged:
            self.notices.once(f"an equilibrium was not reached: {self.static_report.residual:.3g} mN are left over")
        return state

    def _newton(self, state: StateOctree, control: Control) -> None:
        """Move `state` to the equilibrium near it by Newton's method."""
        rig = self.rig(state.level)
        held = self.flesh.carried(control.bone_pose)
        start = state.q.copy()
        start[rig.model.carried] = held[rig.model.carried_by]
        q, self.static_report = equilibrium(
            rig.model, start, lambda x: (rig.load(control, x), rig.potential(control, x)), rig.targets(held),
            tolerance=self.options.static_tolerance, most=self.options.static_most,
        )  # fmt: skip
        if not np.isfinite(q).all():
            raise DivergenceError(
                f"octree_mass_spring: the equilibrium left the finite numbers after {self.static_report.steps} steps; "
                "lower the loads"
            )
        state.q, state.qd = q, np.zeros_like(q)
        state.pose[:] = control.bone_pose

    def _relaxed(self, state: StateOctree, control: Control) -> StateOctree:
        """Return where `state` comes to rest, its slowest vibration damped as much as takes least time.

        Pulls and bones are put on over `EASE` steps. The report says "converged" below 1e-6 of the largest load.
        """
        slowest = self.rig(state.level).model.slowest()
        drag, first, report = max(self.flesh.drag, 2.0 * slowest), state.pose.copy(), StaticReport(converged=False)
        most = int(np.ceil(min(20.0 / min(slowest, slowest**2 / drag), 60.0) / RELAX_STEP)) + EASE
        now = copy.deepcopy(control)
        for report.steps in range(1, most + 1):
            share = min(1.0, report.steps / EASE)
            now.activation = share * control.activation
            now.bone_pose = first + share * (control.bone_pose - first)
            report.residual = self._step(state, state, now, RELAX_STEP, drag).residual
            goal = 1e-6 * float(np.abs(self.rig(state.level).load(control, state.q)).max(initial=0.0))
            report.converged = share == 1.0 and report.residual <= max(goal, 1e-9)
            if report.converged:
                break
        state.qd[:], state.t = 0.0, 0.0
        self.static_report = report
        return state

    def energy(self, state: State, control: Control) -> Energy:
        """Return the energies of `state` [uJ]: `attachment` the ties, `muscle` muscles, forces and gravity."""
        assert isinstance(state, StateOctree)
        control.reject_unfit(self.body)
        rig = self.rig(state.level)
        tables, x = rig.model.tables, np.ascontiguousarray(state.q)
        kinetic = 0.5 * float(
            (rig.model.mass[rig.inverse_mass > 0] * (state.qd[rig.inverse_mass > 0] ** 2).sum(1)).sum()
        )
        elastic = float(kernels.spring_energy(x, tables.springs) + kernels.hex_energy(x, tables.hexes))
        elastic += float(kernels.barrier_energy(x, tables.cells, tables.barrier))
        target = rig.targets(self.flesh.carried(control.bone_pose))
        ties = float(kernels.tie_energy(x, tables.ties, target))
        return Energy(kinetic, elastic, ties, 0.0, rig.potential(control, x))

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Advance by `dt` [s]; `state_out` may be `state_in`.

        Raises `UserError` for a control or step that does not fit, `DivergenceError` when positions leave the finite
        numbers in spite of everything.
        """
        control.reject_unfit(self.body)
        if not (np.isfinite(dt) and dt > 0):
            raise UserError(f"dt = {dt} s: the step must be positive and finite")
        assert isinstance(state_in, StateOctree) and isinstance(state_out, StateOctree)
        return self._step(state_in, state_out, control, dt, self.flesh.drag)

    def _step(
        self, state_in: StateOctree, state_out: StateOctree, control: Control, dt: float, drag: float
    ) -> StepReport:
        """Advance by `dt` [s] with `drag` [1/s]."""
        started = perf_counter()
        before, after = self.flesh.carried(state_in.pose), self.flesh.carried(control.bone_pose)
        moment = Moment(control, before, after, drag)
        level, quiet = state_in.level.copy(), state_in.quiet + 1
        rig, x, v, steps = self.motion.over(self.rig, level, quiet, state_in.q, state_in.qd, moment, dt)
        if not np.isfinite(x).all():
            raise DivergenceError(
                f"octree_mass_spring: positions left the finite numbers at t = {state_in.t + dt:.4g} s with dt = {dt:.3g} "
                "s; lower the loads, raise the damping or lower Options.safety"
            )
        if self.options.dynamic:
            rig, x, v = self._refine(rig, x, v, quiet)
        self._put_carried(rig, x, control.bone_pose)
        kernels.follow(x, rig.model.tables.slaves)
        _store(state_out, x, v, rig.model.level, quiet)
        state_out.pose[:] = control.bone_pose
        state_out.t = state_in.t + dt
        report = StepReport(iterations=steps, residual=self._unbalanced(rig, x, moment))
        report.seconds["dynamic"] = perf_counter() - started
        return report

    def _unbalanced(self, rig: Rig, x: Floats, moment: Moment) -> float:
        load = rig.load(moment.control, x)
        tables = rig.model.tables
        kernels.watch(x, tables.cells, tables.barrier, 0.0, rig.room.volume)
        kernels.all_forces(x, load, tables, rig.targets(moment.held_after), rig.room.force)
        return float(np.abs(rig.room.force[rig.inverse_mass > 0]).max(initial=0.0))

    def _refine(self, rig: Rig, x: Floats, v: Floats, quiet: Ints) -> tuple[Rig, Floats, Floats]:
        """Make cells finer again that were coarsened and have been quiet for `Options.quiet` steps."""
        level = rig.model.level
        ready = (level > self.base) & (quiet >= self.options.quiet)
        if not ready.any():
            return rig, x, v
        new = self.rig(np.where(ready, np.maximum(level - 1, self.base), level))
        if np.array_equal(new.model.level, level):
            return rig, x, v
        quiet[ready] = 0
        x, v = transfer(rig.model, new.model, x, v)
        self.notices.once("quiet cells were made finer again")
        return new, x, v


def _store(state: StateOctree, x: Floats, v: Floats, level: Ints, quiet: Ints) -> None:
    """Write into `state`, in place where the cut is as large as before."""
    if state.q.shape == x.shape:
        state.q[:], state.qd[:] = x, v
    else:
        state.q, state.qd = x.copy(), v.copy()
    state.level, state.quiet = level.copy(), quiet.copy()
