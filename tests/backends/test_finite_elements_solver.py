"""The finite element backend as a `Solver`: rest, steps, equilibrium, held nodes, muscles, energy, refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from blocks import block, pull, skinned
from bodies import held_sheet

from faceanim.backends import make_solver
from faceanim.backends.finite_elements.options import Options
from faceanim.backends.finite_elements.solver import SolverFiniteElements
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.ground.errors import DivergenceError, RunError, UserError

STEP = 1 / 60
VARIANTS: list[dict[str, Any]] = [
    {},
    {"order": 2, "law": "mooney_rivlin"},
    {"law": "corotational", "integrator": "trapezoid"},
    {"order": 2, "law": "linear", "mass": "lumped"},
    {"law": "stvk", "mass": "lumped", "integrator": "trapezoid"},
]


@pytest.fixture(scope="module")
def body() -> Body:
    return block()


@pytest.fixture(scope="module", params=VARIANTS, ids=lambda v: "-".join(map(str, v.values())) or "default")
def solver(request: pytest.FixtureRequest, body: Body) -> SolverFiniteElements:
    return make_solver("finite_elements", body, Options(**request.param))


def crushed(body: Body) -> Control:
    """Return a control with 4 N onto one vertex on top of the block."""
    control = Control.rest(body)
    control.force = np.zeros_like(body.surface.points)
    top = np.abs(body.surface.points - [12.0, 8.0, 4.0]).sum(axis=1)
    control.force[np.argmin(top)] = [0.0, -4000.0, 0.0]
    return control


def surface(solver: SolverFiniteElements, state: Any) -> np.ndarray:
    out = np.full_like(solver.body.surface.points, np.nan)
    solver.surface(state, out)
    return out


def test_rest_is_the_surface_and_stays(solver: SolverFiniteElements, body: Body) -> None:
    """Without any load nothing moves, in steps or at equilibrium."""
    rest = Control.rest(body)
    state = solver.rest()
    np.testing.assert_allclose(surface(solver, state), body.surface.points, atol=1e-12)
    for _ in range(3):
        report = solver.step(state, state, rest, STEP)
    np.testing.assert_allclose(surface(solver, state), body.surface.points, atol=1e-11)
    assert report.converged and report.iterations >= 1
    np.testing.assert_allclose(surface(solver, solver.solve_static(rest)), body.surface.points, atol=1e-11)


def test_stepping_in_place_is_the_same(solver: SolverFiniteElements, body: Body) -> None:
    """`state_out` may be `state_in`: the same bytes come out, and time goes on by dt."""
    control = pull(body, 0.7, jaw=6.0)
    control.gravity[:] = [0.0, -9810.0, 0.0]
    apart, together = solver.rest(), solver.rest()
    for _ in range(3):
        after = solver.rest()
        solver.step(apart, after, control, STEP)
        apart = after
        solver.step(together, together, control, STEP)
    assert apart.q.tobytes() == together.q.tobytes() and apart.qd.tobytes() == together.qd.tobytes()
    assert together.t == pytest.approx(3 * STEP)
    assert np.abs(surface(solver, together) - body.surface.points).max() > 0.1


def test_the_equilibrium_is_one(solver: SolverFiniteElements, body: Body) -> None:
    """At `solve_static` nothing moves on, and the total energy is stationary: its slope in any free direction is zero."""
    control = pull(body, 0.6, jaw=4.0)
    control.gravity[:] = [0.0, -9810.0, 0.0]
    control.force = np.tile([0.02, 0.0, 0.01], (len(body.surface.points), 1))
    state = solver.solve_static(control)
    assert solver.static_report.converged and solver.static_report.fraction == 1.0
    before = surface(solver, state)
    assert np.abs(before - body.surface.points).max() > 0.1
    direction = np.where(solver.free, np.random.default_rng(2).standard_normal(state.q.shape), 0.0)
    h = 1e-4
    up, down = state.copy(), state.copy()
    up.q += h * direction
    down.q -= h * direction
    top, middle, bottom = (solver.energy(s, control).total for s in (up, state, down))
    curvature = (top + bottom - 2.0 * middle) / h**2
    assert curvature > 0.0
    assert abs(top - bottom) / (2.0 * h) < 1e-5 * curvature
    for _ in range(3):
        solver.step(state, state, control, STEP)
    np.testing.assert_allclose(surface(solver, state), before, atol=1e-6)


def test_energy_falls_after_release(body: Body) -> None:
    """Backward Euler takes energy out in every step, down to that of rest."""
    solver = SolverFiniteElements(body)
    state = solver.solve_static(pull(body, 0.8))
    rest = Control.rest(body)
    energies = [solver.energy(state, rest).total]
    for _ in range(30):
        solver.step(state, state, rest, STEP)
        energies.append(solver.energy(state, rest).total)
    assert energies[0] > 1.0
    assert (np.diff(energies) < 1e-9 * energies[0]).all()
    assert energies[-1] < 0.01 * energies[0]


def test_held_nodes_go_with_their_bones(solver: SolverFiniteElements, body: Body) -> None:
    """A held vertex is where its bone puts it, in a step and at equilibrium."""
    control = pull(body, 0.0, jaw=20.0)
    x = body.surface.points[body.pinned]
    weight = body.attachment.bone_weight[body.pinned]
    places = [x @ pose[:3, :3].T + pose[:3, 3] for pose in control.bone_pose]
    expected = sum(weight[:, b : b + 1] * place for b, place in enumerate(places))
    state = solver.rest()
    solver.step(state, state, control, STEP)
    np.testing.assert_allclose(surface(solver, state)[body.pinned], expected, atol=1e-10)
    np.testing.assert_allclose(surface(solver, solver.solve_static(control))[body.pinned], expected, atol=1e-10)


def test_bones_that_move_together_carry_the_flesh_rigidly(body: Body) -> None:
    """Half a turn of the whole head is no load: every law but the linear one keeps its shape exactly."""
    control = Control.rest(body)
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    turn[:3, 3] = [5.0, -3.0, 8.0]
    control.bone_pose[:] = turn
    for law in ("neo_hookean", "corotational", "stvk", "mooney_rivlin"):
        solver = SolverFiniteElements(body, Options(law=law))
        state = solver.solve_static(control)
        expected = body.surface.points @ turn[:3, :3].T + turn[:3, 3]
        np.testing.assert_allclose(surface(solver, state), expected, atol=1e-9)
        assert solver.energy(state, control).total == pytest.approx(0.0, abs=1e-9)


def test_a_large_jaw_turn_is_followed_in_parts() -> None:
    """A block bent double between two clamped ends, where the straight way inverts elements: load steps get there."""
    body = block(jaw_below=9.0)
    solver = SolverFiniteElements(body)
    state = solver.solve_static(pull(body, 0.0, jaw=120.0))
    report = solver.static_report
    assert report.converged and report.load_steps > 1 and report.least_ratio > 0.0
    back = solver.solve_static(Control.rest(body), guess=state)
    np.testing.assert_allclose(surface(solver, back), body.surface.points, atol=1e-6)


@pytest.mark.parametrize("order", [1, 2])
def test_the_tangent_of_muscles_matches_their_forces(order: int) -> None:
    """Through a skin inside the elements: forces are minus the slope of the energy, the tangent minus that of the forces."""
    body = skinned(block())
    solver = SolverFiniteElements(body, Options(order=order))
    pulls = solver.pulls
    pulls.apply(pull(body, 0.9, jaw=5.0))
    rng = np.random.default_rng(4)
    x = solver.elements.points + 0.2 * rng.standard_normal(solver.elements.points.shape)
    d = rng.standard_normal(x.shape)
    h = 1e-4
    slope = (pulls.energy(x + h * d) - pulls.energy(x - h * d)) / (2.0 * h)
    assert -float((pulls.forces(x) * d).sum()) == pytest.approx(slope, rel=1e-7)
    values = np.zeros(len(solver.elements.indices))
    pulls.add_tangent(x, values)
    bend = (pulls.forces(x - h * d) - pulls.forces(x + h * d)) / (2.0 * h)
    product = (solver.elements.matrix(values) @ d.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(product, bend, atol=1e-6 * np.abs(bend).max())


def test_skin_follows_quadratic_shape_functions() -> None:
    """Points inside quadratic elements go where a quadratic map of space takes them."""
    body = skinned(block())
    solver = SolverFiniteElements(body, Options(order=2))

    def bent(p: np.ndarray) -> np.ndarray:
        return p + 0.01 * np.stack([p[:, 1] ** 2, p[:, 0] * p[:, 2], p[:, 0] ** 2 - p[:, 1]], axis=1)

    state = solver.rest()
    state.q[:] = bent(state.q)
    np.testing.assert_allclose(surface(solver, state), bent(body.surface.points), atol=1e-11)


@pytest.mark.parametrize("wrong", ["nan", "shape", "pose", "step", "state"])
def test_a_wrong_request_is_refused(wrong: str, body: Body) -> None:
    """NaN, a wrong number of muscles, an infinite pose, a step that is not positive, a foreign state: `UserError`."""
    solver = SolverFiniteElements(body)
    bad, state = Control.rest(body), solver.rest()
    if wrong == "nan":
        bad.activation[0] = np.nan
    elif wrong == "shape":
        bad.activation = np.zeros(7)
    elif wrong == "pose":
        bad.bone_pose = np.full_like(bad.bone_pose, np.inf)
    elif wrong == "state":
        state.q = state.q[:-1]
    with pytest.raises(UserError):
        solver.step(state, state, bad, 0.0 if wrong == "step" else STEP)
    if wrong in ("nan", "shape", "pose"):
        with pytest.raises(UserError):
            solver.solve_static(bad)


@pytest.mark.parametrize(
    "wrong",
    [{"law": "neohookean"}, {"order": 3}, {"integrator": "leapfrog"}, {"mass": "none"}, {"tolerance": 0.0}, {"most": 0},
     {"least_step": np.nan}],
    ids=str,
)  # fmt: skip
def test_wrong_options_are_refused_by_name(wrong: dict[str, Any]) -> None:
    """The message names the field, its value and what is known."""
    with pytest.raises(UserError, match=next(iter(wrong))):
        Options(**wrong)


def test_a_body_without_volume_or_hold_is_refused() -> None:
    """The backend needs flesh, and bones that hold it."""
    with pytest.raises(UserError, match="only a surface"):
        SolverFiniteElements(held_sheet(6, 6))
    free = block()
    assert free.solid is not None
    loose = replace(free.solid, bone_weight=np.zeros_like(free.solid.bone_weight))
    with pytest.raises(UserError, match="free"):
        SolverFiniteElements(replace(free, volume=lambda: loose))


def test_bones_that_meet_are_a_clear_failure() -> None:
    """A jaw pushed through the cranium turns held elements inside out: `RunError` with the fraction reached."""
    body = block(cranium=9.0, jaw_from=11.0, jaw_below=9.0)
    control = Control.rest(body)
    control.bone_pose[1][0, 3] = -25.0
    solver = SolverFiniteElements(body, Options(least_step=0.05, most=15))
    with pytest.raises(RunError, match="beyond") as caught:
        solver.solve_static(control)
    report = solver.static_report
    assert not report.converged and 0.0 <= report.fraction < 1.0 and f"{report.fraction:.1%}" in str(caught.value)
    assert solver.last_static is not None and solver.elements.volume_ratio(solver.last_static.q).min() > 0.0


def test_inverted_flesh_leaves_a_notice(body: Body) -> None:
    """St. Venant-Kirchhoff lets a crushing force invert elements: found, told, marked as not valid."""
    solver = SolverFiniteElements(body, Options(law="stvk"))
    control = crushed(body)
    solver.solve_static(control)
    assert not solver.static_report.valid and solver.static_report.least_ratio < 0.0
    assert solver.inverted >= 1 and "inverted" in solver.notices[-1]
    state = solver.rest()
    solver.solve_static(Control.rest(body))
    assert solver.inverted == 0
    for _ in range(30):
        solver.step(state, state, control, STEP)
    assert solver.inverted >= 1 and len([n for n in solver.notices if "inverted" in n]) == 2


def test_an_inverted_guess_is_set_aside(body: Body) -> None:
    """A law with a barrier cannot start from elements turned inside out: the search begins at rest and says so."""
    solver = SolverFiniteElements(body)
    guess = solver.rest()
    guess.q *= -1.0
    control = pull(body, 0.5)
    found = solver.solve_static(control, guess)
    np.testing.assert_allclose(found.q, SolverFiniteElements(body).solve_static(control).q, atol=1e-9)
    assert "guess" in solver.notices[0]


def test_a_force_that_would_invert_is_held_by_the_barrier(body: Body) -> None:
    """The same force under the neo-Hookean law squeezes the element but never inverts it, or says where it gave up."""
    solver = SolverFiniteElements(body)
    control = crushed(body)
    try:
        state = solver.solve_static(control)
    except RunError:
        assert solver.last_static is not None
        state = solver.last_static
    assert solver.elements.volume_ratio(state.q).min() > 0.0


def test_a_step_that_cannot_be_taken_leaves_the_state() -> None:
    """An impossible bone movement within one step: `DivergenceError` naming the time; the state is untouched."""
    body = block(cranium=9.0, jaw_from=11.0, jaw_below=9.0)
    solver = SolverFiniteElements(body, Options(most=8))
    control = Control.rest(body)
    control.bone_pose[1][0, 3] = -25.0
    state = solver.rest()
    state.t = 0.25
    with pytest.raises(DivergenceError, match=r"t = 0\.25"):
        solver.step(state, state, control, STEP)
    assert state.t == 0.25
    np.testing.assert_array_equal(state.q, solver.rest().q)
