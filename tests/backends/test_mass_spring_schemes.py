"""Options, contact and the reports of the mass-spring steps."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from bodies import control, held_sheet, two_lips
from scipy.interpolate import LinearNDInterpolator

from faceanim.backends.mass_spring.options import SCHEMES, Options
from faceanim.backends.mass_spring.solver import SolverMassSpring
from faceanim.backends.solver import State
from faceanim.body.control import Control
from faceanim.ground.errors import UserError


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scheme": "block"}, "block_descent"),
        ({"integrator": "rk4"}, "bdf2"),
        ({"quasi_static": "wave"}, "waves"),
        ({"sweeps": 0}, "sweeps"),
        ({"tolerance": 0.0}, "tolerance"),
    ],
)
def test_wrong_options_are_refused_by_name(wrong: dict[str, object], message: str) -> None:
    """The message names the option or suggests the right value."""
    with pytest.raises(UserError, match=message):
        Options(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("scheme", ["conjugate_gradient", "block_descent", "semi_implicit", "explicit"])
def test_bytes_do_not_depend_on_threads_or_on_the_run(scheme: str) -> None:
    """One thread or two, first run or second: the same bytes."""
    body = held_sheet(10, 10)
    results = []
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS), 1):
        numba.set_num_threads(threads)
        solver = SolverMassSpring(body, Options(scheme=scheme))
        state = solver.rest()
        for _ in range(5):
            solver.step(state, state, control(body, 0.6, jaw=3.0), 1 / 60)
        results.append(state.q.tobytes() + state.qd.tobytes())
    assert results[0] == results[1] == results[2]


@pytest.mark.parametrize("scheme", ["conjugate_gradient", "block_descent", "newton", "explicit"])
def test_motion_settles_at_the_equilibrium(scheme: str) -> None:
    """After a second under a constant control the skin stands where `solve_static` says."""
    body = held_sheet(10, 10)
    solver = SolverMassSpring(body, Options(scheme=scheme))
    case = control(body, 0.6, jaw=3.0)
    state = solver.rest()
    for _ in range(120):
        report = solver.step(state, state, case, 1 / 60)
    assert np.linalg.norm(state.q - solver.solve_static(case).q, axis=1).max() < 0.02
    assert report.converged and report.seconds["dynamic"] > 0.0


def test_skin_is_kept_out_of_bone_and_eyeball() -> None:
    """Pressed 100 mN a vertex against the ball behind it, no vertex gets nearer to the bone than half the clearance."""
    body = held_sheet(force=4000.0)
    solver = SolverMassSpring(body)
    state = solver.solve_static(control(body, [1.0, 1.0, 1.0]))
    grid = body.bones[0].grid
    assert grid is not None
    assert solver.energy(state, control(body, 1.0)).contact > 0.0
    assert grid.sample(state.q[~body.pinned]).min() > 0.0
    eye = body.spheres[0]
    assert (np.linalg.norm(state.q[~body.pinned] - eye.centre, axis=1) - eye.radius).min() > 0.0


@pytest.mark.parametrize("scheme", ["conjugate_gradient", "block_descent", "newton"])
def test_lips_close_without_crossing(scheme: str) -> None:
    """Two sheets 2 mm apart, pressed together within one step or two, meet and stay on their sides."""
    body = two_lips()
    solver = SolverMassSpring(body, Options(scheme=scheme))
    state, case = solver.rest(), Control.rest(body)
    n = len(state.q) // 2
    for k in range(60):
        case.activation[:] = min(1.0, (k + 1) / 3)
        solver.step(state, state, case, 1 / 30)
    x = body.surface.points
    inner = np.abs(x[:, :2]).max(axis=1) < 5.0  # the borders may slip past each other
    beneath = LinearNDInterpolator(state.q[n:, :2], state.q[n:, 2])
    gap = state.q[:n, 2][inner[:n]] - beneath(state.q[:n, :2][inner[:n]])
    assert -0.02 < gap.min() < 0.3
    assert solver.energy(state, case).contact > 0.0


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_plain_state_will_do(scheme: str) -> None:
    """A `State` without history steps too (two-step schemes start with Euler)."""
    body = held_sheet(8, 8)
    solver = SolverMassSpring(body, Options(scheme=scheme))
    rest = solver.rest()
    state = State(rest.q, rest.qd)
    solver.step(state, state, control(body, 0.1), 1e-3)
    assert state.t == pytest.approx(1e-3) and np.isfinite(state.q).all()


def test_the_largest_explicit_step_is_reported() -> None:
    """`dt_max` is finite for leapfrog and infinite for the implicit schemes."""
    body = held_sheet(8, 8)
    assert 0.0 < SolverMassSpring(body, Options(scheme="explicit")).dt_max < 1 / 60
    assert SolverMassSpring(body).dt_max == np.inf


def test_idle_steps_are_cheap_and_do_not_drift() -> None:
    """At rest one sweep is enough, and a thousand idle steps change nothing."""
    body = held_sheet(8, 8)
    solver = SolverMassSpring(body)
    state = solver.rest()
    for _ in range(1000):
        report = solver.step(state, state, Control.rest(body), 1 / 60)
    assert report.iterations == 1
    np.testing.assert_allclose(state.q, body.surface.points, atol=1e-9)
