"""What every registered backend promises, on one small body."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from bodies import control, held_sheet

from faceanim.backends import BACKENDS, backend_class, make_solver
from faceanim.backends.solver import StepReport
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.ground.errors import UserError

STEP = 1 / 60


@pytest.fixture(scope="module", params=sorted(BACKENDS))
def case(request: pytest.FixtureRequest) -> Iterator[tuple[Body, Any]]:
    """A body and a solver of each backend."""
    body = held_sheet(10, 10)
    yield body, make_solver(request.param, body)


def surface(solver: Any, state: Any, body: Body) -> np.ndarray:
    out = np.full_like(body.surface.points, np.nan)
    solver.surface(state, out)
    return out


def test_rest_is_the_surface_of_the_body(case: tuple[Body, Any]) -> None:
    """`rest` returns a new state each time, whose surface is the body's."""
    body, solver = case
    np.testing.assert_allclose(surface(solver, solver.rest(), body), body.surface.points, atol=1e-9)
    assert solver.rest() is not solver.rest()
    assert solver.rest().t == 0.0
    assert solver.dt_max > 0.0


def test_a_step_reports_and_advances_time(case: tuple[Body, Any]) -> None:
    """Time goes on by dt, the report has its fields, and the input state stays as it was."""
    body, solver = case
    first, second = solver.rest(), solver.rest()
    report = solver.step(first, second, control(body, 0.5), STEP)
    assert isinstance(report, StepReport) and report.iterations >= 1 and report.residual >= 0.0
    assert second.t == pytest.approx(STEP) and first.t == 0.0
    np.testing.assert_allclose(surface(solver, first, body), body.surface.points, atol=1e-9)
    assert np.abs(surface(solver, second, body) - body.surface.points).max() > 1e-3


def test_stepping_in_place_is_the_same(case: tuple[Body, Any]) -> None:
    """`state_out` may be `state_in`: the same bytes come out."""
    body, solver = case
    pull = control(body, 0.5, jaw=2.0)
    apart, together = solver.rest(), solver.rest()
    for _ in range(4):
        after = solver.rest()
        solver.step(apart, after, pull, STEP)
        apart = after
        solver.step(together, together, pull, STEP)
    assert surface(solver, apart, body).tobytes() == surface(solver, together, body).tobytes()


def test_the_equilibrium_stays_put(case: tuple[Body, Any]) -> None:
    """Steps from `solve_static` under the same control do not move on."""
    body, solver = case
    pull = control(body, 0.5, jaw=2.0)
    state = solver.solve_static(pull)
    before = surface(solver, state, body)
    assert np.abs(before - body.surface.points).max() > 0.1
    for _ in range(10):
        solver.step(state, state, pull, STEP)
    np.testing.assert_allclose(surface(solver, state, body), before, atol=0.02)


def test_energy_falls_after_release(case: tuple[Body, Any]) -> None:
    """Released from a smile, drag takes energy out step by step, down to that of rest."""
    body, solver = case
    state = solver.solve_static(control(body, 0.5))
    rest = Control.rest(body)
    energies = [solver.energy(state, rest).total]
    for _ in range(60):
        solver.step(state, state, rest, STEP)
        energies.append(solver.energy(state, rest).total)
    at_rest = solver.energy(solver.rest(), rest).total
    scale = energies[0] - at_rest
    assert scale > 0.0
    assert (np.diff(energies) < 1e-3 * scale).all()
    assert energies[-1] - at_rest < 0.01 * scale


def test_pinned_vertices_go_with_their_bones(case: tuple[Body, Any]) -> None:
    """A vertex carried by bones is where their weighted poses put it, in steps and at equilibrium."""
    body, solver = case
    moved = control(body, 0.0, jaw=4.0)
    x = body.surface.points[body.pinned]
    places = [x @ pose[:3, :3].T + pose[:3, 3] for pose in moved.bone_pose]
    weight = body.attachment.bone_weight[body.pinned]
    expected = sum(weight[:, b : b + 1] * place for b, place in enumerate(places))
    state = solver.rest()
    solver.step(state, state, moved, STEP)
    np.testing.assert_allclose(surface(solver, state, body)[body.pinned], expected, atol=1e-9)
    np.testing.assert_allclose(surface(solver, solver.solve_static(moved), body)[body.pinned], expected, atol=1e-9)


@pytest.mark.parametrize("wrong", ["nan", "shape", "pose", "step"])
def test_a_wrong_control_is_refused(case: tuple[Body, Any], wrong: str) -> None:
    """NaN, a wrong number of muscles or bones, a step that is not positive: a `UserError`, the state untouched."""
    body, solver = case
    bad = Control.rest(body)
    if wrong == "nan":
        bad.activation[0] = np.nan
    elif wrong == "shape":
        bad.activation = np.zeros(len(body.muscles.names) + 1)
    elif wrong == "pose":
        bad.bone_pose = np.full_like(bad.bone_pose, np.inf)
    state = solver.rest()
    with pytest.raises(UserError):
        solver.step(state, state, bad, 0.0 if wrong == "step" else STEP)
    np.testing.assert_allclose(surface(solver, state, body), body.surface.points, atol=1e-9)
    if wrong != "step":
        with pytest.raises(UserError):
            solver.solve_static(bad)


def test_an_unknown_backend_is_refused_by_name() -> None:
    """The message lists what there is."""
    with pytest.raises(UserError, match="mass_spring"):
        backend_class("mass_sprung")
