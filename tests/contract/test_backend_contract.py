"""What every registered backend promises, on small bodies: a sheet, a bar between two bones, a bar held at one end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bodies import bridge, cantilever, control, held_sheet

from faceanim.backends import BACKENDS, backend_class, make_solver
from faceanim.backends.solver import StepReport
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.expression.library import load_expression
from faceanim.face.library import load_face
from faceanim.ground.errors import UserError
from faceanim.session.session import Session

STEP = 1 / 60


BODIES = {"sheet": lambda: held_sheet(10, 10), "bridge": bridge}


SURFACES = {"mass_spring"}
"""Backends that need no volume."""


def solids() -> list[str]:
    return sorted(set(BACKENDS) - SURFACES)


CASES = [(name, "bridge") for name in sorted(BACKENDS)] + [(name, "sheet") for name in sorted(SURFACES)]


@pytest.fixture(scope="module", params=CASES, ids="-".join)
def case(request: pytest.FixtureRequest) -> Iterator[tuple[Body, Any]]:
    """A body and a solver of each backend."""
    name, kind = request.param
    body = BODIES[kind]()
    yield body, make_solver(name, body)


@pytest.mark.parametrize("name", solids())
def test_flesh_without_a_volume_is_refused(name: str) -> None:
    """A backend of solids says what it lacks when it gets a sheet."""
    with pytest.raises(UserError, match="volume"):
        make_solver(name, held_sheet(6, 6))


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


@pytest.fixture(scope="module", params=solids())
def bar(request: pytest.FixtureRequest) -> Iterator[tuple[Body, Any]]:
    """A bar held at one end, and a solver of each backend of solids."""
    body = cantilever()
    yield body, make_solver(request.param, body)


def test_gravity_bends_a_bar_as_beam_theory_says(bar: tuple[Body, Any]) -> None:
    """A little weight moves the tip by q L^4 / 8 E I + q L^2 / 2 (5/6) G A, within the error of a coarse mesh."""
    body, solver = bar
    load = Control.rest(body)
    load.gravity[:] = (0.0, -100.0, 0.0)
    tip = np.abs(body.surface.points[:, 0] - 40.0) < 1e-9
    sag = (surface(solver, solver.solve_static(load), body) - body.surface.points)[tip].mean(axis=0)
    weight = 1.04e-6 * 100.0 * 100.0  # mN/mm
    expected = weight * 40.0**4 / (8.0 * 15.0 * 1e4 / 12.0) + weight * 40.0**2 / (2.0 * 5 / 6 * 15.0 / 2.8 * 100.0)
    assert -1.35 * expected < sag[1] < -0.6 * expected
    assert abs(sag[2]) < 0.02 * expected


def test_a_force_on_the_surface_pulls_its_way(bar: tuple[Body, Any]) -> None:
    """A pull at the end lengthens the near half by F L / 2 E A, and nothing remains after it."""
    body, solver = bar
    load = Control.rest(body)
    tip = np.abs(body.surface.points[:, 0] - 40.0) < 1e-9
    load.force = np.zeros_like(body.surface.points)
    load.force[tip, 0] = 30.0 / tip.sum()
    moved = surface(solver, solver.solve_static(load), body) - body.surface.points
    middle = np.abs(body.surface.points[:, 0] - 20.0) < 1e-9  # away from where single vertices are pulled
    assert moved[middle, 0].mean() == pytest.approx(30.0 * 20.0 / (15.0 * 100.0), rel=0.08)
    state = solver.rest()
    for _ in range(10):
        solver.step(state, state, load, STEP)
    for _ in range(600):
        solver.step(state, state, Control.rest(body), STEP)
    np.testing.assert_allclose(surface(solver, state, body), body.surface.points, atol=1e-3)


@pytest.mark.parametrize("name", solids())
def test_a_free_body_is_refused(name: str) -> None:
    """Flesh that no bone holds would float away: a `UserError` says so."""
    body = cantilever()
    solid = body.solid
    assert solid is not None
    free = replace(solid, bone_weight=np.zeros_like(solid.bone_weight))
    with pytest.raises(UserError, match="free"):
        make_solver(name, replace(body, volume=lambda: free))


def test_a_sheet_of_springs_takes_no_loads() -> None:
    """The backend that does not model gravity refuses it instead of ignoring it."""
    body = held_sheet(6, 6)
    load = Control.rest(body)
    load.gravity[:] = (0.0, -9810.0, 0.0)
    with pytest.raises(UserError, match="gravity"):
        make_solver("mass_spring", body).solve_static(load)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(BACKENDS))
def test_a_face_answers_on_every_backend(name: str) -> None:
    """At rest it is the face; a smile with an opening jaw moves the corner of the mouth out and the chin down, held
    skin goes with its bones, and mirror images stay mirror images."""
    face = load_face(density="coarse")
    session = Session(face, load_expression("6+12+26"), backend=name, duration=0.2)
    body, solver = session.body, session.solver
    np.testing.assert_allclose(surface(solver, solver.rest(), body), body.surface.points, atol=1e-6)
    state, asked = solver.rest(), session.control(0.3)
    for _ in range(6):
        solver.step(state, state, asked, STEP)
    moved = surface(solver, state, body) - body.surface.points
    corner, chin = face.landmarks["cheilion_left"], face.landmarks["pogonion"]
    assert moved[corner, 0] > 0.2 and moved[chin, 1] < -0.5
    assert np.linalg.norm(moved, axis=1).max() < 25.0
    x = body.surface.points
    places = np.einsum("bij,nj->nbi", asked.bone_pose[:, :3, :3], x) + asked.bone_pose[None, :, :3, 3]
    expected = np.einsum("nb,nbi->ni", body.attachment.bone_weight, places) - x
    np.testing.assert_allclose(moved[body.pinned], expected[body.pinned], atol=1e-6)
    np.testing.assert_allclose(moved[face.mirror], moved * [-1.0, 1.0, 1.0], atol=0.15)
