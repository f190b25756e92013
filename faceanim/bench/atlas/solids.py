"""Maps of solids: Poisson's ratio and locking, force on a lattice's cells, stretch of elastic laws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np

from faceanim.bench.atlas import bodies
from faceanim.bench.atlas.cells import CONVERGED, INVERTED, REFUSED, WRONG, Axis, Cell, Limit, Plan
from faceanim.bench.atlas.limits import safe_force
from faceanim.bench.atlas.maps import FRAME, Effort, map_of, warmed
from faceanim.bench.atlas.schemes import Contender, contender
from faceanim.bench.atlas.trials import Goal, inverted_elements, settling_steps, stepped, surface
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.elements.newton import newton
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.shapes import box_tets
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError
from faceanim.tissue.craniofacial import tissue
from faceanim.tissue.stability import LAWS, MODES, nominal_stress, stability

LOCKED = 0.1
TIP = 2.0
"""Load at the end of the cantilever [mN]: it bends by a twentieth of its length."""
PAPER_BETA, SAFE_BETA = 0.49, 1.0 / 6.0


def poisson_plans(scene: str, whom: Sequence[Contender], effort: Effort) -> list[Plan]:
    """Return the maps over Poisson's ratio and mesh density: how far the tip of a cantilever is off."""
    ratios = effort.pick([0.3, 0.45, 0.49, 0.4999], [0.3, 0.4, 0.45, 0.48, 0.49, 0.495, 0.499, 0.4999, 0.5])
    x = Axis.of_words("Poisson's ratio", [f"{v:g}" for v in ratios])
    y = Axis(
        "cells along the bar", "", effort.pick([8.0, 16.0], [8.0, 12.0, 16.0, 24.0], [4.0, 8.0, 12.0, 16.0, 24.0, 32.0])
    )
    truth = lru_cache(maxsize=None)(_true_sag)

    def trial(who: Contender, ratio: str, cells: float) -> Cell:
        body = _cantilever(float(ratio), int(cells))
        solver = who.make(body)
        state = solver.solve_static(_tip_load(body))
        sag = _sag(body, surface(solver, state, body))
        error = abs(sag / truth(float(ratio)) - 1.0)
        outcome = CONVERGED if error <= LOCKED else WRONG
        said = f"sags {sag / truth(float(ratio)):.3f} of what it should"
        inverted = inverted_elements(solver, state, body)
        return Cell(INVERTED if inverted else outcome, said, error, 1)

    caption = (
        "A cantilever of 40 x 10 x 10 mm under a load at its end, against quadratic elements on a mesh of its own: "
        "locking shows as an error that grows with Poisson's ratio and falls slowly with the mesh."
    )
    return [
        Plan(map_of("poisson", scene, who, x, y, tolerance=LOCKED, measure="error of the sag", caption=caption),
             partial(trial, who), None, effort.guard, partial(warmed, who, _cantilever(0.3, 8)))
        for who in whom
    ]  # fmt: skip


def _cantilever(ratio: float, cells: int) -> Body:
    across = max(1, cells // 4)
    return bodies.cantilever((cells, across, across), ratio)


def _tip_load(body: Body) -> Control:
    control = Control.rest(body)
    x = body.surface.points
    tip = x[:, 0] > bodies.WIDTH - 1e-6
    control.force = np.zeros_like(x)
    control.force[tip, 1] = -TIP / tip.sum()
    return control


def _sag(body: Body, points: Floats) -> float:
    tip = body.surface.points[:, 0] > bodies.WIDTH - 1e-6
    return float((body.surface.points - points)[tip, 1].mean())


def _true_sag(ratio: float) -> float:
    """Return the sag [mm] of quadratic elements, twelve cells long."""
    body = _cantilever(ratio, 12)
    solver = contender("finite_elements", "", {"order": 2}).make(body)
    return _sag(body, surface(solver, solver.solve_static(_tip_load(body)), body))


def force_plans(scene: str, effort: Effort) -> list[Plan]:
    """Return the maps over force and cell size of a lattice: one corner of a block pressed in."""
    whom = [contender("octree_mass_spring", scheme, options) for scheme, options in (
        ("uniform", {"levels": 1}), ("uniform, no barrier", {"barrier": 0.0, "levels": 1}), ("dynamic", {"dynamic": True}),
    )]  # fmt: skip
    forces = [float(f"{f:.3g}") for f in np.geomspace(1.0, 1e4, effort.pick([5], [9], [17])[0])]
    x = Axis("force on one corner", "mN", forces, log=True)
    y = Axis("cell", "mm", effort.pick([10.0, 5.0], [10.0, 5.0, 2.5], [10.0, 5.0, 2.5, 1.25]), log=True)
    caption = (
        "One corner of a block of 20 mm is pressed inwards. Lines: the force that moves the corner by beta cells in one "
        "step, beta h m / dt^2, dt the largest safe step; right if it comes to the equilibrium without inverted cells."
    )
    return [
        Plan(map_of("force", scene, who, x, y, caption=caption),
             partial(_pressed, who, effort), partial(_safe_lines, who, y.values), effort.guard)
        for who in whom
    ]  # fmt: skip


def _sized(who: Contender, cell: float) -> Contender:
    options = {"cells": None, "cell_size": cell}

    def make(body: Body) -> Any:
        solver = who.make(body)
        changed = {name: getattr(solver.options, name) for name in vars(solver.options)} | options
        changed["cells"] = solver.options.cells
        return type(solver)(body, type(solver.options)(**changed))

    return Contender(who.backend, who.scheme, make)


def _pressed(who: Contender, effort: Effort, force: float, cell: float) -> Cell:
    body = bodies.block()
    solver, control = _sized(who, cell).make(body), Control.rest(body)
    x = body.surface.points
    corner = int(np.argmax(x.sum(axis=1)))
    control.force = np.zeros_like(x)
    control.force[corner] = -force / np.sqrt(3.0)
    still = surface(solver, solver.solve_static(control), body)
    goal = Goal(body, still, max(float(np.linalg.norm(still - x, axis=1).max()), 1e-6), 0.05)
    return stepped(solver, solver.rest(), goal, control=lambda k: control, dt=FRAME, steps=settling_steps(body, FRAME),
                   deadline=effort.seconds)  # fmt: skip


def _safe_lines(who: Contender, sizes: list[float]) -> list[Limit]:
    solvers = [_sized(who, cell).make(bodies.block()) for cell in sizes]
    return [Limit(f"safe box, beta {beta:.2g}", [safe_force(s, beta) for s in solvers], sizes)
            for beta in (SAFE_BETA, PAPER_BETA)]  # fmt: skip


STRETCHES = (
    0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.98, 1.01, 1.03, 1.05, 1.08, 1.11, 1.14, 1.2, 1.3, 1.5, 1.75, 2.0,
)  # fmt: skip
NEARLY = 0.4999
"""Poisson's ratio that stands for incompressible; St. Venant-Kirchhoff has the printed one."""
STRETCHED = (*LAWS, "stvk")
"""Laws whose stretch is tried: those of `tissue.stability`, and St. Venant-Kirchhoff for its inversion."""


def stretch_plans(scene: str, effort: Effort) -> list[Plan]:
    """Return one map per elastic law: stretch against tissue and mode, with the limits of `tissue.stability`."""
    stretches = effort.pick(STRETCHES[1::3], STRETCHES)
    rows = {f"{name}, {mode}": (name, mode) for name in ("skin", "muscle", "fat") for mode in MODES}
    x, y = Axis("stretch", "", stretches), Axis.of_words("tissue and mode", list(rows))
    caption = (
        "A block under imposed stretch, its inside shaken, by Newton's method: right if the nominal stress is that of "
        "the incompressible law and the balance is stable. Marks: where the law loses its ellipticity (any mode), and "
        "Drucker's limit of the mode."
    )

    def trial(law: str, stretch: float, row: str) -> Cell:
        return _stretched(law, *rows[row], stretch)

    return [
        Plan(map_of("stretch", scene, None, x, y, of=law, title=f"law {law}", tolerance=0.05, caption=caption,
                    measure="error of the nominal stress"),
             partial(trial, law), partial(_stretch_marks, law, rows), effort.guard)
        for law in STRETCHED
    ]  # fmt: skip


def _stretched(law: str, name: str, mode: str, stretch: float) -> Cell:
    """Return what becomes of a block of a tissue under a law at a stretch of a mode."""
    flesh = tissue(name, poisson_ratio=NEARLY if law in LAWS else None)
    mesh = box_tets((2, 2, 2), (1.0, 1.0, 1.0))
    elements = Elements(mesh, flesh, law=law)
    x = mesh.points
    power = np.array(MODES[mode])
    goal = x * stretch**power
    # each face slides in its own plane; those that the machine drives have an imposed place
    low, high = np.abs(x) < 1e-9, np.abs(x - 1.0) < 1e-9
    fixed = low | (high & (power >= 0.0) & ((power != 0.0) | (mode == "planar")))
    start = goal + 0.01 * np.random.default_rng(4).standard_normal(x.shape) * ~fixed
    found, report = newton(elements, fixed=fixed, values=goal, start=start, check_definite=True)
    if not report.converged:
        return Cell(REFUSED, f"Newton's method found no balance ({report.iterations} steps)", None, report.iterations)
    inverted = int((elements.volume_ratio(found) <= 0.0).sum())
    if inverted:
        return Cell(INVERTED, f"{inverted} elements inverted", None, report.iterations)
    stress = -float(elements.forces(found)[high[:, 0], 0].sum())
    expected = nominal_stress(flesh, law if law in LAWS else "neo_hookean", mode, stretch)
    error = abs(stress / expected - 1.0)
    if law not in LAWS:
        return _definite(report, Cell(CONVERGED, f"stress {stress:.4g} kPa; no incompressible form to compare with",
                                      None, report.iterations))  # fmt: skip
    outcome = CONVERGED if error <= 0.05 else WRONG
    return _definite(
        report, Cell(outcome, f"stress {stress:.4g}, should be {expected:.4g} kPa", error, report.iterations)
    )


def _definite(report: Any, cell: Cell) -> Cell:
    if report.definite is False:
        return Cell(WRONG, f"the balance is not stable; {cell.reason}", cell.error, cell.steps)
    return cell


def _stretch_marks(law: str, rows: dict[str, tuple[str, str]]) -> list[Limit]:
    """Return the largest and least stable stretch of each row, by ellipticity and by Drucker's test."""
    if law not in LAWS:
        return []
    found: Callable[[str], Any] = lru_cache(maxsize=None)(lambda name: _stability(name, law))
    out = []
    for label, measure in (("ellipticity lost", "ellipticity"), ("Drucker's limit", "drucker")):
        places: list[tuple[float, float]] = []
        for k, (name, mode) in enumerate(rows.values()):
            for side in (found(name).tension, found(name).compression):
                value = getattr(side[mode], measure)
                if 0.0 < value < np.inf:
                    places.append((value, float(k)))
        if places:
            out.append(Limit(label, [p[0] for p in places], [p[1] for p in places]))
    return out


def _stability(name: str, law: str) -> Any:
    try:
        return stability(tissue(name), law)
    except UserError:
        return stability(tissue(name), "neo_hookean")
