"""The time schemes: each advances the free vertices of one patch by one step."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from faceanim.backends.mass_spring import kernels
from faceanim.backends.mass_spring.load import Load
from faceanim.backends.mass_spring.newton import Newton
from faceanim.backends.mass_spring.options import Options
from faceanim.backends.mass_spring.preconditioner import (
    contact_stiffness,
    elimination_order,
    incomplete_factor,
    scalar_stiffness,
)
from faceanim.backends.solver import StepReport
from faceanim.ground.arrays import Floats
from faceanim.kernels.tables import Drive, Factor

REACH = 1.5
"""Contacts within this distance [mm] of their clearance are watched during a step."""
PAIR_REACH = 2.5
"""The same for lips and lids, which are watched from where a step starts."""
HIGHEST = 2.0
"""No eigenvalue of the stiffness, divided by the stiffness bounds, is larger (see `elastic_force`)."""
MARGIN = 1.2
"""What is added to the largest such eigenvalue measured at rest; it hardly changes when the skin deforms."""
RESOLVED = 1.5
"""n sweeps resolve eigenvalues down to about (RESOLVED / n)^2 of the largest: measured, the least error."""
SETTLED = 0.02
"""A step counts as converged when the last sweep wanted to move no vertex farther [mm]."""
MOST_FACTORS = 4
"""Factors are kept for so many different time steps."""
MOST_SUBSTEPS = 100_000
"""Leapfrog gives up (as diverged) when a step asks for more."""
OMEGA = 1.5
"""Relaxation factor of the passes in wave order."""


class Motion:
    """What a scheme reads and writes: the body's positions and velocities, now, one step earlier and new, (n, 3).

    `t` [s] is the time now, `dt_before` [s] the earlier step, 0 = there is none; `pose`, `pose_before` of the bones.
    """

    def __init__(self, n: int) -> None:
        self.q = self.qd = self.q_before = self.qd_before = np.zeros((0, 3))
        self.t = self.dt_before = 0.0
        self.pose: Floats | None = None
        self.pose_before: Floats | None = None
        self.q_new = np.zeros((n, 3))
        self.qd_new = np.zeros((n, 3))


class Scheme(Protocol):
    """A way to advance one patch; `advance` fills `report` and writes the free vertices of `motion.q_new`, `qd_new`."""

    load: Load

    def advance(self, motion: Motion, h: float, report: StepReport) -> None: ...


class _Patchwise:
    def __init__(self, load: Load, drag: float, options: Options) -> None:
        n = len(load.patch.nodes)
        self.load = load
        self.drag = drag
        self.options = options
        self.v = np.zeros((n, 3))

    def _gather(self, motion: Motion) -> None:
        patch = self.load.patch
        kernels.gather(motion.q, motion.qd, patch.nodes, patch.held, self.load.moment, self.load.x, self.v)

    def _scatter(self, motion: Motion) -> None:
        kernels.scatter(self.load.x, self.v, self.load.patch.nodes, self.load.patch.m, motion.q_new, motion.qd_new)


class _Implicit(_Patchwise):
    """Common to the schemes that solve w (x - c) = F(x)."""

    def __init__(self, load: Load, drag: float, options: Options) -> None:
        super().__init__(load, drag, options)
        n = len(load.patch.nodes)
        self.weight = np.zeros(n)
        self.centre = np.zeros((n, 3))

    def _coefficients(self, motion: Motion, h: float) -> tuple[float, float, float]:
        """Return gamma [s] and the shares of the last two steps: BDF2 for variable steps, or Euler."""
        if self.options.integrator == "euler" or motion.dt_before <= 0.0:
            return h, 1.0, 0.0
        ratio = h / motion.dt_before
        share = 1.0 + 2.0 * ratio
        return h * (1.0 + ratio) / share, (1.0 + ratio) ** 2 / share, -(ratio**2) / share

    def advance(self, motion: Motion, h: float, report: StepReport) -> None:
        """Set up the incremental potential, minimise it, and read the velocities off."""
        patch, x = self.load.patch, self.load.x
        gamma, now, before = self._coefficients(motion, h)
        self._gather(motion)
        kernels.begin(
            motion.q, motion.qd, motion.q_before, motion.qd_before, patch.nodes, patch.mass, patch.m, self.drag, gamma,
            now, before, self.centre, self.weight,
        )  # fmt: skip
        if motion.pose is not None and motion.pose_before is not None and abs(h - motion.dt_before) < 1e-3 * h:
            self.load.follow(motion.pose, motion.pose_before)
        self.load.ahead(self.v, h, self.options.sweep_tolerance, REACH, PAIR_REACH)
        self._minimise(gamma, report)
        kernels.finish(
            x, motion.q, motion.q_before, patch.nodes, patch.m, gamma, now, before, motion.q_new, motion.qd_new
        )

    def _minimise(self, gamma: float, report: StepReport) -> None:
        raise NotImplementedError


class BlockDescent(_Implicit):
    """Implicit step by a fixed number of Chebyshev-accelerated Jacobi sweeps (or fewer, when nothing moves)."""

    def __init__(self, load: Load, drag: float, options: Options) -> None:
        super().__init__(load, drag, options)
        self.move = np.zeros_like(self.centre)
        self.spectrum = Spectrum(load)
        self._gamma = self._low = 0.0

    def _minimise(self, gamma: float, report: StepReport) -> None:
        load, options = self.load, self.options
        if gamma != self._gamma:
            self._gamma, self._low = gamma, self.spectrum.low(self.weight, options.sweeps)
        sweeps, residual, wish = kernels.accelerated_sweeps(
            load.x, load.patch.scene, load.moment, load.scratch, self.weight, self.centre, self._low, self.spectrum.high,
            options.sweeps, options.sweep_tolerance, REACH, load.force, self.move,
        )  # fmt: skip
        report.iterations += sweeps
        report.residual = max(report.residual, residual)
        report.converged = report.converged and wish < SETTLED


class ConjugateGradient(_Implicit):
    """Implicit step by a few nonlinear conjugate gradient iterations, preconditioned with the stiffness at rest."""

    def __init__(self, load: Load, drag: float, options: Options) -> None:
        super().__init__(load, drag, options)
        m = load.patch.m
        self.copies = load.patch.half.copies[:, 0].copy()
        self.work = (*(np.zeros((m, 3)) for _ in range(5)), np.zeros((m, 4)))
        self.stiffness = scalar_stiffness(load)
        self.touching = contact_stiffness(load)
        self.order = elimination_order(self.stiffness, load.patch.scene.tethers.rest[:m])
        self.factors: dict[float, Factor] = {}

    def _minimise(self, gamma: float, report: StepReport) -> None:
        load, options = self.load, self.options
        if gamma not in self.factors:
            if len(self.factors) > MOST_FACTORS:
                self.factors.clear()
            self.factors[gamma] = incomplete_factor(
                self.stiffness, self.order, self.touching + self.weight[: load.patch.m], self.copies
            )
        iterations, residual, move = kernels.conjugate_gradient(
            load.x, load.patch.scene, load.moment, load.scratch, self.weight, self.centre, load.patch.half,
            self.factors[gamma],
            options.iterations, options.iteration_tolerance, REACH, load.force, self.work,
        )  # fmt: skip
        report.iterations += iterations
        report.residual = max(report.residual, residual)
        report.converged = report.converged and move < SETTLED


class QuasiStatic(_Patchwise):
    """Passes over V_q along the residual force, without inertia or drag: w = 0 in the implicit step."""

    def __init__(self, load: Load, drag: float, options: Options) -> None:
        super().__init__(load, drag, options)
        n = len(load.patch.nodes)
        self.weight = np.zeros(n)
        self.centre = np.zeros((n, 3))
        self.move = np.zeros((n, 3))
        self.head = np.full(n, -1, dtype=np.int32)
        self.link = np.zeros(4 * len(load.moment.planes.offset), dtype=np.int32)
        self.spectrum = Spectrum(load)
        self.low = self.spectrum.low(self.weight, options.passes)

    def advance(self, motion: Motion, h: float, report: StepReport) -> None:
        """Move the free vertices after those of `motion.q_new`, which have gone ahead."""
        load, patch, x = self.load, self.load.patch, self.load.x
        kernels.gather(motion.q_new, motion.qd, patch.nodes, patch.held, load.moment, x, self.v)
        self.v[patch.m :] = 0.0
        load.ahead(self.v, h, self.options.sweep_tolerance, REACH, PAIR_REACH)
        options, scene = self.options, patch.scene
        if options.quasi_static == "chebyshev":
            kernels.accelerated_sweeps(
                x, scene, load.moment, load.scratch, self.weight, self.centre, self.low, self.spectrum.high,
                options.passes,
                options.sweep_tolerance, REACH, load.force, self.move,
            )  # fmt: skip
        else:
            kernels.contact_chains(load.moment.planes, self.head, self.link)
            for _ in range(options.passes):
                kernels.sweep_in_place(
                    x, 0, patch.m, scene, load.moment, self.weight, self.centre, OMEGA, self.head, self.link
                )
        kernels.put(x, motion.q, patch.nodes[: patch.m], h, motion.q_new, motion.qd_new)


class FullNewton(_Implicit):
    """The same step solved to the end."""

    def __init__(self, load: Load, drag: float, options: Options) -> None:
        super().__init__(load, drag, options)
        self.newton = Newton(load)

    def _minimise(self, gamma: float, report: StepReport) -> None:
        done = self.newton.minimise(
            self.load.x, weight=self.weight, centre=self.centre, tolerance=self.options.newton_tolerance,
            most=self.options.newton_most, most_rounds=2,
        )  # fmt: skip
        report.iterations += done.steps
        report.residual = max(report.residual, done.residual)
        report.converged = report.converged and done.converged


class SemiImplicit(_Patchwise):
    """Per-node implicit update, neighbours at their present place: stable for every step, slow modes lag."""

    def advance(self, motion: Motion, h: float, report: StepReport) -> None:
        """Advance by one step."""
        load = self.load
        self._gather(motion)
        load.touch(load.x, REACH, PAIR_REACH)
        residual = kernels.semi_implicit_step(
            load.x, self.v, load.patch.scene, load.moment, load.scratch, load.patch.mass, self.drag, h, load.force
        )
        self._scatter(motion)
        report.iterations += 1
        report.residual = max(report.residual, residual)


class Paper(_Patchwise):
    """Eqs. 18-19 as printed, signs repaired: neighbours extrapolated, secant stiffness. Unstable for large steps."""

    def __init__(self, load: Load, drag: float, options: Options) -> None:
        super().__init__(load, drag, options)
        self.ahead = np.zeros_like(load.x)
        self.head = np.full(len(load.x), -1, dtype=np.int32)
        self.link = np.zeros(4 * len(load.moment.planes.offset), dtype=np.int32)

    def advance(self, motion: Motion, h: float, report: StepReport) -> None:
        """Advance by one step."""
        load = self.load
        self._gather(motion)
        load.touch(load.x, REACH, PAIR_REACH)
        kernels.contact_chains(load.moment.planes, self.head, self.link)
        residual = kernels.paper_step(
            load.x, self.v, self.ahead, load.patch.scene, load.moment, load.patch.mass, self.drag, h,
            int(self.options.secant), load.force, self.head, self.link,
        )  # fmt: skip
        self._scatter(motion)
        report.iterations += 1
        report.residual = max(report.residual, residual)


class Explicit(_Patchwise):
    """Leapfrog, divided into as many substeps as the present stiffness asks for.

    Bones and muscles go evenly from where the last step left them to the control, which holds at the step's end.
    """

    def __init__(self, load: Load, drag: float, options: Options) -> None:
        super().__init__(load, drag, options)
        shapes = load.activation.shape, load.moment.pose.shape
        self.start, self.end, self.work = (Drive(np.zeros(shapes[0]), np.zeros(shapes[1])) for _ in range(3))
        self.reached = np.nan

    def advance(self, motion: Motion, h: float, report: StepReport) -> None:
        """Advance by one step."""
        load, patch = self.load, self.load.patch
        self._gather(motion)
        np.take(motion.q, patch.nodes, axis=0, out=load.x, mode="clip")
        self.end.activation[:] = load.activation
        self.end.pose[:] = load.moment.pose
        if motion.t != self.reached:
            self._stand(self.end)
        kernels.at_share(self.start, self.end, 0.0, self.work, patch.scene, load.moment)
        load.touch(load.x, REACH, PAIR_REACH)
        substeps, residual = kernels.leapfrog(
            load.x, self.v, patch.held, self.start, self.end, self.work, patch.scene, load.moment, load.scratch,
            patch.mass, self.drag, h, self.options.safety, MOST_SUBSTEPS, REACH, load.force,
        )  # fmt: skip
        self._stand(self.end)
        self.reached = motion.t + h
        self._scatter(motion)
        report.iterations += substeps
        report.residual = max(report.residual, residual)

    def _stand(self, drive: Drive) -> None:
        self.start.activation[:] = drive.activation
        self.start.pose[:] = drive.pose

    def largest_step(self) -> float:
        """Return the largest stable step at rest [s]."""
        load, patch = self.load, self.load.patch
        load.rest()
        force = load.forces(load.x)
        return float(kernels.largest_substep(patch.scene, patch.mass, self.drag, 1.0, self.options.safety, force))


SCHEMES: dict[
    str,
    type[ConjugateGradient] | type[BlockDescent] | type[FullNewton] | type[SemiImplicit] | type[Paper] | type[Explicit],
] = {
    "paper": Paper,
    "semi_implicit": SemiImplicit,
    "conjugate_gradient": ConjugateGradient,
    "block_descent": BlockDescent,
    "explicit": Explicit,
    "newton": FullNewton,
}


class Spectrum:
    """The eigenvalues of a patch's stiffness divided by its stiffness bounds: what sweeps must damp."""

    def __init__(self, load: Load) -> None:
        self.load = load
        load.rest()
        self.stiffness = load.forces(load.x)[:, 3].copy()
        self.high = min(HIGHEST, MARGIN * self._largest())

    def _largest(self) -> float:
        """Return the largest eigenvalue at rest, by power iteration on differences of forces."""
        load, m, step = self.load, self.load.patch.m, 1e-4
        if m == 0:
            return 1.0
        base = load.forces(load.x)[:m, :3].copy()
        k = np.maximum(self.stiffness[:m, None], 1e-12)
        direction = np.random.default_rng(7).standard_normal((m, 3))
        trial, value = load.x.copy(), 1.0
        for _ in range(40):
            direction /= np.sqrt((direction**2 * k).sum() / k.sum())
            trial[:m] = load.x[:m] + step * direction
            image = (base - load.forces(trial)[:m, :3]) / (step * k)
            value = float((direction * image * k).sum() / (direction**2 * k).sum())
            direction = image
        return max(value, 1.0)

    def low(self, weight: Floats, sweeps: int) -> float:
        """Return the lower end of what `sweeps` sweeps should damp.

        That is what inertia and tethers hold of a vertex's whole stiffness, but no less than so few can resolve.
        """
        m = self.load.patch.m
        held = weight[:m] + self.load.patch.scene.tethers.stiffness[:m]
        share = float(np.median(held / (weight[:m] + self.stiffness[:m]))) if m else 1.0
        return min(0.9 * self.high, max(share, self.high * (RESOLVED / max(sweeps, 2)) ** 2))


def make_scheme(load: Load, drag: float, options: Options) -> Scheme:
    """Return the scheme that `options` names, bound to one patch."""
    return SCHEMES[options.scheme](load, drag, options)
