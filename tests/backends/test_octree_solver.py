"""The octree backend on small bodies of flesh: what every backend promises, and what this one adds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from bodies import control, held_sheet
from slabs import SKIN, held_slab, lips

from faceanim.backends import make_solver
from faceanim.backends.octree_mass_spring.options import Options
from faceanim.backends.solver import StepReport
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.body.solid import solid_body
from faceanim.geometry.shapes import box_tets
from faceanim.ground.errors import UserError
from faceanim.tissue.material import Material

STEP = 1 / 60
BOX = [[-20.0, -20.0, -6.0], [0.0, 20.0, 0.0]]
CHOICES = {
    "leaves": Options(cells=8),
    "aligned": Options(cell_size=2.0, level=1),
    "mixed": Options(cells=16, cut="importance", box=BOX, level=1),
    "hard": Options(cells=16, cut="importance", box=BOX, level=2, hard=True),
    "harmonic": Options(cells=16, level=1, rule="harmonic"),
    "dynamic": Options(cells=8, dynamic=True),
}


@pytest.fixture(scope="module", params=sorted(CHOICES))
def case(request: pytest.FixtureRequest) -> Iterator[tuple[Body, Any]]:
    body = held_slab()
    yield body, make_solver("octree_mass_spring", body, CHOICES[request.param])


def surface(solver: Any, state: Any, body: Body) -> np.ndarray:
    out = np.full_like(body.surface.points, np.nan)
    solver.surface(state, out)
    return out


def test_rest_is_the_surface_of_the_body(case: tuple[Body, Any]) -> None:
    """`rest` is new each time and its surface the body's; without a pull it stays there."""
    body, solver = case
    np.testing.assert_allclose(surface(solver, solver.rest(), body), body.surface.points, atol=1e-9)
    assert solver.rest() is not solver.rest() and 0 < solver.substep < solver.dt_max
    state = solver.rest()
    solver.step(state, state, Control.rest(body), STEP)
    np.testing.assert_allclose(surface(solver, state, body), body.surface.points, atol=1e-9)


def test_a_step_reports_and_leaves_its_input_alone(case: tuple[Body, Any]) -> None:
    """Time goes on by dt, the report has its fields, the surface moves, the state before stays."""
    body, solver = case
    first, second = solver.rest(), solver.rest()
    report = solver.step(first, second, control(body, 0.5), STEP)
    assert isinstance(report, StepReport) and report.iterations >= 1 and np.isfinite(report.residual)
    assert second.t == pytest.approx(STEP) and first.t == 0.0
    np.testing.assert_allclose(surface(solver, first, body), body.surface.points, atol=1e-9)
    assert np.abs(surface(solver, second, body) - body.surface.points).max() > 1e-3


def test_stepping_in_place_is_the_same(case: tuple[Body, Any]) -> None:
    """`state_out` may be `state_in`: the same bytes come out."""
    body, solver = case
    pull = control(body, 0.5, jaw=2.0)
    apart, together = solver.rest(), solver.rest()
    for _ in range(3):
        after = solver.rest()
        solver.step(apart, after, pull, STEP)
        apart = after
        solver.step(together, together, pull, STEP)
    assert surface(solver, apart, body).tobytes() == surface(solver, together, body).tobytes()


def test_the_equilibrium_stays_put(case: tuple[Body, Any]) -> None:
    """Steps from `solve_static` under the same control do not move on; gravity and forces included."""
    body, solver = case
    pull = control(body, 0.5, jaw=2.0)
    pull.gravity = np.array([0.0, -9810.0, 0.0])
    pull.force = np.zeros_like(body.surface.points)
    pull.force[~body.pinned, 2] = 0.05
    state = solver.solve_static(pull)
    assert solver.static_report.converged
    before = surface(solver, state, body)
    assert np.abs(before - body.surface.points).max() > 0.1
    for _ in range(5):
        report = solver.step(state, state, pull, STEP)
    assert report.residual < 1e-6
    np.testing.assert_allclose(surface(solver, state, body), before, atol=1e-6)


def test_energy_falls_after_release(case: tuple[Body, Any]) -> None:
    """Drag takes energy out step by step, down to that of rest."""
    body, solver = case
    state, rest = solver.solve_static(control(body, 0.5)), Control.rest(body)
    energies = [solver.energy(state, rest).total]
    for _ in range(40):
        solver.step(state, state, rest, STEP)
        energies.append(solver.energy(state, rest).total)
    scale = energies[0] - solver.energy(solver.rest(), rest).total
    assert scale > 0.0 and (np.diff(energies) < 1e-3 * scale).all()
    assert energies[-1] - solver.energy(solver.rest(), rest).total < 0.01 * scale


def test_pinned_vertices_go_with_their_bones(case: tuple[Body, Any]) -> None:
    """A pinned vertex is where its bones put it, in steps and at equilibrium; the flesh beside it follows."""
    body, solver = case
    moved = control(body, 0.0, jaw=4.0)
    x = body.surface.points[body.pinned]
    weight = body.attachment.bone_weight[body.pinned]
    places = [x @ pose[:3, :3].T + pose[:3, 3] for pose in moved.bone_pose]
    expected = sum(weight[:, b : b + 1] * place for b, place in enumerate(places))
    state = solver.rest()
    solver.step(state, state, moved, STEP)
    np.testing.assert_allclose(surface(solver, state, body)[body.pinned], expected, atol=1e-9)
    static = solver.solve_static(moved)
    np.testing.assert_allclose(surface(solver, static, body)[body.pinned], expected, atol=1e-9)
    rig = solver.rig(static.level)
    carried_by_cells = np.asarray(rig.skin @ static.q)[body.pinned]
    moving = np.linalg.norm(expected - x, axis=1).max()
    assert np.linalg.norm(carried_by_cells - expected, axis=1).max() < 0.25 * moving


@pytest.mark.parametrize("wrong", ["nan", "shape", "pose", "step", "force", "gravity"])
def test_a_wrong_control_is_refused(case: tuple[Body, Any], wrong: str) -> None:
    """Not finite, of a wrong shape, a step that is not positive: a `UserError`, the state untouched."""
    body, solver = case
    bad = Control.rest(body)
    if wrong == "nan":
        bad.activation[0] = np.nan
    elif wrong == "shape":
        bad.activation = np.zeros(len(body.muscles.names) + 1)
    elif wrong == "pose":
        bad.bone_pose = np.full_like(bad.bone_pose, np.inf)
    elif wrong == "force":
        bad.force = np.zeros((2, 3))
    elif wrong == "gravity":
        bad.gravity = np.array([0.0, np.nan, 0.0])
    state = solver.rest()
    for dt in (0.0, -1.0, np.nan) if wrong == "step" else (STEP,):
        with pytest.raises(UserError):
            solver.step(state, state, bad, dt)
    assert state.t == 0.0
    if wrong != "step":
        with pytest.raises(UserError):
            solver.solve_static(bad)


def test_forces_are_the_gradient_of_the_energy(case: tuple[Body, Any]) -> None:
    """Central differences of the total energy over every kind of term, on crumpled flesh."""
    body, solver = case
    pull = control(body, 0.7, jaw=2.0)
    pull.gravity = np.array([0.0, -9810.0, 0.0])
    state = solver.solve_static(pull)
    rig = solver.rig(state.level)
    rng = np.random.default_rng(0)
    state.q += 0.05 * rig.model.side.min() * rng.standard_normal(state.q.shape)
    from faceanim.kernels import lattice as kernels

    kernels.follow(state.q, rig.model.tables.slaves)
    target = rig.targets(solver.flesh.carried(pull.bone_pose))
    force = np.zeros_like(state.q)
    kernels.all_forces(state.q, rig.load(pull, state.q).copy(), rig.model.tables, target, force)
    way = rng.standard_normal(state.q.shape)
    way[rig.model.carried] = 0.0
    kernels.follow(way, rig.model.tables.slaves)
    eps, energies = 1e-5, []
    for sign in (1.0, -1.0):
        moved = state.copy()
        moved.q += sign * eps * way
        energies.append(solver.energy(moved, pull).total)
    free = rig.model.free_mask()
    assert -(energies[0] - energies[1]) / (2 * eps) == pytest.approx(float((force[free] * way[free]).sum()), rel=1e-5)


def test_aligned_bones_carry_nodes_exactly() -> None:
    """Where held nodes are corners of cells there are no ties, on the leaves and on the level above."""
    body = held_slab((20, 20, 3))
    for level in (0, 1):
        solver = make_solver("octree_mass_spring", body, Options(cell_size=2.0, level=level))
        rig = solver.rig(solver.base)
        assert len(rig.model.carried) > 0
        state = solver.solve_static(control(body, 0.0, jaw=3.0))
        held = solver.flesh.carried(control(body, 0.0, jaw=3.0).bone_pose)
        np.testing.assert_allclose(state.q[rig.model.carried], held[rig.model.carried_by], atol=1e-12)
        if level == 0:
            assert len(rig.loose) == 0


def test_stiffness_matches_the_material() -> None:
    """A bar of nu = 1/4 stretches by F L / (E A): E of the lattice is the material's, whatever the cells' size."""
    mesh = box_tets((16, 4, 4), (40.0, 10.0, 10.0))
    held = np.flatnonzero(mesh.points[:, 0] == 0.0)
    body = solid_body(mesh, Material("bar", 1e-6, 20.0, 0.25), held)
    x = body.surface.points
    share = np.isclose(x[:, 0], 40.0).astype(float)
    for d in (1, 2):
        share *= np.where(np.isclose(x[:, d], 0.0) | np.isclose(x[:, d], 10.0), 0.5, 1.0)
    pull = Control.rest(body)
    pull.force = np.zeros_like(x)
    pull.force[:, 0] = share / share.sum()
    for cells, level in ((4, 0), (8, 0), (16, 0), (16, 1)):
        solver = make_solver("octree_mass_spring", body, Options(cells=cells, level=level))
        moved = surface(solver, solver.solve_static(pull), body) - x
        assert moved[share > 0, 0].mean() == pytest.approx(1.0 * 40.0 / (20.0 * 100.0), rel=0.05)


def test_a_held_face_holds_between_its_nodes() -> None:
    """With cells finer than the solid's elements, every corner of a cell on a held face is carried, not a few points."""
    mesh = box_tets((2, 1, 1), (20.0, 10.0, 10.0))
    body = solid_body(mesh, SKIN, np.flatnonzero(mesh.points[:, 0] == 0.0))
    solver = make_solver("octree_mass_spring", body, Options(cell_size=2.5))
    model = solver.rig(solver.base).model
    face = np.isclose(model.points[:, 0], 0.0)
    assert sorted(np.flatnonzero(face)) == sorted(model.carried) and face.sum() == 25


def test_mixed_materials_are_averaged_in_a_cell() -> None:
    """A cell's stiffness is the mean of its elements' by volume; mass is exactly theirs."""
    mesh = box_tets((4, 2, 2), (4.0, 2.0, 2.0))
    region = (mesh.points[mesh.tets].mean(axis=1)[:, 0] > 1.0).astype(np.int32)
    materials = (Material("soft", 1e-6, 10.0, 0.25), Material("stiff", 2e-6, 30.0, 0.25))
    body = solid_body(mesh, materials, np.flatnonzero(mesh.points[:, 0] == 0.0), region=region)
    solver = make_solver("octree_mass_spring", body, Options(cell_size=2.0))
    stiffness = solver.lattice.stiffness
    assert stiffness[0] / stiffness[1] == pytest.approx((10.0 + 30.0) / 2.0 / 30.0)
    assert solver.lattice.mass.sum() == pytest.approx(body.solid.node_mass.sum(), rel=1e-12)  # type: ignore[union-attr]
    assert not solver.notices


def test_lips_open_when_pulled_apart() -> None:
    """Forces on one lip leave the other almost where it is, on every level: they are not glued."""
    mesh = lips()
    held = np.flatnonzero(mesh.points[:, 0] == 0.0)
    body = solid_body(mesh, SKIN, held, damping=2000.0)
    node = mesh.boundary_nodes
    above = np.zeros(len(mesh.points), dtype=bool)
    above[mesh.tets[mesh.points[mesh.tets].mean(axis=1)[:, 1] > 3.0]] = True
    end = np.isclose(body.surface.points[:, 0], 12.0)
    upper = end & above[node] & (body.surface.points[:, 1] > 2.9)
    pull = Control.rest(body)
    pull.force = np.zeros_like(body.surface.points)
    pull.force[upper, 1] = 8.0 / upper.sum()
    for size, level in ((2.0, 0), (0.75, 1), (1.0, 1)):
        solver = make_solver("octree_mass_spring", body, Options(cell_size=size, level=level))
        moved = surface(solver, solver.solve_static(pull), body) - body.surface.points
        lower = end & ~above[node]
        opening = moved[upper, 1].mean() - moved[lower, 1].mean()  # the rest is the joined half that leans
        assert opening > 0.45 * moved[upper, 1].mean() > 0.5


def test_big_damping_is_stable_and_slow_steps_are_divided() -> None:
    """Damping is implicit in the velocity: 1e7 / s and steps of a second stay finite and small."""
    body = held_slab(damping=1e7)
    solver = make_solver("octree_mass_spring", body, Options(cells=8))
    state = solver.rest()
    report = solver.step(state, state, control(body, 1.0), 1.0)
    assert report.iterations >= 1.0 / solver.substep
    assert np.abs(surface(solver, state, body) - body.surface.points).max() < 5.0


@pytest.mark.parametrize("dynamic", [False, True])
def test_forces_that_invert_cells_do_no_harm(dynamic: bool) -> None:
    """A load a thousand times too strong: finite positions, a notice that says so, and after release the way back."""
    body = held_slab(damping=4000.0)
    solver = make_solver("octree_mass_spring", body, Options(cells=8, dynamic=dynamic, quiet=3))
    crush = Control.rest(body)
    crush.force = np.zeros_like(body.surface.points)
    middle = int(np.argmin(np.linalg.norm(body.surface.points - [0.0, 5.0, 0.0], axis=1)))
    crush.force[middle] = [300.0, -100.0, -2000.0]
    state = solver.rest()
    for _ in range(4):
        solver.step(state, state, crush, STEP)
        assert np.isfinite(state.q).all() and np.abs(state.q).max() < 1e4
    assert any("larger" in text for text in solver.notices)
    if dynamic:
        assert state.level.max() > 0
        for _ in range(40):
            solver.step(state, state, Control.rest(body), STEP)
        assert state.level.max() == 0
        np.testing.assert_allclose(surface(solver, state, body), body.surface.points, atol=0.05)


def test_a_force_cut_is_safe_under_full_pull() -> None:
    """Strong muscles make cells coarser where they pull; the cut then survives a step."""
    weak, strong = (held_slab(force=f) for f in (1.0, 2e4))
    fine = make_solver("octree_mass_spring", weak, Options(cells=16, cut="force"))
    coarse = make_solver("octree_mass_spring", strong, Options(cells=16, cut="force"))
    assert fine.base.max() == 0 and coarse.base.max() > 0


def test_recutting_keeps_momentum_and_shape() -> None:
    """To coarser, mixed and back: momentum to rounding, the surface within what coarse cells can show."""
    body = held_slab()
    solver = make_solver("octree_mass_spring", body, Options(cells=16))
    state = solver.rest()
    solver.step(state, state, control(body, 1.0), 0.25 * STEP)
    rig = solver.rig(state.level)
    momentum = rig.model.own_mass[:, :, None] * state.qd[rig.model.corner]
    rng = np.random.default_rng(0)
    for level in (np.ones_like(state.level), rng.integers(0, 3, len(state.level)), np.zeros_like(state.level)):
        other = solver.recut(state, level)
        model = solver.rig(other.level).model
        after = model.own_mass[:, :, None] * other.qd[model.corner]
        np.testing.assert_allclose(after.sum((0, 1)), momentum.sum((0, 1)), atol=1e-12 * np.abs(momentum).sum())
        assert np.abs(surface(solver, other, body) - surface(solver, state, body)).max() < 0.5
    same = solver.recut(state, state.level)
    np.testing.assert_allclose(same.q, state.q, atol=1e-12)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("cells", 0), ("levels", 0), ("level", -1), ("level", 4), ("cell_size", 0.0), ("cell_size", np.nan),
        ("beta", 0.6), ("ks", 0.0), ("hold", -1.0), ("floor", 0.0), ("low", 1.0), ("high", 1.0), ("ramp", 0.5),
        ("safety", 1.0), ("static_tolerance", 0.0), ("budget", 3), ("quiet", 0), ("rule", "best"), ("cut", "none"),
        ("chain", "none"), ("importance", [2.0]), ("box", [[0, 0, 0], [0, 1, 1]]),
    ],
)  # fmt: skip
def test_unsound_options_are_refused(field: str, value: Any) -> None:
    """The message names the field."""
    with pytest.raises(UserError, match=field):
        Options(**{field: value})


def test_bodies_that_do_not_fit_are_refused() -> None:
    """Skin without flesh, flesh that nothing holds, a loose part, cells too large or too small, a wrong painting."""
    with pytest.raises(UserError, match="volume"):
        make_solver("octree_mass_spring", held_sheet())
    mesh = box_tets((2, 2, 2), (1.0, 1.0, 1.0))
    with pytest.raises(UserError, match="free"):
        make_solver("octree_mass_spring", solid_body(mesh, SKIN, np.zeros(0, dtype=int)))
    body = held_slab()
    for size in (100.0, 0.01):
        with pytest.raises(UserError, match="side"):
            make_solver("octree_mass_spring", body, Options(cell_size=size))
    with pytest.raises(UserError, match="importance"):
        make_solver("octree_mass_spring", body, Options(cut="importance", importance=np.ones(3)))
    with pytest.raises(UserError, match="importance"):
        Options(cut="importance")


def test_what_is_left_out_is_said() -> None:
    """Another Poisson ratio and damping by stiffness are named in the notices."""
    body = held_slab(material=Material("wet", 1e-6, 20.0, 0.45), stiffness_damping=0.01)
    solver = make_solver("octree_mass_spring", body, Options(cells=8))
    assert any("Poisson" in text for text in solver.notices) and any("stiffness" in text for text in solver.notices)


def test_the_slowest_vibration_of_a_slender_bar_is_found() -> None:
    """Both bending vibrations of a square bar are equally slow and far below the third: the search bears that, and the
    frequency is that of a cantilever, 1.875^2 sqrt(E I / rho A L^4), within the error of four cells across."""
    mesh = box_tets((20, 4, 4), (100.0, 20.0, 20.0))
    body = solid_body(mesh, Material("jelly", 1.04e-6, 30.0, 0.25), mesh.points[:, 0] < 1e-9, damping=2.0)
    solver = make_solver("octree_mass_spring", body, Options(cells=20))
    found = solver.rig(solver.base).model.slowest()
    expected = 1.875104**2 * np.sqrt(30.0 * 20.0**2 / 12.0 / (1.04e-6 * 100.0**4))
    assert 0.75 * expected < found < 1.25 * expected
