"""Constraints by forces on exercised nodes (section 3): residuals of each choice, ranks, priorities, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from bars import bar, displaced, jawed_bar, node_at, solver_of, tip_nodes

from faceanim.backends.modal_warping.manipulation import Manipulation, nearest_nodes, with_neighbours
from faceanim.backends.modal_warping.twist import rotation
from faceanim.body.control import Control
from faceanim.ground.errors import UserError

BODY = bar(damping=0.5, stiffness_damping=0.01)
TIP = node_at(BODY, 1.0, 0.1, 0.1)
AWAY = np.array([-0.35, 0.6, 0.15])
STEP = 1 / 30


def dragged(turning: str, ramp: int = 60, hold: int = 60, modes: int = 8, g: float = 0.0, **options: Any) -> tuple:
    """Return position residuals over time and the solver after dragging the tip by AWAY and holding it."""
    solver = solver_of(BODY, modes)
    solver.manipulation = Manipulation(solver, position=[TIP], turning=turning, **options)
    state, control = solver.rest(), Control.rest(BODY)
    control.gravity[1] = -g
    rest, residuals = BODY.solid.mesh.points[[TIP]], []
    for k in range(1, ramp + hold + 1):
        solver.manipulation.move_to(rest + AWAY * min(k / ramp, 1.0))
        before = state.q.copy()
        report = solver.step(state, state, control, STEP)
        np.testing.assert_allclose(state.qd, (state.q - before) / STEP, rtol=1e-9, atol=1e-9)
        residuals.append(solver.manipulation.position_residual)
    at = displaced(solver, state)[TIP]
    assert np.linalg.norm(at - AWAY) == pytest.approx(residuals[-1], abs=1e-12)
    return np.array(residuals), solver, state, report


def test_newton_meets_the_target() -> None:
    """Choice a: 5e-13 of the length at rest, in at most 4 steps, while moving too."""
    residuals, solver, _, report = dragged("newton")
    assert residuals[-1] < 1e-12 and residuals.max() < 1e-6
    assert report.iterations <= 4 and not solver.notices
    assert np.abs(solver.manipulation.force).max() > 0.0


def test_previous_rotation_lags_and_then_meets_the_target() -> None:
    """Choice c: behind by at most 6.6e-3 L while moving, 2e-7 at hold."""
    residuals, *_ = dragged("previous", hold=120)
    assert 1e-4 < residuals[:60].max() <= 0.01
    assert residuals[-1] < 1e-6


def test_unconstrained_rotation_leaves_a_bias() -> None:
    """Choice b (the paper's): a lasting bias of about 1.6e-2 L, without oscillation."""
    residuals, *_ = dragged("unconstrained")
    assert 0.005 < residuals[-1] < 0.04
    assert np.ptp(residuals[-10:]) < 0.05 * residuals[-1]


def test_a_linear_body_needs_one_step() -> None:
    """Without warping the constraint is linear: met to round-off whatever the choice."""
    for turning in ("newton", "unconstrained", "previous"):
        solver = solver_of(BODY, 8, "linear")
        solver.manipulation = Manipulation(solver, position=[TIP], turning=turning)
        solver.manipulation.move_to(BODY.solid.mesh.points[[TIP]] + AWAY)
        state = solver.rest()
        solver.step(state, state, Control.rest(BODY), STEP)
        np.testing.assert_allclose(displaced(solver, state)[TIP], AWAY, atol=1e-12)


def test_the_forces_are_what_it_took() -> None:
    """Eqs. 24-26: the same step with the reported forces as loads and no constraint gives the same amplitudes."""
    solver = solver_of(BODY, 8)
    solver.manipulation = Manipulation(solver, position=[TIP], orientation=[TIP])
    state, control = solver.rest(), Control.rest(BODY)
    state.q[:] = 0.2 * np.random.default_rng(0).standard_normal(8)
    free = state.copy()
    solver.manipulation.move_to(BODY.solid.mesh.points[[TIP]] + 0.3 * AWAY)
    solver.manipulation.turn_to([[0.2, 0.1, 0.0]])
    solver.step(state, state, control, STEP)
    nodal = np.zeros_like(BODY.solid.mesh.points)
    nodal[solver.manipulation.exercised] = solver.manipulation.force
    loads = solver.modes.shapes()
    turned = np.einsum("nji,nj->ni", rotation(solver.rotations(free)), nodal)
    q = solver.recurrence(STEP)
    expected = q.a * free.q + q.b * free.qd + q.g * (loads.T @ turned.ravel())
    np.testing.assert_allclose(state.q, expected, atol=1e-9)


@pytest.mark.parametrize(
    "turning", ["newton", *(pytest.param(t, marks=pytest.mark.slow) for t in ("unconstrained", "previous"))]
)
def test_too_many_conditions_are_detected_and_stay_tame(turning: str) -> None:
    """Five nodes, 15 conditions on 8 modes: a notice, a bounded shape, and a residual that is no garbage."""
    nodes = [TIP, *(node_at(BODY, x, 0.1, 0.1) for x in (0.2, 0.4, 0.6, 0.8))]
    solver = solver_of(BODY, 8)
    solver.manipulation = Manipulation(solver, position=nodes, turning=turning)
    state, control = solver.rest(), Control.rest(BODY)
    rest = BODY.solid.mesh.points[nodes]
    for k in range(1, 121):
        solver.manipulation.move_to(rest + (rest[:, :1] ** 2) * AWAY * min(k / 60, 1.0))
        solver.step(state, state, control, STEP)
        assert solver.manipulation.position_residual < 0.15
        assert np.abs(displaced(solver, state)).max() < 1.2
    assert any("15 position conditions exceed" in text for text in solver.notices)


@pytest.mark.slow
@pytest.mark.parametrize("turning", ["newton", "unconstrained", "previous"])
def test_impossible_targets_stay_tame(turning: str) -> None:
    """A node asked ten lengths away, or conflicting targets for two neighbours: finite, never divergence."""
    for nodes, far in (([TIP], 10.0), ([TIP, TIP - 1], 3.0), (list(tip_nodes(BODY)), 5.0)):
        solver = solver_of(BODY, 8)
        solver.manipulation = Manipulation(solver, position=nodes, turning=turning)
        random = np.random.default_rng(1)
        solver.manipulation.move_to(BODY.solid.mesh.points[nodes] + far * random.standard_normal((len(nodes), 3)))
        state = solver.rest()
        for _ in range(30):
            solver.step(state, state, Control.rest(BODY), STEP)
        assert np.isfinite(state.q).all()
        assert np.abs(displaced(solver, state)).max() < 40.0 * far


def test_a_single_node_cannot_twist_itself_but_its_section_can() -> None:
    """Half a turn about the axis: exercising the node alone is noticed and fails; the nine tip nodes do it to 1e-14."""
    for exercised, meets in (([TIP], False), (list(tip_nodes(BODY)), True), (None, True)):
        solver = solver_of(BODY, 8)
        solver.manipulation = Manipulation(solver, orientation=[TIP], exercised=exercised)
        solver.manipulation.turn_to([[np.pi, 0.0, 0.0]])
        state = solver.rest()
        for _ in range(5):
            solver.step(state, state, Control.rest(BODY), STEP)
        residual = solver.manipulation.orientation_residual
        assert residual == pytest.approx(np.linalg.norm(solver.rotations(state)[TIP] - [np.pi, 0, 0]), abs=1e-13)
        if meets:
            assert residual < 1e-13 and not solver.notices
        else:
            assert 2.9 < residual < 3.3 and "exercise more nodes" in solver.notices[0]


@pytest.mark.parametrize(
    "priority", ["position", *(pytest.param(p, marks=pytest.mark.slow) for p in ("orientation", "together"))]
)
def test_position_and_a_quarter_turn_together(priority: str) -> None:
    """Mixed constraints on 16 modes: both met, whichever goes first (choice a: 2e-12)."""
    solver = solver_of(BODY, 16)
    solver.manipulation = Manipulation(
        solver, position=[TIP], orientation=[TIP], exercised=tip_nodes(BODY), priority=priority, newton_steps=8
    )
    state = solver.rest()
    for k in range(1, 121):
        s = min(k / 60, 1.0)
        solver.manipulation.move_to(BODY.solid.mesh.points[[TIP]] + s * AWAY)
        solver.manipulation.turn_to([[s * np.pi / 2.0, 0.0, 0.0]])
        solver.step(state, state, Control.rest(BODY), STEP)
    assert solver.manipulation.position_residual < 1e-9
    assert solver.manipulation.orientation_residual < 1e-9
    assert not solver.notices


@pytest.mark.parametrize(("turning", "at", "turn"), [("unconstrained", 0.06, 1e-10), ("previous", 1e-6, 1e-10)])
def test_mixed_constraints_of_the_cheap_choices(turning: str, at: float, turn: float) -> None:
    """Choice b misses the position (about 4.7e-2 L) and meets the turn; choice c meets both at hold."""
    solver = solver_of(bar(damping=2.0, stiffness_damping=0.05), 16)
    solver.manipulation = Manipulation(
        solver, position=[TIP], orientation=[TIP], exercised=tip_nodes(BODY), turning=turning, priority="together"
    )
    state = solver.rest()
    for k in range(1, 151):
        s = min(k / 60, 1.0)
        solver.manipulation.move_to(BODY.solid.mesh.points[[TIP]] + 0.5 * s * AWAY)
        solver.manipulation.turn_to([[s * np.pi / 2.0, 0.0, 0.0]])
        solver.step(state, state, Control.rest(BODY), STEP)
    assert solver.manipulation.position_residual < at and solver.manipulation.orientation_residual < turn
    assert turning != "unconstrained" or solver.manipulation.position_residual > 0.005


def test_the_first_task_wins() -> None:
    """Where both cannot be met the first is met exactly and the second is nearer than without it; a notice says so."""
    found = {}
    for priority in ("position", "orientation"):
        solver = solver_of(BODY, 5)
        solver.manipulation = Manipulation(
            solver, position=[TIP], orientation=[TIP], exercised=tip_nodes(BODY), priority=priority, newton_steps=8
        )
        solver.manipulation.move_to(BODY.solid.mesh.points[[TIP]] + [0.0, 0.1, 0.0])
        solver.manipulation.turn_to([[0.0, 0.0, -0.5]])
        state = solver.rest()
        for _ in range(3):
            solver.step(state, state, Control.rest(BODY), STEP)
        found[priority] = (solver.manipulation.position_residual, solver.manipulation.orientation_residual)
        assert f"{priority} goes first" in solver.notices[0]
    assert found["position"][0] < 1e-10 and found["orientation"][1] < 1e-10
    assert found["position"][1] > 1e-3 and found["orientation"][0] > 1e-3


def test_constraints_hold_while_the_bones_move() -> None:
    """A dragged surface vertex stays where it was asked to be while the jaw turns under it."""
    body = jawed_bar()
    solver = solver_of(body, 20)
    vertex = int(np.linalg.norm(body.surface.points - (20.0, 12.0, 6.0), axis=1).argmin())
    node = nearest_nodes(solver, vertex)
    solver.manipulation = Manipulation(solver, position=node, exercised=with_neighbours(solver, node))
    goal = body.surface.points[[vertex]] + [1.0, 2.0, 0.0]
    solver.manipulation.move_to(goal)
    state, control, out = solver.rest(), Control.rest(body), np.zeros_like(body.surface.points)
    for k in range(20):
        control.bone_pose[1, :3, :3] = rotation(np.array([0.0, 0.0, 0.01 * k]))
        solver.step(state, state, control, 1 / 60)
        solver.surface(state, out)
        np.testing.assert_allclose(out[[vertex]], goal, atol=1e-6)


def test_wrong_manipulations_are_refused() -> None:
    """Each message names what is wrong."""
    solver = solver_of(BODY, 8)
    for match, options in (
        ("at least one node", {}),
        ("held by a bone", {"position": [0]}),
        ("outside 0..98", {"position": [99]}),
        ("listed twice", {"position": [TIP, TIP]}),
        ("priority", {"position": [TIP], "priority": "both"}),
        ("turning", {"position": [TIP], "turning": "d"}),
        ("newton_steps = 0", {"position": [TIP], "newton_steps": 0}),
        ("held by a bone", {"position": [TIP], "exercised": [0]}),
        ("exercised", {"position": [TIP], "exercised": []}),
        ("integers", {"position": [1.5]}),
    ):
        with pytest.raises(UserError, match=match):
            Manipulation(solver, **options)
    with pytest.raises(UserError, match="node-wise"):
        Manipulation(solver_of(BODY, 4, "rotation_strain"), position=[TIP])
    manipulation = Manipulation(solver, position=[TIP], orientation=[TIP])
    for act, value in ((manipulation.move_to, np.zeros((2, 3))), (manipulation.turn_to, [[np.nan, 0.0, 0.0]])):
        with pytest.raises(UserError):
            act(value)
    with pytest.raises(UserError, match="outside"):
        nearest_nodes(solver, [100000])
