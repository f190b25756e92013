"""The octree backend on a face, and what a face asked of it: skin carried by the solid, films, safe cells, firm muscles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from bodies import control
from slabs import SKIN, held_slab

from faceanim.backends import make_solver
from faceanim.backends.octree_mass_spring.options import Options
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.body.solid import solid_body
from faceanim.expression.library import load_expression
from faceanim.face.face import Face
from faceanim.face.library import load_face
from faceanim.geometry.shapes import box_tets
from faceanim.ground.errors import UserError
from faceanim.kernels import lattice as kernels
from faceanim.tissue.material import Material

FRAME = 1 / 30


def surface(solver: Any, state: Any, body: Body) -> np.ndarray:
    out = np.full_like(body.surface.points, np.nan)
    solver.surface(state, out)
    return out


def squeezed(solver: Any, size: float = 0.3) -> tuple[Any, Any, np.ndarray]:
    """Return rig, tables and crumpled positions at which some cells are below their barrier and some inside out."""
    rig = solver.rig(solver.base)
    rng = np.random.default_rng(1)
    x = rig.model.points + size * rig.model.side.min() * rng.standard_normal(rig.model.points.shape)
    return rig, rig.model.tables, x


def test_surface_and_forces_do_the_same_work() -> None:
    """Forces on the surface reach the cells by the transposed weights: f . du = F . dx for whatever moves."""
    body = held_slab()
    solver = make_solver("octree_mass_spring", body, Options(cells=8))
    rig, rest = solver.rig(solver.base), Control.rest(body)
    rng = np.random.default_rng(0)
    rest.force = rng.standard_normal(body.surface.points.shape)
    x = rig.model.points
    dx = rng.standard_normal(x.shape)
    du = rig.surface(x + dx, rest.bone_pose) - rig.surface(x, rest.bone_pose)
    assert np.abs(du).max() > 0.1
    assert float((rest.force * du).sum()) == pytest.approx(float((rig.load(rest, x) * dx).sum()), rel=1e-10)


def test_solid_nodes_lie_inside_their_cells() -> None:
    """No node of the solid is extrapolated from its cell, so that a bent cell cannot fling it away."""
    body = held_slab()
    flesh = make_solver("octree_mass_spring", body, Options(cells=7)).flesh
    weight = flesh.lattice.tree.leaves.weights(flesh.node_leaf, flesh.solid.mesh.points)
    assert weight.min() > -1e-9


def test_the_force_of_a_barrier_is_the_gradient_of_its_energy() -> None:
    """Central differences, with cells on both sides of the barrier; nothing at rest or in small strain."""
    body = held_slab()
    solver = make_solver("octree_mass_spring", body, Options(cells=8))
    rig, tables, x = squeezed(solver)
    volume = np.zeros(len(rig.model.corner))
    kernels.watch(x, tables.cells, tables.barrier, 0.0, volume)
    assert 0 < tables.barrier.listed[0] < len(volume) and volume.min() < 0.0
    force, way = np.zeros_like(x), np.random.default_rng(2).standard_normal(x.shape)
    kernels.barrier_force(x, tables.cells, tables.barrier, force)
    ahead, behind = (kernels.barrier_energy(x + s * 1e-6 * way, tables.cells, tables.barrier) for s in (1, -1))
    assert float((force * way).sum()) == pytest.approx(-(ahead - behind) / 2e-6, rel=1e-6)
    for still in (rig.model.points, 0.9 * rig.model.points):
        assert kernels.barrier_energy(still, tables.cells, tables.barrier) == 0.0


def test_a_barrier_has_momentum_and_turns_with_the_body() -> None:
    """Its forces sum to nothing, nor do they twist; its energy does not see a rotation."""
    solver = make_solver("octree_mass_spring", held_slab(), Options(cells=8))
    rig, tables, x = squeezed(solver)
    kernels.watch(x, tables.cells, tables.barrier, 0.0, np.zeros(len(rig.model.corner)))
    force = np.zeros_like(x)
    kernels.barrier_force(x, tables.cells, tables.barrier, force)
    size = np.abs(force).sum()
    assert size > 0 and np.abs(force.sum(axis=0)).max() < 1e-11 * size
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-10 * size * np.abs(x).max()
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    energies = [kernels.barrier_energy(np.ascontiguousarray(y), tables.cells, tables.barrier) for y in (x, x @ turn.T)]
    assert energies[1] == pytest.approx(energies[0], rel=1e-10)


def test_a_film_joins_no_cells() -> None:
    """Two slabs with a film between them slide: the one that is pulled hardly moves the other, unless films count."""
    mesh = box_tets((8, 5, 2), (40.0, 10.0, 10.0))
    middle = mesh.points[mesh.tets].mean(axis=1)[:, 1]
    film = ((middle > 4.0) & (middle < 6.0)).astype(np.int32)
    body = solid_body(
        mesh, (SKIN, Material("film", 1e-6, 0.01 * SKIN.young_modulus, 0.25)),
        np.flatnonzero(mesh.points[:, 0] == 0.0), region=film, damping=100.0,
    )  # fmt: skip
    x = body.surface.points
    pull = Control.rest(body)
    pull.force = np.zeros_like(x)
    pull.force[(x[:, 0] == 40.0) & (x[:, 1] == 10.0), 1] = 1.0
    share = []
    for least in (0.05, 0.0):
        solver = make_solver("octree_mass_spring", body, Options(cell_size=2.0, film=least))
        moved = surface(solver, solver.solve_static(pull), body) - x
        end = x[:, 0] == 40.0
        share.append(np.abs(moved[end & (x[:, 1] == 0.0)]).max() / np.abs(moved[end & (x[:, 1] == 10.0)]).max())
    assert share[0] < 1e-9 and share[1] > 0.05


def test_lost_stiffness_damping_is_made_good() -> None:
    """xi' = xi + zeta w^2 with w the lowest frequency, which the notice names; a bar's w agrees with a beam's."""
    mesh = box_tets((20, 4, 4), (100.0, 10.0, 10.0))
    body = solid_body(
        mesh, Material("bar", 1e-6, 100.0, 0.25), np.flatnonzero(mesh.points[:, 0] == 0.0), damping=3.0,
        stiffness_damping=0.02,
    )  # fmt: skip
    solver = make_solver("octree_mass_spring", body, Options(cell_size=2.5))
    slowest = solver.rig(solver.base).model.slowest()
    beam = 1.8751**2 * np.sqrt(100.0 * (10.0**4 / 12) / (1e-6 * 100.0 * 100.0**4))
    assert slowest == pytest.approx(beam, rel=0.05)
    assert solver.flesh.drag == pytest.approx(3.0 + 0.02 * slowest**2)
    assert any("damping by mass was raised" in text for text in solver.notices)


def test_drag_lengthens_the_stable_step() -> None:
    """(w dt)^2 = 4 + 2 xi dt: just below it an implicit drag keeps the fastest vibration small, above it it grows."""
    solver = make_solver("octree_mass_spring", held_slab(), Options(cells=8))
    model = solver.rig(solver.base).model
    w, drag = 2.0 / model.largest_step(), 1.0 / model.largest_step()
    for factor, stable in ((0.98, True), (1.02, False)):
        dt = factor * model.largest_step(drag)
        x, v = 1.0, 0.0
        for _ in range(400):
            v = (v - dt * w * w * x) / (1.0 + drag * dt)
            x += dt * v
        assert (abs(x) < 1.0) == stable


@pytest.mark.parametrize(("field", "value"), [("film", 1.0), ("film", -0.1), ("barrier", -1.0), ("least", 1.0)])
def test_unsound_options_are_refused(field: str, value: float) -> None:
    """The message names the field."""
    with pytest.raises(UserError, match=field):
        Options(**{field: value})


def test_coming_to_rest_finds_the_equilibrium(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where Newton's method would cost too much, damped steps end where it ends."""
    from faceanim.backends.octree_mass_spring import solver as module

    body = held_slab()
    newton = make_solver("octree_mass_spring", body, Options(cells=8))
    pull = control(body, 0.5, jaw=2.0)
    expected = surface(newton, newton.solve_static(pull), body)
    monkeypatch.setattr(module, "NEWTON_NODES", 0)
    resting = make_solver("octree_mass_spring", body, Options(cells=8))
    found = surface(resting, resting.solve_static(pull), body)
    assert resting.static_report.converged and np.abs(expected - body.surface.points).max() > 0.1
    assert np.abs(found - expected).max() < 1e-2


@pytest.fixture(scope="module")
def face() -> tuple[Face, Body, Any]:
    face = load_face(density="coarse")
    body = face.body()
    return face, body, make_solver("octree_mass_spring", body, Options())


def asked(face: Face, body: Body, solver: Any, name: str, share: float = 1.0) -> Control:
    """Return the control of the expression `name` at `share` of its strength."""
    control = Control.rest(body)
    drive = load_expression(name).drive(body.muscles.names)
    control.activation[:] = share * drive.activation
    control.bone_pose[1] = face.jaw.pose(
        share * drive.jaw.opening, share * drive.jaw.lateral, share * drive.jaw.protrusion
    )
    return control


@pytest.mark.slow
def test_a_smile_moves_the_mouth_corners_out_and_up(face: tuple[Face, Body, Any]) -> None:
    """6-16 mm, no vertex more than 40 mm, no cell inside out; the equilibrium stays put, and stepping ends there."""
    person, body, solver = face
    smile = asked(person, body, solver, "happiness")
    state = solver.solve_static(smile)
    assert solver.static_report.converged
    before = surface(solver, state, body)
    moved = before - body.surface.points
    assert np.linalg.norm(moved, axis=1).max() < 40.0
    assert solver.rig(state.level).model.least_volume(state.q).min() > 0.0
    for side, out in (("left", 1.0), ("right", -1.0)):
        corner = moved[person.landmarks[f"cheilion_{side}"]]
        assert 6.0 < np.linalg.norm(corner) < 16.0 and out * corner[0] > 3.0 and corner[1] > 3.0
    for _ in range(3):
        solver.step(state, state, smile, FRAME)
    assert np.abs(surface(solver, state, body) - before).max() < 0.02
    stepped = solver.rest()
    for k in range(40):
        solver.step(stepped, stepped, asked(person, body, solver, "happiness", min(1.0, (k + 1) / 12)), FRAME)
    assert np.abs(surface(solver, stepped, body) - before).max() < 0.1


@pytest.mark.slow
def test_an_opening_jaw_parts_the_lips(face: tuple[Face, Body, Any]) -> None:
    """The chin goes with the jaw and the lips part by more than 10 mm; no spike, all finite in every frame."""
    person, body, solver = face
    state = solver.rest()
    gap = []
    for k in range(20):
        solver.step(state, state, asked(person, body, solver, "surprise", min(1.0, (k + 1) / 12)), FRAME)
        points = surface(solver, state, body)
        assert np.linalg.norm(points - body.surface.points, axis=1).max() < 45.0
        upper, lower = (points[person.landmarks[name]] for name in ("stomion_upper", "stomion_lower"))
        gap.append(float(upper[1] - lower[1]))
    assert gap[-1] - gap[0] > 10.0


@pytest.mark.slow
def test_a_blink_closes_the_lids_and_they_open_again(face: tuple[Face, Body, Any]) -> None:
    """Strong fibres on light cells are stable: the aperture falls below 3 mm and comes back; lids stay off the eyeballs."""
    person, body, solver = face
    upper, lower = (person.landmarks[f"lid_{side}_mid_left"] for side in ("upper", "lower"))
    open_ = float(np.linalg.norm(body.surface.points[upper] - body.surface.points[lower]))
    state, apertures = solver.rest(), []
    for share in [*np.linspace(0.1, 1.0, 10), *np.ones(8), *np.linspace(0.9, 0.0, 10), *np.zeros(20)]:
        solver.step(state, state, asked(person, body, solver, "blink", float(share)), FRAME)
        points = surface(solver, state, body)
        apertures.append(float(np.linalg.norm(points[upper] - points[lower])))
        for ball in body.spheres:
            clear = ball.clearance if ball.thick_clearance is None else ball.thick_clearance
            assert (np.linalg.norm(points[ball.node] - ball.centre, axis=1) > ball.radius + clear - 1e-9).all()
    assert open_ > 6.0 and apertures[17] < 3.0 and apertures[-1] == pytest.approx(open_, abs=1.0)
