"""The equilibrium of a model: Newton's method on its energy, with a sparse direct factor and a line search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from faceanim.backends.octree_mass_spring.direct import solve
from faceanim.backends.octree_mass_spring.model import Model
from faceanim.ground.arrays import Floats
from faceanim.kernels import lattice as kernels

Load = Callable[[Floats], tuple[Floats, float]]
"""Outer forces (n, 3) [mN] on the nodes at x (n, 3), and their potential [uJ]."""


@dataclass
class StaticReport:
    """How the search ended: `steps` Newton steps, largest unbalanced force `residual` [mN], whether it `converged`."""

    steps: int = 0
    residual: float = 0.0
    converged: bool = True


def dead_load(force: Floats) -> Load:
    """Return the load of constant nodal forces (n, 3) [mN]."""
    return lambda x: (force, -float((force * x).sum()))


def inner_energy(model: Model, x: Floats, target: Floats) -> float:
    """Return the energy of springs, hexahedra and ties [uJ]."""
    tables = model.tables
    return float(
        kernels.spring_energy(x, tables.springs)
        + kernels.hex_energy(x, tables.hexes)
        + kernels.tie_energy(x, tables.ties, target)
        + kernels.barrier_energy(x, tables.cells, tables.barrier)
    )


def equilibrium(
    model: Model,
    start: Floats,
    load: Load,
    target: Floats | None = None,
    *,
    free: np.ndarray | None = None,
    tolerance: float = 1e-11,
    most: int = 200,
) -> tuple[Floats, StaticReport]:
    """Return the nodes (n, 3) in equilibrium near `start` (n, 3), where what is not free stays, and a report.

    target : (t, 3) of the ties, zeros if none are held   free : (n,) nodes that may move (default: those not carried)
    tolerance : largest unbalanced force as a share of the largest outer or inner one   most : cap of Newton steps
    """
    search = _Search(model, load, target, model.free_mask() if free is None else free)
    x = np.ascontiguousarray(start, dtype=np.float64).copy()
    kernels.follow(x, model.tables.slaves)
    report = StaticReport()
    if not search.free.any():
        return x, report
    energy, force = search.at(x)
    goal = tolerance * max(np.abs(force).max(), search.outer) + search.rounding(x)
    for report.steps in range(most + 1):
        report.residual = float(np.abs(force).max())
        report.converged = report.residual <= goal
        if report.converged or report.steps == most or not np.isfinite(report.residual):
            break
        step = search.direction(x, force)
        moved = search.line(x, step, energy, force)
        if moved is None:
            report.converged = report.residual <= 1e3 * goal
            break
        x, energy, force = moved
    return x, report


class _Search:
    """One minimisation: the energy of the free nodes and its derivatives."""

    def __init__(self, model: Model, load: Load, target: Floats | None, free: np.ndarray) -> None:
        self.model, self.load = model, load
        self.target = np.zeros((len(model.tables.ties.stiffness), 3)) if target is None else target
        free = free.copy()
        free[model.tables.slaves.node] = False
        self.free = free
        self.lift = sparse.kron(model.reduce[:, free], sparse.identity(3)).tocsr()
        self.outer = 0.0
        self._force = np.zeros_like(model.points)
        self._volume = np.zeros(len(model.corner))

    def at(self, x: Floats) -> tuple[float, Floats]:
        """Return the energy and the forces on the free nodes, (m, 3)."""
        outer, potential = self.load(x)
        self.outer = float(np.abs(outer).max(initial=0.0))
        tables = self.model.tables
        kernels.watch(x, tables.cells, tables.barrier, 0.0, self._volume)
        kernels.all_forces(x, outer, tables, self.target, self._force)
        return inner_energy(self.model, x, self.target) + potential, self._force[self.free]

    def rounding(self, x: Floats) -> float:
        """Return the unbalanced force that rounding of positions leaves at best [mN]."""
        tables = self.model.tables
        stiffest = max(float(k.max(initial=0.0)) for k in (tables.springs.stiffness, tables.ties.stiffness))
        return 8.0 * float(np.finfo(float).eps) * stiffest * float(np.abs(x).max())

    def direction(self, x: Floats, force: Floats) -> Floats:
        """Return the Newton step of all nodes, (n, 3)."""
        k = (self.lift.T @ self.model.stiffness_at(x) @ self.lift).tocsc()
        shift = 1e-12 * float(k.diagonal().max())
        step = solve(k + shift * sparse.identity(k.shape[0], format="csc"), force.ravel())
        return np.asarray((self.lift @ step).reshape(-1, 3))

    def line(self, x: Floats, step: Floats, energy: float, force: Floats) -> tuple[Floats, float, Floats] | None:
        """Return the first shortened step that lowers the energy, or near its floor the unbalanced force; None if none."""
        slope = -float((force * step[self.free]).sum())
        size = np.abs(force).max()
        t = 1.0
        for _ in range(40):
            new = x + t * step
            e, f = self.at(new)
            lower = e <= energy + 1e-4 * t * slope
            level = e <= energy + 1e-11 * abs(energy) + 1e-300 and np.abs(f).max() < 0.9 * size
            if np.isfinite(e) and (lower or level):
                return new, e, f
            t *= 0.5
        return None
