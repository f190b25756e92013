"""Equilibrium as the minimum of an energy: Newton's method with a line search, and load steps where one does not do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import UserError

EPS = float(np.finfo(np.float64).eps)
ARMIJO = 1e-4
"""A step must lower the energy by this share of what its slope promises."""
SHORTEST = 1e-9
"""A line search gives up at this share of the step."""
STRAIGHT = 0.05
"""Below this share of the step a constraint is straight enough: no correction is tried."""
FLAT = 8
"""After so many steps that changed the energy by no more than rounding does, it is of no use to go on."""


class Factorisation(Protocol):
    """A tangent that can be solved with, for the freedoms that are free."""

    def factor(self, values: Floats, shift: float = 0.0) -> bool:
        """Factorise the tangent with these `values` plus `shift` I; return whether it could be."""

    def solve(self, right: Floats, moved: Floats | None = None) -> Floats:
        """Return the change of the free freedoms, (n, 3), that balances `right`; `moved` (n, 3) are the fixed ones'."""

    def definite(self) -> bool:
        """Return whether the tangent factorised last is positive definite on the freedoms that are free."""


@runtime_checkable
class Correcting(Protocol):
    """A factorisation that knows how a stiff constraint bends away from the tangent along a step."""

    def correction(self, x: Floats, step: Floats) -> Floats:
        """Return what added to `x` + `step` restores the constraint to what the tangent promised, (n, 3)."""


class System(Protocol):
    """What has an energy over positions (n, 3); `points` are the rest positions.

    indices : its length is that of the tangent's values   linear : whether the law holds at any deformation
    barrier : whether it forbids inversion
    stiffness_scale : [uJ] the elastic energy of a body whose strains are all about 1, as a measure of rounding
    """

    points: Floats
    indices: Ints

    @property
    def linear(self) -> bool: ...

    @property
    def barrier(self) -> bool: ...

    @property
    def stiffness_scale(self) -> float: ...

    def energy(self, x: Floats) -> float:
        """Return the energy [uJ], infinite where it has none."""

    def forces(self, x: Floats) -> Floats:
        """Return minus the gradient, (n, 3) [mN]."""

    def force_scale(self) -> float:
        """Return the largest force of a single element in the last call of `forces` [mN]."""

    def volume_ratio(self, x: Floats) -> Floats:
        """Return the smallest det F of every element, (e,) [-]."""

    def tangent_values(self, x: Floats, out: Floats, *, definite: bool = False) -> Floats:
        """Write the values of the tangent in its fixed pattern into `out`, and return it."""

    def factorisation(self, free: Bools) -> Factorisation:
        """Return what solves with the tangent over the freedoms that are `free`, (n, 3)."""


@runtime_checkable
class Remembering(Protocol):
    """A system whose tangent depends on the tangents before it."""

    def forget(self) -> None:
        """Make the next tangent that of a new search."""


class Term(Protocol):
    """A part of the energy besides the elements' and constant forces.

    One whose Hessian can be indefinite may also offer `add_definite_tangent`, with negative eigenvalues raised to zero.
    """

    def energy(self, x: Floats) -> float:
        """Return the energy [uJ]."""

    def forces(self, x: Floats) -> Floats:
        """Return minus its gradient, (n, 3) [mN]."""

    def add_tangent(self, x: Floats, values: Floats) -> None:
        """Add its Hessian to `values` in the elements' pattern."""


@dataclass
class Report:
    """How a search for equilibrium went.

    iterations : Newton steps in all   softened : those that needed the definite tangent   load_steps : accepted
    residual : largest unbalanced force on a free freedom [mN]   fraction : of the load and movement that was reached
    least_ratio : smallest det F over all quadrature points at the end   inverted : elements where it is not positive
    valid : whether the law means anything there (no element is inverted, or the law is linear)
    definite : whether the last tangent was positive definite, None = not asked for
    """

    iterations: int = 0
    softened: int = 0
    load_steps: int = 0
    residual: float = np.inf
    converged: bool = False
    fraction: float = 0.0
    least_ratio: float = np.nan
    inverted: int = 0
    valid: bool = True
    definite: bool | None = None
    history: list[float] = field(default_factory=list)


class Newton:
    """Minimises the energy of `elements` and `terms` less the work of constant forces, over the freedoms that are free.

    tolerance : residual over the largest force of an element, of a term or of the load, to which it goes
    most : Newton steps before a load counts as too much at once
    """

    def __init__(
        self, elements: System, free: Bools, terms: Sequence[Term] = (), *, tolerance: float = 1e-9, most: int = 60
    ) -> None:
        self.elements, self.terms, self.free = elements, tuple(terms), free
        self.tolerance, self.most = tolerance, most
        self.factor = elements.factorisation(free)
        self.values = np.zeros(len(elements.indices))
        self.rounding = 0.0

    def energy(self, x: Floats, force: Floats) -> float:
        """Return the energy less the work of `force` [uJ]; infinite where a law with a barrier is inverted."""
        moved = float((force * (x - self.elements.points)).sum())
        with np.errstate(invalid="ignore"):  # an unstable law may have energies without bound, both ways
            total = self.elements.energy(x)
            if not np.isfinite(total):
                return np.inf
            total += sum(term.energy(x) for term in self.terms) - moved
        return np.inf if np.isnan(total) else total

    def forces(self, x: Floats) -> tuple[Floats, float]:
        """Return elastic and term forces, (n, 3) [mN], and the largest single one."""
        total = self.elements.forces(x)
        scale = self.elements.force_scale()
        for term in self.terms:
            part = term.forces(x)
            scale = max(scale, float(np.abs(part[self.free]).max(initial=0.0)))
            total += part
        return total, scale

    def tangent(self, x: Floats, *, definite: bool = False) -> Floats:
        """Return the values of the whole tangent in the elements' pattern."""
        values = self.elements.tangent_values(x, self.values, definite=definite)
        for term in self.terms:
            add = getattr(term, "add_definite_tangent", term.add_tangent) if definite else term.add_tangent
            add(x, values)
        # what is left of a balance when positions are rounded
        self.rounding = 4.0 * EPS * float(np.abs(values).max() * np.abs(x).max())
        return values

    def forget(self) -> None:
        """Begin afresh: what the elements remember of the last tangent is of no use from another place."""
        if isinstance(self.elements, Remembering):
            self.elements.forget()

    def minimise(self, x: Floats, force: Floats, report: Report) -> bool:
        """Move the free freedoms of `x` (n, 3) to the minimum, in place; return whether it was found."""
        value = self.energy(x, force)
        self.rounding, flat = 0.0, 0
        for _ in range(self.most + 1):
            total, scale = self.forces(x)
            unbalanced = np.where(self.free, total + force, 0.0)
            report.residual = float(np.abs(unbalanced).max(initial=0.0))
            report.history.append(report.residual)
            scale = max(scale, float(np.abs(force[self.free]).max(initial=0.0)))
            if report.residual <= self.tolerance * scale + self.rounding:
                return True
            if not (np.isfinite(report.residual) and np.isfinite(value)) or flat >= FLAT:
                return False
            report.iterations += 1
            moved = self._advance(x, force, unbalanced, value, report)
            if moved is None:
                return False
            flat = flat + 1 if abs(value - moved) <= self._noise(x, force, value) else 0
            value = moved
        return False

    def _noise(self, x: Floats, force: Floats, value: float) -> float:
        """Return the change of an energy `value` that may be rounding alone [uJ]."""
        work = float((force * (x - self.elements.points)).sum())
        return 16.0 * EPS * (abs(value) + abs(work)) + 1e-3 * EPS * self.elements.stiffness_scale

    def _advance(self, x: Floats, force: Floats, unbalanced: Floats, value: float, report: Report) -> float | None:
        """Take one step from `x` with energy `value`, in place; return the new energy, None if there is no way down."""
        for definite in (False, True):
            values = self.tangent(x, definite=definite)
            report.softened += definite
            if not self.factor.factor(values):
                mean = float(np.abs(values).mean())
                if not definite or not self.factor.factor(values, 1e-8 * mean):
                    continue
            step = self.factor.solve(unbalanced)
            slope = -float((unbalanced * step).sum())
            if not (np.isfinite(slope) and slope < 0.0):
                continue
            moved = self._search(x, force, step, slope, value)
            if moved is not None:
                return moved
        return None

    def _search(self, x: Floats, force: Floats, step: Floats, slope: float, value: float) -> float | None:
        """Go along `step` as far as lowers the energy enough (no element with a barrier inverts), in place."""
        noise = self._noise(x, force, value)
        share = 1.0
        while share > SHORTEST:
            there = x + share * step
            new = self.energy(there, force)
            most = value + ARMIJO * share * slope + noise
            if new <= most:
                x[:] = there
                return new
            if share > STRAIGHT and isinstance(self.factor, Correcting):
                # the remedy for the Maratos effect: stiff constraints must not cut steps short (Nocedal & Wright, 15.6)
                there += self.factor.correction(x, share * step)
                new = min(new, bent := self.energy(there, force))
                if bent <= most:
                    x[:] = there
                    return bent
            fall = new - value - share * slope
            best = -0.5 * slope * share * share / fall if np.isfinite(new) and fall > 0.0 else 0.0
            share = min(max(best, 0.1 * share), 0.5 * share)
        return None

    def lifted(self, x: Floats, move: Floats, force: Floats) -> Floats | None:
        """Return `x` with the fixed freedoms moved by `move` and the others as a linear body would follow, or None."""
        total, _ = self.forces(x)
        if not self.factor.factor(self.tangent(x)):
            return None
        step = self.factor.solve(total + force, np.where(self.free, 0.0, move))
        there = x + np.where(self.free, step, move)
        return there if np.isfinite(self.elements.energy(there)) else None


def newton(
    elements: System,
    *,
    fixed: Any,
    values: Any = None,
    force: Any = None,
    start: Any = None,
    terms: Sequence[Term] = (),
    tolerance: float = 1e-9,
    most: int = 60,
    first_step: float = 1.0,
    least_step: float = 1.0 / 512.0,
    largest_step: float = 1.0,
    check_definite: bool = False,
    solver: Newton | None = None,
) -> tuple[Floats, Report]:
    """Return the equilibrium, (n, 3) [mm], and how it was found.

    fixed : (n, 3) or (n,) bool, freedoms that are prescribed   values : (n, 3) [mm], their positions (None = at rest)
    force : (n, 3) [mN], constant   start : (n, 3), where to begin (None = at rest)
    The whole load is tried at once, or `first_step` of it; what fails is divided, down to `least_step`; no step is
    larger than `largest_step`. Part t of the way is the balance with the unbalanced forces of `start` reduced to 1 - t
    and the fixed freedoms t of their way. When even the least step fails, the state reached and its fraction are
    returned with `report.converged` false.
    Raises `UserError` for arrays of wrong shape or with numbers that are not finite.
    """
    free = ~_freedoms(elements, fixed)
    x = _positions("start", start, elements).copy()
    goal = _positions("values", values, elements)
    load = np.zeros_like(x) if force is None else _positions("force", force, elements)
    search = solver if solver is not None else Newton(elements, free, terms, tolerance=tolerance, most=most)
    report = Report()
    search.forget()
    x, report.converged = _walk(search, x, goal, load, (first_step, least_step, largest_step), report)
    _judge(search, x, report, check_definite)
    return x, report


def _walk(
    search: Newton, x: Floats, goal: Floats, load: Floats, steps: tuple[float, float, float], report: Report
) -> tuple[Floats, bool]:
    """Follow the load from `x` to its end in steps as long as they converge; return where it got, and whether to the end."""
    free = search.free
    step, least, largest = steps
    step = min(step, largest)
    begin = np.where(free, 0.0, x)
    way = np.where(free, 0.0, goal) - begin
    total, _ = search.forces(x)
    held_back = np.where(free, -total - load, 0.0)
    if not np.isfinite(held_back).all():
        return x, False
    moves = bool(np.any(way))
    while report.fraction < 1.0:
        part = min(1.0, report.fraction + step)
        if part > 1.0 - 1e-9:
            part = 1.0
        force = load + (1.0 - part) * held_back
        there: Floats | None = x.copy()
        if moves:
            there = search.lifted(x, begin + part * way - np.where(free, 0.0, x), force)
        if there is not None and search.minimise(there, force, report):
            x, report.fraction = there, part
            report.load_steps += 1
            step = min(2.0 * step, largest)
        else:
            search.forget()
            step *= 0.25
            if step < least:
                return x, False
    return x, True


def _judge(search: Newton, x: Floats, report: Report, check_definite: bool) -> None:
    """Write what can be said about the final state into `report`."""
    ratio = search.elements.volume_ratio(x)
    report.least_ratio = float(ratio.min())
    report.inverted = int((ratio <= 0.0).sum())
    report.valid = report.inverted == 0 or search.elements.linear
    if check_definite and search.free.any():
        report.definite = search.factor.factor(search.tangent(x)) and search.factor.definite()


def _freedoms(elements: System, fixed: Any) -> Bools:
    array = np.asarray(fixed)
    n = len(elements.points)
    if array.dtype != np.bool_ or array.shape not in ((n,), (n, 3)):
        raise UserError(f"fixed must be bool of shape ({n},) or ({n}, 3), not {array.dtype} {array.shape}")
    return np.ascontiguousarray(np.broadcast_to(array.reshape(n, -1), (n, 3)))


def _positions(name: str, value: Any, elements: System) -> Floats:
    """Return `value` as checked (n, 3) numbers; None means the rest positions."""
    if value is None:
        return elements.points
    array = np.ascontiguousarray(value, dtype=np.float64)
    if array.shape != elements.points.shape or not np.isfinite(array).all():
        raise UserError(f"{name} has shape {array.shape}; {elements.points.shape} finite numbers are needed")
    return array
