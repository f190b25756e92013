"""The weighted residual backend on bodies: one patch, many patches, moving bones, and a face."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
import pytest
from bodies import DAMPING, FLESH, bridge, cantilever, control, turned

from faceanim.backends import make_solver
from faceanim.backends.weighted_residual.answers import Columns, faded, superposed
from faceanim.backends.weighted_residual.model import MuscleModel, WholeModel
from faceanim.backends.weighted_residual.options import Options
from faceanim.body.assembly import stiffness_matrix
from faceanim.body.body import PULL_ALONG, Body, Muscles
from faceanim.body.control import Control
from faceanim.body.solid import solid_body
from faceanim.expression.library import load_expression
from faceanim.face.library import load_face
from faceanim.geometry.shapes import box_tets
from faceanim.ground.errors import DivergenceError, UserError
from faceanim.session.session import Session

PATCHED = Options(reach=20.0, patch_degree=4, cache=False)


def surface(solver: Any, state: Any, body: Body) -> np.ndarray:
    out = np.full_like(body.surface.points, np.nan)
    solver.surface(state, out)
    return out


def test_size_decides_on_patches() -> None:
    """A bar of 43 mm is one patch by default and many of reach 20 mm."""
    body = bridge()
    assert isinstance(make_solver("weighted_residual", body).model, WholeModel)
    assert isinstance(make_solver("weighted_residual", body, PATCHED).model, MuscleModel)


def test_bones_that_turn_together_turn_the_body() -> None:
    """A common rotation of 30 degrees is exact, and answers turn with it."""
    body = bridge()
    for options in (Options(), PATCHED):
        solver = make_solver("weighted_residual", body, options)
        still, moved = control(body, 0.5), control(body, 0.5)
        moved.bone_pose[:] = turned(30.0)
        a, b = (surface(solver, solver.solve_static(c), body) for c in (still, moved))
        pose = turned(30.0)
        np.testing.assert_allclose(b, a @ pose[:3, :3].T + pose[:3, 3], atol=1e-8)


def test_a_moving_bone_stretches_what_it_holds() -> None:
    """One bone pulled by 1 mm: the bar is stretched evenly in between."""
    body = bridge()
    solver = make_solver("weighted_residual", body)
    asked = Control.rest(body)
    asked.bone_pose[1, 0, 3] = 1.0
    moved = surface(solver, solver.solve_static(asked), body) - body.surface.points
    np.testing.assert_allclose(moved[:, 0], body.surface.points[:, 0] / 40.0, atol=0.03)


def slab() -> Body:
    """Return flesh on bone, 60 x 60 x 10 mm, with a muscle that pulls the middle of its surface sideways."""
    mesh = box_tets((12, 12, 2), (60.0, 60.0, 10.0))
    body = solid_body(mesh, FLESH, mesh.points[:, 2] < 1e-9, **DAMPING)
    p = body.surface.points
    near = np.linalg.norm(p - [30.0, 30.0, 10.0], axis=1) < 12.0
    node = np.flatnonzero(near & (p[:, 2] > 9.9)).astype(np.int32)
    k, zeros = len(node), np.zeros(len(node), np.int32)
    along = np.full(k, PULL_ALONG, np.int32)
    fibres = zeros, node, np.full(k, 1.0 / k), along, np.repeat([[0.8, 0.0, 0.6]], k, axis=0), zeros, np.ones(k)
    return replace(body, muscles=Muscles(("pull",), np.array([300.0]), *fibres))


@pytest.mark.slow
def test_patches_answer_as_the_whole_does() -> None:
    """On flesh held by bone the superposed patches have the direction and nearly the size of the whole's answer."""
    body = slab()
    moved = []
    for options in (Options(reach=50.0, cache=False), Options(reach=28.0, patch_degree=6, cache=False)):
        solver = make_solver("weighted_residual", body, options)
        moved.append((surface(solver, solver.solve_static(control(body, 0.1)), body) - body.surface.points).ravel())
    a, b = moved
    assert float(a @ b) / np.linalg.norm(a) / np.linalg.norm(b) > 0.93
    assert 0.6 < np.linalg.norm(b) / np.linalg.norm(a) < 1.1


def test_the_deflection_of_a_bar_under_its_weight() -> None:
    """Ritz in the exact fields: the mean sag of the tip is within 5 % of Timoshenko's beam."""
    body = cantilever()
    solver = make_solver("weighted_residual", body)
    load = Control.rest(body)
    load.gravity[:] = (0.0, -100.0, 0.0)
    tip = np.abs(body.surface.points[:, 0] - 40.0) < 1e-9
    sag = (surface(solver, solver.solve_static(load), body) - body.surface.points)[tip, 1].mean()
    weight = 1.04e-6 * 100.0 * 100.0
    expected = weight * 40.0**4 / (8.0 * 15.0 * 1e4 / 12.0) + weight * 40.0**2 / (2.0 * 5 / 6 * 15.0 / 2.8 * 100.0)
    assert sag == pytest.approx(-expected, rel=0.05)


def test_loads_on_a_large_body_are_refused_by_name() -> None:
    """Many patches answer muscles and bones; gravity and forces are refused instead of ignored."""
    body = bridge()
    solver = make_solver("weighted_residual", body, PATCHED)
    load = Control.rest(body)
    load.gravity[:] = (0.0, -9810.0, 0.0)
    state = solver.rest()
    with pytest.raises(UserError, match="gravity and forces"):
        solver.step(state, state, load, 0.01)
    with pytest.raises(UserError, match="gravity and forces"):
        solver.solve_static(load)


def test_pull_saturates() -> None:
    """Four times the force moves the flesh further, but less than four times, and small pulls are linear."""
    body = bridge()
    strong = replace(body, muscles=replace(body.muscles, max_force=20.0 * body.muscles.max_force))
    solver = make_solver("weighted_residual", strong, PATCHED)
    size = [
        np.abs(surface(solver, solver.solve_static(control(strong, a)), strong) - strong.surface.points).max()
        for a in (0.01, 0.02, 0.25, 1.0)
    ]
    assert size[1] / size[0] == pytest.approx(2.0, rel=0.02)
    assert 1.2 * size[2] < size[3] < 3.5 * size[2]


def test_a_patched_body_comes_back_and_loses_energy() -> None:
    """Released, the energy falls in every step, and step and equilibrium agree."""
    body = bridge()
    solver = make_solver("weighted_residual", body, PATCHED)
    pull, rest = control(body, 0.7, jaw=2.0), Control.rest(body)
    state, goal = solver.rest(), solver.solve_static(pull)
    for _ in range(300):
        solver.step(state, state, pull, 1 / 60)
    np.testing.assert_allclose(surface(solver, state, body), surface(solver, goal, body), atol=1e-6)
    energies = []
    for _ in range(100):
        energies.append(solver.energy(state, rest).total)
        solver.step(state, state, rest, 1 / 60)
    assert (np.diff(energies) <= 1e-12 * energies[0]).all() and energies[-1] < 1e-2 * energies[0]


def test_a_state_that_is_not_finite_is_refused() -> None:
    """NaN in the amplitudes: a `DivergenceError` that names the time."""
    body = cantilever()
    solver = make_solver("weighted_residual", body)
    state = solver.rest()
    state.q[0] = np.nan
    with pytest.raises(DivergenceError, match="t ="):
        solver.step(state, state, Control.rest(body), 0.01)


def test_a_body_without_muscles_only_follows_its_bones() -> None:
    """No fibre, no answer: a long bar in many patches is carried and no more."""
    body = cantilever()
    solver = make_solver("weighted_residual", body, PATCHED)
    state = solver.rest()
    asked = Control.rest(body)
    asked.bone_pose[0, 1, 3] = 2.0
    solver.step(state, state, asked, 0.01)
    np.testing.assert_allclose(
        surface(solver, state, body), body.surface.points + np.array([0.0, 2.0, 0.0]), atol=1e-12
    )


def layered_slab() -> Any:
    """Return a solid of 24 x 24 x 6 mm on bone, its upper third ten times as stiff as the rest."""
    mesh = box_tets((6, 6, 3), (24.0, 24.0, 6.0))
    region = (mesh.points[mesh.tets][:, :, 2].mean(axis=1) < 4.0).astype(np.int32)
    soft = replace(FLESH, young_modulus=0.1 * FLESH.young_modulus)
    return solid_body(mesh, (FLESH, soft), mesh.points[:, 2] < 1e-9, region=region, **DAMPING).solid


def test_corrections_soften_towards_elements_and_never_beyond() -> None:
    """Ritz: from one poor field the compliance under a sideways pull only grows, to 95 % of that of linear elements in
    16 rounds; without rounds it is that of the field alone."""
    solid = layered_slab()
    x = solid.mesh.points
    stiffness, free = stiffness_matrix(solid), np.flatnonzero(np.repeat(~solid.held, 3))
    loads = np.zeros((x.size, 1))
    loads[3 * np.argmin(np.linalg.norm(x - [12.0, 12.0, 6.0], axis=1))] = 10.0
    poor = np.zeros_like(x)
    poor[:, 0] = x[:, 2] * np.exp(-((x[:, 0] - 12.0) ** 2 + (x[:, 1] - 12.0) ** 2) / 50.0)
    field = poor.reshape(-1, 1)
    compliance = [float(loads[:, 0] @ superposed(field, solid, loads, k)[:, 0]) for k in (0, 1, 2, 4, 16)]
    exact = float(loads[free, 0] @ np.linalg.solve(stiffness[free][:, free].toarray(), loads[free, 0]))
    alone = float((field.T @ loads)[0, 0] ** 2 / (field.T @ (stiffness @ field))[0, 0])
    assert compliance[0] == pytest.approx(alone, rel=1e-9)
    assert (np.diff(compliance) > 0.0).all() and compliance[0] < 0.6 * exact
    assert 0.95 * exact < compliance[-1] <= exact * (1.0 + 1e-9)


def test_columns_solve_their_own_equations() -> None:
    """On one column of nodes, all others held, a column's answer is that of the solid; held nodes stay."""
    mesh = box_tets((2, 2, 3), (8.0, 8.0, 6.0))
    middle = np.linalg.norm(mesh.points[:, :2] - 4.0, axis=1) < 1e-9
    solid = solid_body(mesh, FLESH, ~middle | (mesh.points[:, 2] < 1e-9), **DAMPING).solid
    assert solid is not None
    stiffness = stiffness_matrix(solid)
    force = np.random.default_rng(1).standard_normal((mesh.points.size, 2))
    moved = Columns(solid, stiffness).answer(force)
    free = np.repeat(~solid.held, 3)
    np.testing.assert_allclose((stiffness @ moved)[free], force[free], atol=1e-9)
    assert not moved[~free].any()


def test_answers_fade_smoothly() -> None:
    """One in the core, zero at the reach, never rising, no kink."""
    t = np.linspace(0.0, 1.0, 1001)
    f = faded(t)
    assert f[0] == 1.0 and f[-1] == 0.0 and (np.diff(f) <= 0.0).all()
    assert np.abs(np.diff(f, 2)).max() < 1e-4


@pytest.fixture(scope="module")
def face() -> Any:
    """The coarse face with its solver; half a minute the first time."""
    session = Session(load_face(density="coarse"), load_expression("6+12"), backend="weighted_residual", duration=0.2)
    return session


@pytest.mark.slow
def test_a_smile_is_smooth(face: Any) -> None:
    """The corners go out and up by more than a centimetre, 14.5 mm +- 20 % as finite elements do; mirror images stay so,
    triangles shrink no more than modal warping's in the same smile, and a frame takes less than a millisecond."""
    body, solver = face.body, face.solver
    asked = face.control(1.0)
    points = surface(solver, solver.solve_static(asked), body)
    moved = points - body.surface.points
    corner = face.face.landmarks["cheilion_left"]
    assert 2.0 < moved[corner, 0] < 15.0 and moved[corner, 1] > 1.0
    assert 0.8 * 14.5 < np.linalg.norm(moved[corner]) < 1.2 * 14.5
    np.testing.assert_allclose(moved[face.face.mirror], moved * [-1.0, 1.0, 1.0], atol=0.3)
    t = body.surface.triangles

    def areas(x: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.cross(x[t[:, 1]] - x[t[:, 0]], x[t[:, 2]] - x[t[:, 0]]), axis=1)

    peer = make_solver("modal_warping", body)
    theirs = surface(peer, peer.solve_static(asked), body)
    ours, peers = (np.percentile(areas(x) / areas(body.surface.points), [0.5, 99.5]) for x in (points, theirs))
    assert ours[0] > 0.95 * peers[0] and ours[1] < 2.0
    state, best = solver.rest(), np.inf
    for _ in range(100):
        start = perf_counter()
        solver.step(state, state, asked, 1 / 60)
        solver.surface(state, points)
        best = min(best, perf_counter() - start)
    assert best < 1e-3


@pytest.mark.slow
def test_a_blink_closes_the_lids_partly(face: Any) -> None:
    """Upper lids come down by more than 2 mm, and the lips stay where they are."""
    body, solver = face.body, face.solver
    asked = Control.rest(body)
    asked.activation[[n.startswith("orbicularis_oculi_palpebral") for n in body.muscles.names]] = 1.0
    moved = surface(solver, solver.solve_static(asked), body) - body.surface.points
    assert moved[:, 1].min() < -2.0
    assert np.abs(moved[face.face.landmarks["cheilion_left"]]).max() < 0.3
