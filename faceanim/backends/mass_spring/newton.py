"""Newton's method with conjugate gradients inside, for equilibria and for fully implicit steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from faceanim.backends.mass_spring import kernels
from faceanim.backends.mass_spring.load import Load
from faceanim.ground.arrays import Floats
from faceanim.kernels import attachment, contact, linalg3, muscles, tangent

REACH = 6.0
"""Contacts within this distance [mm] are watched in a Newton step, which moves no vertex farther than 5 mm."""
LONGEST = 5.0
FREEZE = 0.05
"""Contacts are found anew after steps longer than this [mm]; after shorter ones they stay until the end is reached."""
STILL = 1e-3
"""The contacts are final when the way to the minimum with them was about as short as this [mm]."""
MOST_REFRESHES = 60
HEIGHT_SHARE = 0.6
"""No step may use up more than this share of a triangle's height: beyond it the triangle would turn over."""
SOFTEST = 1e-6
"""Added to the diagonal, as a share of its mean: a flat sheet that nothing holds has no stiffness across."""


@dataclass
class NewtonReport:
    """steps, inner : Newton steps and conjugate gradient iterations;  movement : last step [mm];  residual [mN]"""

    steps: int = 0
    inner: int = 0
    movement: float = np.inf
    residual: float = np.inf
    converged: bool = False


@dataclass
class Trial:
    """A step that may be taken: where it leads, how it was limited, how it agrees with the model, how long it is."""

    x: Floats
    border: int
    fraction: float
    gain: float
    energy: float
    movement: float
    length: float


class Newton:
    """Minimises the energy of a patch, with an optional inertia term w/2 |x - centre|^2 per vertex."""

    def __init__(self, load: Load) -> None:
        patch = load.patch
        n, e = len(patch.nodes), len(patch.pairs)
        self.load = load
        self.diagonal = np.zeros((n, 6))
        self.inverse = np.zeros((n, 6))
        self.metric = np.zeros((n, 6))
        self.coupling = np.zeros((e, 9))
        self.tangent = np.zeros(len(load.moment.planes.offset))
        self.gradient = np.zeros((n, 3))
        self.step = np.zeros((n, 3))
        self.trials = np.zeros((2, n, 3))
        self.exact = False
        self.work = np.zeros((4, n, 3))
        self.zero = np.zeros(n)
        self.nowhere = np.zeros((n, 3))

    def minimise(
        self,
        x: Floats,
        *,
        weight: Floats | None = None,
        centre: Floats | None = None,
        tolerance: float,
        most: int,
        most_rounds: int = 6,
    ) -> NewtonReport:
        """Move the free vertices of `x` (n, 3) to the minimum; stop when a full step moves none by `tolerance` [mm].

        Trust region: the step stays within a radius that grows and shrinks with the success of the quadratic model.
        Contacts are half spaces, found anew after every step as long as steps are long, and again once the minimum
        with them has been reached, until that moves nothing any more or `most_rounds` minima have been seen (a vertex
        on a crease may hop between two of them for ever).
        """
        self.weight = self.zero if weight is None else weight
        self.centre = self.nowhere if centre is None else centre
        report = NewtonReport(movement=0.0, residual=0.0, converged=True)
        if self.load.patch.m == 0:
            return report
        report.converged = False
        self.radius = np.inf
        refreshes = rounds = 0
        polish = False
        before = self._refresh(x, report)
        for report.steps in range(1, most + 1):
            if not np.isfinite(report.residual):
                break
            forcing = min(0.1, max(1e-7, 0.3 * (report.residual / max(before, 1e-300)) ** 1.5))
            accepted, full = self._step(x, forcing, report)
            if not accepted:
                continue
            before = report.residual
            near = full and report.movement < STILL
            if near and not polish:
                rounds += 1
                polish = self.travel < 2.0 * STILL or rounds == most_rounds
            if not polish and (near or (report.movement > FREEZE and refreshes < MOST_REFRESHES)):
                refreshes += 1
                self._refresh(x, report)
                continue
            report.residual = self._gradient(x)
            if polish and full and report.movement < tolerance:
                report.converged = True
                break
            self._assemble(x, True)
        return report

    def _refresh(self, x: Floats, report: NewtonReport) -> float:
        """Find the contacts anew and evaluate everything at `x`; return the residual."""
        self.load.touch(x, REACH)
        self.travel = 0.0
        self.energy = self._energy(x)
        report.residual = self._gradient(x)
        self._assemble(x, True)
        if not np.isfinite(self.radius):
            self.radius = self._first_radius()
        return report.residual

    def _step(self, x: Floats, forcing: float, report: NewtonReport) -> tuple[bool, bool]:
        """Try one step; return whether it was taken, and whether it was a full Newton step."""
        if not self.exact:
            self._assemble(x, True)
        best = self._try(x, forcing, self.radius, self.trials[0], report)
        if best.border == 2 and best.movement > FREEZE:
            # Where the energy is concave, the projected matrix may know a better way.
            self._assemble(x, False)
            other = self._try(x, 0.1, np.inf, self.trials[1], report)
            best = other if other.energy < best.energy else best
        if best.gain > 0.75 and best.fraction == 1.0:
            self.radius = max(self.radius, 2.0 * best.length) if best.border else self.radius
        elif best.gain < 0.25:
            self.radius = (0.5 if best.gain > 1e-3 else 0.25) * best.length
        report.movement = best.movement
        if not best.gain > 1e-3:
            return False, False
        x[:] = best.x
        self.energy = best.energy
        self.travel += best.movement
        return True, best.fraction == 1.0 and not best.border

    def _try(self, x: Floats, forcing: float, radius: float, out: Floats, report: NewtonReport) -> Trial:
        """Write `x` after one step of at most `radius` with the matrix assembled last into `out`."""
        inner, border, decrease = self._direction(forcing, radius)
        report.inner += inner
        fraction = self._shorten(x)
        decrease *= fraction * (2.0 - fraction)
        np.add(x, self.step, out=out)
        energy = self._energy(out)
        gain = (self.energy - energy) / decrease if decrease > 1e-12 * abs(self.energy) else 1.0
        return Trial(out, border, fraction, gain, energy, float(np.abs(self.step).max(initial=0.0)), self._length())

    def _gradient(self, x: Floats) -> float:
        """Compute the downhill `gradient` and return its largest nodal value [mN]."""
        load = self.load
        attachment.find_shift(x, load.moment.anchor, load.moment.shift)
        kernels.residual_force(
            x, load.patch.scene, load.moment, load.scratch, self.weight, self.centre, load.force, self.gradient
        )
        return float(kernels.longest(self.gradient))

    def _length(self) -> float:
        """Return the norm of `step` in the metric of the preconditioner."""
        linalg3.multiply_symmetric(self.metric, self.step, self.work[0])
        return float(np.sqrt(max(0.0, (self.work[0] * self.step).sum())))

    def _assemble(self, x: Floats, exact: bool) -> None:
        self.exact = exact
        load, patch = self.load, self.load.patch
        tangent.spring_matrix(
            x, patch.scene.springs, patch.scene.law, patch.edge_of, int(exact), self.diagonal, self.coupling
        )
        attachment.shear_coupling(
            x, load.moment.anchor, patch.pairs, patch.shear[:, 0], patch.shear[:, 1], self.coupling
        )
        soft = SOFTEST * float(self.diagonal[: patch.m, [0, 3, 5]].mean()) if patch.m else 0.0
        contact.plane_tangent(x, load.moment.planes, patch.scene.colliders.stiffening, self.tangent)
        tangent.spring_blocks(x, patch.scene.springs, patch.scene.law, 0, self.metric)
        for block in (self.diagonal, self.metric):
            attachment.tether_blocks(x, load.moment.anchor, patch.scene.tethers, patch.m, block)
            muscles.fibre_blocks(x, load.moment, patch.m, block)
            block[:, [0, 3, 5]] += (self.weight + soft)[:, None]
        contact.plane_blocks(load.moment.planes, self.tangent, 0, self.metric)
        self.inverse[:] = self.metric
        tangent.invert_positive(self.inverse, patch.m)

    def _direction(self, forcing: float, radius: float) -> tuple[int, int, float]:
        """Compute `step` and return (iterations, whether at the border, predicted decrease)."""
        load, patch = self.load, self.load.patch
        result: tuple[int, int, float] = tangent.conjugate_gradient(
            self.diagonal, self.coupling, patch.pairs, patch.m, patch.n_pair, load.moment.planes, self.tangent, self.inverse,
            self.gradient, forcing, 500, radius, self.work, self.step,
        )  # fmt: skip
        return result

    def _first_radius(self) -> float:
        m = self.load.patch.m
        return LONGEST * float(np.sqrt(self.metric[:m, [0, 3, 5]].sum(axis=1).mean() / 3.0 * max(m, 1)))

    def _energy(self, x: Floats) -> float:
        m = self.load.patch.m
        inertia = 0.5 * float((self.weight[:m] * ((x[:m] - self.centre[:m]) ** 2).sum(axis=1)).sum())
        return self.load.energy(x).total + inertia

    def _shorten(self, x: Floats) -> float:
        """Shorten `step` until it turns no triangle over and moves no vertex farther than `LONGEST`;
        return by which factor."""
        m = self.load.patch.m
        fraction = tangent.step_limit(x, self.step, self.load.patch.scene.springs, HEIGHT_SHARE)
        longest = float(np.sqrt((self.step[:m] ** 2).sum(axis=1).max(initial=0.0)))
        fraction = min(fraction, LONGEST / longest if longest > LONGEST else 1.0)
        self.step *= fraction
        return fraction
