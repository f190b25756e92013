"""The bar of Choi & Ko's figures: what modes and finite elements make of it under gravity and after a pulse.

The bar is 1 x 0.2 x 0.2, density 1000, nu = 0.3, clamped at x = 0. Units are free: only rho g L / E matters, which the
paper does not tell. E = 1.5e5 (0.065 at the largest gravity) gives its curves; the neglected term of Fig. 11 confirms
that choice.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from faceanim.backends.finite_elements.options import Options as FiniteElements
from faceanim.backends.finite_elements.solver import SolverFiniteElements
from faceanim.backends.modal_warping.diagnostics import commutation_error
from faceanim.backends.modal_warping.options import Options as Modal
from faceanim.backends.modal_warping.solver import SolverModalWarping
from faceanim.body.assembly import mass_matrix
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.body.solid import Solid, solid_body
from faceanim.geometry.shapes import box_tets
from faceanim.ground.arrays import Floats
from faceanim.ground.notes import listening
from faceanim.tissue.material import Material

GRAVITIES = (1.96, 3.92, 5.88, 7.84, 9.8)
"""Ticks of Figs. 5 and 6 [m/s^2]."""
VARIANTS = ("linear", "warped", "consistent", "rotation_strain")
"""Modal analysis, the paper's method, and two that correct it."""
COARSE = (10, 2, 2)
"""Cells of the mesh "Bar" of Table I: 99 nodes, 240 elements."""
MODES = 30
PULSE, STEP, STEPS = 0.1, 0.01, 400
"""Fig. 6: how long gravity acts [s], the step [s] (trapezoid rule), how many."""


def bar(
    cells: tuple[int, int, int] = COARSE,
    young: float = 1.5e5,
    *,
    split: str = "kuhn",
    poisson: float = 0.3,
    size: tuple[float, float, float] = (1.0, 0.2, 0.2),
    **options: Any,
) -> Body:
    """Return the bar with its nodes at x = 0 held; `options` are those of `solid_body`."""
    mesh = box_tets(cells, size, split=split)
    material = Material("rubber", 1000.0, young, poisson)
    return solid_body(mesh, material, np.flatnonzero(mesh.points[:, 0] < 1e-9), **options)


def flesh(body: Body) -> Solid:
    """Return the volume of a body that has one."""
    assert body.solid is not None
    return body.solid


def untold() -> AbstractContextManager[None]:
    """Let nobody hear what is told inside this context: work too short to speak of."""
    return listening(lambda what, done, total: None)


def modal(body: Body, modes: int = MODES, variant: str = "warped", **options: Any) -> SolverModalWarping:
    """Return the modal solver with these options, computed afresh."""
    with untold():
        return SolverModalWarping(body, Modal(modes=modes, variant=variant, **{"cache": False} | options))


def hanging(body: Body, g: float) -> Control:
    """Return the control with gravity `g` along -y."""
    control = Control.rest(body)
    control.gravity = np.array([0.0, -g, 0.0])
    return control


def node_at(body: Body, *point: float) -> int:
    """Return the solid node nearest to `point` at rest."""
    return int(np.linalg.norm(flesh(body).mesh.points - point, axis=1).argmin())


def displaced(solver: Any, state: Any) -> Floats:
    """Return the displacements (n, 3) of the nodes by a modal solver."""
    return np.asarray(solver.nodes(state) - solver.solid.mesh.points)


def volume_ratios(solid: Solid, u: Floats) -> Floats:
    """Return det F of every element, (e,)."""
    mesh = solid.mesh
    return np.asarray(np.linalg.det(np.eye(3) + np.einsum("eai,eaj->eij", u[mesh.tets], mesh.gradients)))


def growth(solid: Solid, u: Floats) -> float:
    """Return V / V0 - 1."""
    return float(volume_ratios(solid, u) @ solid.mesh.volumes / solid.mesh.volumes.sum() - 1.0)


def mass_norm(mass: Any, u: Floats) -> float:
    """Return |u|_M."""
    return float(np.sqrt(u.ravel() @ (mass @ u.ravel())))


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """One model under one gravity: displacements `u` (n, 3), the tip's along y, the error |u - u_nl|_M / |u_nl|_M,
    the change of volume V / V0 - 1 and the largest rotation of a node [rad] (None for finite elements)."""

    u: Floats
    tip: float
    error: float
    growth: float
    turn: float | None = None


@lru_cache(maxsize=64)
def nonlinear(cells: tuple[int, int, int], young: float, g: float, split: str = "kuhn") -> tuple[Body, Floats]:
    """Return the bar and its displacements (n, 3) by neo-Hookean finite elements, linear tetrahedra on the same mesh."""
    body = bar(cells, young, split=split)
    solver = SolverFiniteElements(body, FiniteElements())
    return body, np.asarray(solver.solve_static(hanging(body, g)).q - flesh(body).mesh.points)


def equilibrium(
    variant: str, g: float, *, cells: tuple[int, int, int] = COARSE, young: float = 1.5e5, split: str = "kuhn"
) -> Equilibrium:
    """Return the bar at rest under `g` by a variant of modal warping, or by finite elements ("nonlinear")."""
    body, exact = nonlinear(cells, young, g, split)
    solid, turn, u = flesh(body), None, exact
    if variant != "nonlinear":
        solver = modal(body, MODES, variant)
        state = solver.solve_static(hanging(body, g))
        u = displaced(solver, state)
        turn = float(np.linalg.norm(solver.rotations(state), axis=1).max())
    mass = mass_matrix(solid, lumped=False)
    error = mass_norm(mass, u - exact) / mass_norm(mass, exact)
    return Equilibrium(u, float(u[node_at(body, 1.0, 0.1, 0.1), 1]), error, growth(solid, u), turn)


@dataclass(frozen=True, eq=False)
class Swing:
    """Free motion after a pulse of `g`: error over space and time and mean displacement of the nodes (step,), by model."""

    g: float
    error: dict[str, float]
    mean: dict[str, Floats]


def swing(g: float, variants: tuple[str, ...] = ("linear", "warped"), *, steps: int = STEPS) -> Swing:
    """Return how the undamped bar moves with gravity `g` during `PULSE`, then free (Fig. 6)."""
    body = bar()
    rest, mass = flesh(body).mesh.points, mass_matrix(flesh(body), lumped=False)
    pulse = [hanging(body, g if k * STEP < PULSE - 1e-9 else 0.0) for k in range(steps)]
    exact = SolverFiniteElements(body, FiniteElements(integrator="trapezoid"))
    state, truth = exact.rest(), np.zeros((steps, *rest.shape))
    for k, control in enumerate(pulse):
        exact.step(state, state, control, STEP)
        truth[k] = state.q - rest
    size = np.sqrt(sum(mass_norm(mass, u) ** 2 for u in truth))
    error, mean = {}, {"nonlinear": np.linalg.norm(truth, axis=2).mean(axis=1)}
    for variant in variants:
        solver = modal(body, MODES, variant, integrator="trapezoid")
        moving, off, far = solver.rest(), 0.0, np.zeros(steps)
        for k, control in enumerate(pulse):
            solver.step(moving, moving, control, STEP)
            u = displaced(solver, moving)
            off += mass_norm(mass, u - truth[k]) ** 2
            far[k] = np.linalg.norm(u, axis=1).mean()
        error[variant], mean[variant] = float(np.sqrt(off) / size), far
    return Swing(g, error, mean)


def neglected(cells: tuple[int, int, int], *, seconds: float = 8.0) -> Floats:
    """Return |R^T M - M R^T| over the total mass (Eq. 13), (step,) [%], of the bar that gravity 9.8 sets swinging.

    E = 1.6e5, 8 modes, zeta = 0.01 s, steps of 1/30 s: Fig. 11; Frobenius norm, consistent mass.
    """
    body = bar(cells, 1.6e5, stiffness_damping=0.01)
    solver = modal(body, 8)
    state, control, mass = solver.rest(), hanging(body, 9.8), mass_matrix(flesh(body), lumped=False)
    out = np.zeros(round(30.0 * seconds))
    for k in range(len(out)):
        solver.step(state, state, control, 1 / 30)
        out[k] = 100.0 * commutation_error(mass, solver.rotations(state))
    return out
