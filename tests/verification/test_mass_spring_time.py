"""Accuracy and stability in time: orders, periods, and the pitfalls of the paper's scheme, where theory puts them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bodies import NO_MUSCLES, control, held_sheet

from faceanim.backends.mass_spring.options import Options
from faceanim.backends.mass_spring.solver import SolverMassSpring
from faceanim.body.body import Attachment, Body, Bone
from faceanim.body.control import Control
from faceanim.geometry.surface import TriMesh
from faceanim.ground.errors import DivergenceError
from faceanim.tissue.spring_law import SpringLaw

LINEAR = SpringLaw(alpha=0.0, zeta=0.0, height_ratio=0.0)


def soft_sheet() -> Body:
    """Return a heavy, soft, lightly damped sheet without contact, whose motion is smooth in time."""
    body = held_sheet(8, 8, colliders=False, force=150.0, damping=20.0)
    return replace(body, mass=body.mass * 30.0, attachment=replace(body.attachment, s0=20.0, shear=None))


def played(body: Body, h: float, end: float, **options: Any) -> np.ndarray:
    """Return the positions at time `end` [s] under activations that rise smoothly."""
    solver = SolverMassSpring(body, Options(**options))
    state, case = solver.rest(), Control.rest(body)
    for k in range(round(end / h)):
        case.activation[:] = 0.5 * np.sin(0.5 * np.pi * (k + 1) * h / end) ** 2
        solver.step(state, state, case, h)
    return state.q


@pytest.mark.parametrize(
    ("options", "h", "order"),
    [
        ({"scheme": "newton", "integrator": "euler", "newton_tolerance": 1e-8}, 1 / 400, 1),
        ({"scheme": "newton", "integrator": "bdf2", "newton_tolerance": 1e-8}, 1 / 400, 2),
        ({"scheme": "block_descent", "integrator": "bdf2", "sweeps": 200, "sweep_tolerance": 1e-9}, 1 / 400, 2),
        (
            {"scheme": "conjugate_gradient", "integrator": "bdf2", "iterations": 60, "iteration_tolerance": 1e-9},
            1 / 400,
            2,
        ),
        ({"scheme": "explicit"}, 1 / 2000, 2),
    ],
)
def test_the_error_falls_with_the_order_of_the_scheme(options: dict[str, Any], h: float, order: int) -> None:
    """Halving the step divides the change of the answer by 2 to the order (Richardson), within 30 %."""
    body = soft_sheet()
    a, b, c = (played(body, h / k, 0.1, **options) for k in (1, 2, 4))
    measured = np.log2(np.linalg.norm(a - b) / np.linalg.norm(b - c))
    assert measured == pytest.approx(order, abs=0.3)


def test_schemes_agree_on_the_motion() -> None:
    """Leapfrog with small steps and BDF2 tell the same story: the trajectory itself is right."""
    body = soft_sheet()
    reference = played(body, 1 / 2000, 0.1, scheme="explicit")
    moved = np.linalg.norm(reference - body.surface.points)
    for options in (
        {"scheme": "newton"},
        {"scheme": "block_descent", "sweeps": 30},
        {"scheme": "conjugate_gradient", "iteration_tolerance": 1e-5},
    ):
        assert np.linalg.norm(played(body, 1 / 400, 0.1, **options) - reference) < 0.01 * moved


def one_triangle(stiffness: float, **changes: Any) -> Body:
    """Return a triangle (-1,0), (1,0), (0,h) whose first two corners are pinned; only its top moves."""
    surface = TriMesh([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]], [[0, 1, 2]])
    fields: dict[str, Any] = {
        "surface": surface,
        "mass": np.full(3, 1e-4),
        "membrane_modulus": np.full(1, stiffness),
        "law": replace(LINEAR, uniform_k0=stiffness),
        "damping": 0.0,
        "pinned": np.array([True, True, False]),
        "attachment": Attachment(np.ones((3, 1)), np.zeros(3)),
        "muscles": NO_MUSCLES,
        "bones": (Bone("cranium"),),
    }
    return Body(**(fields | changes))


@pytest.mark.parametrize("scheme", ["explicit", "newton", "block_descent", "conjugate_gradient"])
def test_a_mass_on_springs_has_the_analytic_period(scheme: str) -> None:
    """Small swings along the height of an isosceles triangle: omega^2 = 2 k cos^2(half angle) / m."""
    body = one_triangle(3.0)
    omega = np.sqrt(2.0 * 3.0 * (4.0 / 5.0) / 1e-4)
    solver = SolverMassSpring(body, Options(scheme=scheme, newton_tolerance=1e-12, sweep_tolerance=1e-12))
    state, rest = solver.rest(), Control.rest(body)
    state.q[2, 1] += 1e-3
    period = 2.0 * np.pi / omega
    h, heights = period / 400, []
    for _ in range(800):
        solver.step(state, state, rest, h)
        heights.append(state.q[2, 1] - 2.0)
    y = np.array(heights)
    crossing = np.flatnonzero((y[:-1] < 0) & (y[1:] >= 0))
    times = (crossing + 1 - y[crossing] / (y[crossing + 1] - y[crossing])) * h
    assert times[1] - times[0] == pytest.approx(period, rel=1e-3)


def pulling_pair() -> Body:
    """Return two free vertices 1 mm apart and a pinned one far away: their opposite motion has eigenvalue 2 k."""
    surface = TriMesh([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 1000.0, 0.0]], [[0, 1, 2]])
    return one_triangle(1.0, surface=surface, law=LINEAR, pinned=np.array([False, False, True]), mass=np.full(3, 1e-9))


def growth(scheme: str, steps: int, **options: Any) -> float:
    """Return by which factor the opposite motion of the pair grows in the last step."""
    body = pulling_pair()
    solver = SolverMassSpring(body, Options(scheme=scheme, **options))
    state, rest = solver.rest(), Control.rest(body)
    state.q[0, 0], state.q[1, 0] = -0.5 - 1e-6, 0.5 + 1e-6
    sizes = []
    for _ in range(steps):
        solver.step(state, state, rest, 1 / 60)
        sizes.append(np.hypot(state.q[1, 0] - 0.5, state.qd[1, 0] / 60))
    return float(sizes[-1] / sizes[-2])


def test_the_paper_scheme_amplifies_by_one_plus_root_two() -> None:
    """CORE pitfall (ii): with extrapolated neighbours a mode of eigenvalue 2 k grows by 1 + sqrt 2 a step."""
    assert growth("paper", 8, secant=False) == pytest.approx(1.0 + np.sqrt(2.0), rel=1e-3)


def test_the_semi_implicit_scheme_damps_the_same_mode() -> None:
    """CORE pitfall (iii): with neighbours where they are, the same mode at the same step does not grow."""
    assert growth("semi_implicit", 8) <= 1.0 + 1e-6


@pytest.mark.parametrize("h", [1e-4, 1e-3, 1e-2, 1e-1, 1.0])
def test_the_semi_implicit_scheme_is_stable_for_every_step(h: float) -> None:
    """From a crumpled start without drag, the sheet stays bounded: k is at least half the largest eigenvalue."""
    body = replace(held_sheet(8, 8, colliders=False), damping=0.0)
    solver = SolverMassSpring(body, Options(scheme="semi_implicit"))
    state, rest = solver.rest(), Control.rest(body)
    free = ~body.pinned
    state.q[free] += 0.2 * np.random.default_rng(1).standard_normal((int(free.sum()), 3))
    start = solver.energy(state, rest).total
    for _ in range(200):
        solver.step(state, state, rest, h)
    assert solver.energy(state, rest).total < 1.5 * start


def test_the_paper_scheme_runs_away_and_says_what_to_do() -> None:
    """With large steps the printed scheme diverges; the error names time, scheme and the way out."""
    body = held_sheet()
    solver = SolverMassSpring(body, Options(scheme="paper"))
    state = solver.rest()
    with pytest.raises(DivergenceError, match=r"t = .* 'paper'.*conjugate_gradient"):
        for _ in range(400):
            solver.step(state, state, control(body, 1.0), 1 / 10)


def test_the_secant_stiffness_of_a_compressed_spring_is_negative() -> None:
    """CORE pitfall (i): the paper's denominator can fall below the mass; the tangent's cannot."""
    from faceanim.backends.mass_spring import kernels
    from faceanim.backends.mass_spring.build import Tables
    from faceanim.backends.mass_spring.load import Load

    body = one_triangle(3.0, pinned=np.zeros(3, dtype=bool))
    load = Load(Tables(body).patch(np.arange(3, dtype=np.int32)))
    load.apply(Control.rest(body))
    load.x[:] = 0.5 * body.surface.points
    *_, k, secant = kernels.vertex_force(2, *load.x[2], load.x, load.patch.scene, load.moment)
    assert secant < 0.0 < k


def test_vertex_by_vertex_and_triangle_by_triangle_forces_agree() -> None:
    """The in-place sweeps use the same force and stiffness bound as the block kernel, contacts apart."""
    from faceanim.backends.mass_spring import kernels
    from faceanim.backends.mass_spring.build import Tables
    from faceanim.backends.mass_spring.load import Load

    for law in (SpringLaw(), SpringLaw(reaction=False), SpringLaw(alpha=1.3, beta=2.5)):
        body = held_sheet(8, 8, colliders=False, law=law)
        load = Load(Tables(body).patch(np.flatnonzero(~body.pinned).astype(np.int32)))
        load.apply(control(body, 0.7, jaw=4.0))
        load.x[:] = (body.surface.points + 0.1 * np.random.default_rng(0).standard_normal((len(body.mass), 3)))[
            load.patch.nodes
        ]
        force = load.forces(load.x).copy()
        for i in range(load.patch.m):
            one = kernels.vertex_force(i, *load.x[i], load.x, load.patch.scene, load.moment)
            np.testing.assert_allclose(one[:3], force[i, :3], rtol=1e-9, atol=1e-9)
            assert 0.5 * force[i, 3] < one[3] < 2.0 * force[i, 3]
