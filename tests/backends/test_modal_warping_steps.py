"""Steps of the modal warping backend: what every solver of solids promises, moving bones, forces, display, failures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from bars import bar, displaced, hanging, jawed_bar, node_at, solver_of, volume_ratios
from bodies import turned
from scipy.linalg import expm

from faceanim.backends.modal_warping.display import SkinWarp, amplitudes, vertex_warp
from faceanim.backends.modal_warping.options import VARIANTS
from faceanim.backends.modal_warping.recurrence import make_recurrence
from faceanim.backends.modal_warping.twist import mean_rotation, rotation, twist_of
from faceanim.backends.nodal import carried
from faceanim.backends.solver import StepReport
from faceanim.body.control import Control
from faceanim.geometry.embedding import Embedding, embed
from faceanim.ground.errors import DivergenceError, UserError

STEP = 1 / 60
CASES = [(v, {}) for v in VARIANTS] + [("warped", {"integrator": "exact"}), ("consistent", {"integrator": "trapezoid"})]
BODY = jawed_bar()


@pytest.fixture(scope="module", params=CASES, ids=lambda c: "-".join([c[0], *c[1].values()]))
def solver(request: pytest.FixtureRequest) -> Any:
    variant, options = request.param
    return solver_of(BODY, 20, variant, **options)


def asked(activation: float = 0.0, jaw: float = 0.0, g: float = 0.0) -> Control:
    control = hanging(BODY, g)
    control.activation[:] = activation
    if jaw:
        control.bone_pose[-1] = turned(jaw, (38.0, 6.0, 6.0))
    return control


def surface(solver: Any, state: Any) -> np.ndarray:
    out = np.full_like(BODY.surface.points, np.nan)
    solver.surface(state, out)
    return out


def test_rest_stays_at_rest(solver: Any) -> None:
    """Rest is the body's surface, and without a load a step changes nothing but the time."""
    state = solver.rest()
    np.testing.assert_allclose(surface(solver, state), BODY.surface.points, atol=1e-9)
    report = solver.step(state, state, Control.rest(BODY), STEP)
    assert isinstance(report, StepReport) and report.iterations >= 1
    assert state.t == STEP and not state.q.any() and not state.qd.any()
    np.testing.assert_allclose(surface(solver, state), BODY.surface.points, atol=1e-9)
    assert not solver.solve_static(Control.rest(BODY)).q.any()


def test_in_place_is_the_same(solver: Any) -> None:
    """`state_out` may be `state_in`: the same bytes; else `state_in` stays as it was, and copies are independent."""
    apart, together = solver.rest(), solver.rest()
    for k in range(4):
        control, after = asked(0.5, 2.0 * k, 100.0), solver.rest()
        before = apart.copy()
        solver.step(apart, after, control, STEP)
        for name in ("q", "qd", "twist", "twist_rate", "pose", "t"):
            assert np.array_equal(getattr(before, name), getattr(apart, name))
        apart = after
        solver.step(together, together, control, STEP)
    assert surface(solver, apart).tobytes() == surface(solver, together).tobytes()
    kept = together.copy()
    solver.step(together, together, asked(1.0), STEP)
    assert not np.array_equal(kept.q, together.q) and not np.array_equal(kept.pose, together.pose)


def test_the_equilibrium_stays_put(solver: Any) -> None:
    """Steps from `solve_static` under the same muscle, jaw and gravity do not move on."""
    control = asked(0.5, 8.0, 1000.0)
    state = solver.solve_static(control)
    assert solver.static_report.converged and not solver.notices
    before = surface(solver, state)
    assert np.abs(before - BODY.surface.points).max() > 0.5
    for _ in range(20):
        solver.step(state, state, control, STEP)
    np.testing.assert_allclose(surface(solver, state), before, atol=1e-5)


def test_energy_falls_after_release(solver: Any) -> None:
    """Released from a pull, damping takes energy out step by step, down to that of rest."""
    state, rest = solver.solve_static(asked(0.5)), Control.rest(BODY)
    energies = [solver.energy(state, rest).total]
    for _ in range(60):
        solver.step(state, state, rest, STEP)
        energies.append(solver.energy(state, rest).total)
    assert energies[0] > 0.0
    assert (np.diff(energies) < 1e-9 * energies[0]).all()
    assert energies[-1] < 1e-2 * energies[0]


def test_held_nodes_go_with_their_bones(solver: Any) -> None:
    """A held node is where its bone puts it, in steps, on the surface and at equilibrium."""
    control = asked(0.3, 25.0)
    state = solver.rest()
    solver.step(state, state, control, STEP)
    expected = carried(BODY.solid, control.bone_pose)
    for s in (state, solver.solve_static(control)):
        np.testing.assert_allclose(solver.nodes(s)[BODY.solid.held], expected, atol=1e-12)
        inside = np.flatnonzero(BODY.solid.held[BODY.solid.skin.node[:, 0]])
        at = solver.nodes(s)[BODY.solid.skin.node[inside, 0]]
        np.testing.assert_allclose(surface(solver, s)[inside], at, atol=1e-12)


@pytest.mark.parametrize("wrong", ["nan", "shape", "pose", "sheared", "step", "endless"])
def test_a_wrong_control_is_refused(solver: Any, wrong: str) -> None:
    """A `UserError`, the state untouched."""
    bad, state = asked(0.1), solver.rest()
    if wrong == "nan":
        bad.activation[0] = np.nan
    elif wrong == "shape":
        bad.activation = np.zeros(7)
    elif wrong == "pose":
        bad.bone_pose = np.full_like(bad.bone_pose, np.inf)
    elif wrong == "sheared":
        bad.bone_pose[1, 0, 1] = 0.4
    with pytest.raises(UserError):
        solver.step(state, state, bad, {"step": 0.0, "endless": np.inf}.get(wrong, STEP))
    assert state.t == 0.0 and not state.q.any() and not state.pose[1, 0, 1]
    if wrong not in ("step", "endless"):
        with pytest.raises(UserError):
            solver.solve_static(bad)


def test_forces_are_the_slope_of_their_energy() -> None:
    """For variants with an energy, J^T F of muscle, gravity and surface force is its gradient (differences, 1e-6)."""
    control = asked(0.6, 10.0, 500.0)
    control.force = np.random.default_rng(0).standard_normal(BODY.surface.points.shape)
    random = np.random.default_rng(1)
    for variant in ("linear", "consistent", "rotation_strain"):
        solver = solver_of(BODY, 12, variant)
        state = solver.solve_static(control)
        state.q += 0.3 * np.abs(state.q).max() * random.standard_normal(solver.modes.count)
        found, h = solver.generalised_force(state, control), 1e-5 * np.abs(state.q).max()
        slope = np.zeros_like(found)
        for k in range(len(found)):
            for sign in (1.0, -1.0):
                trial = state.copy()
                trial.q[k] += sign * h
                slope[k] -= sign * solver.loads.energy(control, solver.nodes(trial)) / (2.0 * h)
        np.testing.assert_allclose(found, slope, atol=1e-6 * np.abs(slope).max())


def test_sparse_loads_equal_dense_ones() -> None:
    """Gravity as forces of weight on every node gives what gravity gives; a force on held nodes gives nothing."""
    body = bar()
    solver = solver_of(body, 10)
    state = solver.solve_static(hanging(body, 5.0))
    nodes = solver.loads.mass[:, None] * np.array([0.0, -5.0, 0.0])
    nodes[solver.solid.held] = 0.0
    solver.nodes(state)
    np.testing.assert_allclose(
        solver.shape.project(nodes).copy(), solver.generalised_force(state, hanging(body, 5.0)), rtol=1e-12
    )
    control = Control.rest(body)
    control.force = np.where(body.pinned[:, None], 1.0, np.zeros((1, 3)))
    assert not solver.generalised_force(state, control).any()


@pytest.mark.parametrize("integrator", ["semi_implicit", "exact", "trapezoid"])
def test_one_mode_is_a_damped_oscillator(integrator: str) -> None:
    """Eq. 19 is backward Euler to round-off; "exact" follows the matrix exponential; "trapezoid" its equations."""
    k, c, h, f, q, v = 47.0, 3.0, 0.03, 2.0, 0.4, -1.1
    r = make_recurrence(integrator, np.array([k]), np.array([c]), h)
    q1, v1 = (float((a * q + b * v + g * f)[0]) for a, b, g in ((r.a, r.b, r.g), (r.c, r.d, r.e)))
    if integrator == "semi_implicit":
        expected = np.linalg.solve([[1.0, -h], [h * k, 1.0 + h * c]], [q, v + h * f])
    elif integrator == "exact":
        flow = expm(h * np.array([[0.0, 1.0, 0.0], [-k, -c, f], [0.0, 0.0, 0.0]]))
        expected = (flow @ [q, v, 1.0])[:2]
    else:
        a = np.array([[0.0, 1.0], [-k, -c]])
        left, right = np.eye(2) - 0.5 * h * a, np.eye(2) + 0.5 * h * a
        expected = np.linalg.solve(left, right @ [q, v] + [0.0, h * f])
    np.testing.assert_allclose([q1, v1], expected, rtol=1e-13)


def test_trapezoid_keeps_the_energy_of_a_free_swing() -> None:
    """Without damping or load the trapezoid rule loses none, at any step; Eq. 19 does."""
    body = bar()
    for integrator, kept in (("trapezoid", True), ("exact", True), ("semi_implicit", False)):
        solver = solver_of(body, 8, integrator=integrator)
        state, rest = solver.solve_static(hanging(body, 3.0)), Control.rest(body)
        first = solver.energy(state, rest).total
        for _ in range(50):
            solver.step(state, state, rest, 1 / 30)
        assert (abs(solver.energy(state, rest).total / first - 1.0) < 1e-9) == kept


def test_a_body_carried_by_one_bone_moves_rigidly() -> None:
    """A screw motion of the only bone moves the whole bar as it, to round-off, whatever its size; also past pi."""
    body = bar()
    for variant in ("warped", "consistent", "rotation_strain"):
        solver = solver_of(body, 6, variant)
        state, control = solver.rest(), Control.rest(body)
        for angle in (0.4, 1.5, 3.0, 4.0, 5.0):
            w, v = angle * np.array([0.48, 0.6, 0.64]), np.array([0.3, -0.2, 0.1]) * angle
            control.bone_pose[0, :3, :3], control.bone_pose[0, :3, 3] = rotation(w), mean_rotation(w) @ v
            state.twist = solver.twists(control.bone_pose, state)
            state.pose = control.bone_pose.copy()
            np.testing.assert_allclose(state.twist[0], np.concatenate([w, v]), atol=1e-9)
            expected = body.solid.mesh.points @ control.bone_pose[0, :3, :3].T + control.bone_pose[0, :3, 3]
            np.testing.assert_allclose(solver.nodes(state), expected, atol=1e-9)
            assert solver.energy(state, Control.rest(body)).elastic < 1e-6


def test_a_jaw_opens_wide_without_crushing_the_flesh() -> None:
    """With one end turned by 30 degrees no warped element loses 15 % of its volume; linear ones lose nearly all."""
    control = asked(0.0, 0.0)
    turn, hinge = rotation(np.array([0.0, 0.0, np.radians(30.0)])), np.array([10.0, 6.0, 6.0])
    control.bone_pose[1, :3, :3], control.bone_pose[1, :3, 3] = turn, hinge - turn @ hinge
    least = {}
    for variant in ("linear", "warped", "rotation_strain"):
        solver = solver_of(BODY, 20, variant)
        least[variant] = volume_ratios(solver, displaced(solver, solver.solve_static(control))).min()
    assert least["linear"] < 0.2 and least["warped"] > 0.85 and least["rotation_strain"] > 0.85


def test_a_shaken_support_excites_the_modes() -> None:
    """A bar whose support is accelerated steadily leans back as if gravity pulled the other way."""
    body = bar(stiffness_damping=0.3)
    solver = solver_of(body, 20, "linear")
    state, a, dt = solver.rest(), 0.2, 0.01
    control = Control.rest(body)
    leaned = solver.solve_static(hanging(body, a)).q
    for k in range(1, 1001):
        control.bone_pose[0, 1, 3] = 0.5 * a * (k * dt) ** 2
        solver.step(state, state, control, dt)
    np.testing.assert_allclose(state.q, leaned, atol=1e-3 * np.abs(leaned).max())


def test_twists_invert_poses_and_keep_turning() -> None:
    """The logarithm of a pose gives it back, on the branch nearest the last one."""
    near = np.zeros(6)
    for angle in np.linspace(0.0, 5.9, 40):
        w = angle * np.array([0.0, 0.6, 0.8])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation(w), (1.0, 2.0, 3.0)
        near = twist_of(pose, 0, near)
        np.testing.assert_allclose(near[:3], w, atol=1e-8)
        np.testing.assert_allclose(mean_rotation(near[:3]) @ near[3:], (1.0, 2.0, 3.0), atol=1e-10)


def test_no_hysteresis() -> None:
    """When the forces vanish the body comes back to its rest shape."""
    state, rest = (solver := solver_of(BODY, 20)).rest(), Control.rest(BODY)
    for k in range(400):
        solver.step(state, state, asked(0.8, 20.0, 800.0) if k < 30 else rest, STEP)
    np.testing.assert_allclose(surface(solver, state), BODY.surface.points, atol=1e-6)


def test_the_coriolis_term_is_the_one_that_was_dropped() -> None:
    """Footnote 2: R^T R' uL' of the kernel against differences of R in time; it changes a fast swing only slightly."""
    body = bar()
    with_it, without = (solver_of(body, 8, coriolis=c, integrator="exact") for c in (True, False))
    state = without.solve_static(hanging(body, 8.0))
    state.qd = 3.0 * state.q[::-1].copy()
    found = with_it._coriolis(state)
    h, phi, psi = 1e-6, without.modes.shapes(), without.modes.rotations()
    now, later, before = (rotation((psi @ (state.q + s * h * state.qd)).reshape(-1, 3)) for s in (0.0, 1.0, -1.0))
    spin = np.einsum("nji,njk->nik", now, (later - before) / (2.0 * h))
    drift = np.einsum("nij,nj->ni", spin, (phi @ state.qd).reshape(-1, 3))
    np.testing.assert_allclose(found, phi.T @ (without.modes.mass @ drift.ravel()), rtol=1e-6, atol=1e-7)
    a, b = state.copy(), state.copy()
    with_it.step(a, a, Control.rest(body), 0.01)
    without.step(b, b, Control.rest(body), 0.01)
    assert 0.0 < np.abs(a.q - b.q).max() < 0.05 * np.abs(b.q).max()


@pytest.mark.parametrize("variant", ["warped", "linear"])
def test_single_precision_shows_the_same_surface(variant: str) -> None:
    """Blocks of float32 put every vertex within 1e-5 of the body's size of where float64 does, jaw and all."""
    double = solver_of(BODY, 20, variant)
    single = solver_of(BODY, 20, variant, precision="single")
    state = double.solve_static(asked(0.5, 15.0, 500.0))
    np.testing.assert_allclose(surface(single, state), surface(double, state), atol=40.0 * 1e-6)


def test_many_vertices_two_ways() -> None:
    """Vertices within the body: by nodes it is the mean of warped nodes; by their own modes it is near, exact at nodes."""
    solver = solver_of(BODY, 20)
    state = solver.solve_static(asked(0.5, 15.0, 500.0))
    points = np.random.default_rng(0).uniform((0.5, 0.5, 0.5), (39.5, 11.5, 11.5), (500, 3))
    skin = embed(BODY.solid.mesh, points)
    by_node, exact = np.zeros((500, 3), np.float32), skin.apply(solver.nodes(state))
    for threads in (1, 2):
        SkinWarp(solver, skin, threads=threads).points(state, by_node)
        np.testing.assert_allclose(by_node, exact, atol=1e-4)
    own = vertex_warp(solver, skin).points(amplitudes(state))
    assert 1e-6 < np.abs(own - exact).max() < 0.3
    both = Embedding(
        np.concatenate([skin.node, skin.node[::-1]], 1), 0.5 * np.concatenate([skin.weight, skin.weight[::-1]], 1)
    )
    SkinWarp(solver, both).points(state, by_node)  # some vertices are carried by eight nodes
    np.testing.assert_allclose(by_node, both.apply(solver.nodes(state)), atol=1e-4)


def test_a_far_rotation_is_noted_and_a_runaway_is_an_error() -> None:
    """A node that has turned by 1.9 pi is worth a notice; amplitudes beyond all measure raise, naming the time."""
    body = bar()
    solver = solver_of(body, 6)
    state, control = solver.rest(), Control.rest(body)
    state.q[1] = 2.0 * np.pi / np.abs(solver.modes.rotations()[:, 1]).max()
    solver.step(state, state, control, 1e-4)
    assert any("full turn" in text for text in solver.notices)
    state.q[:] = 1e9
    with pytest.raises(DivergenceError, match=r"t = 0\.5 s"):
        solver.step(state, state, control, 0.5 - state.t)


def test_an_equilibrium_that_is_not_found_is_reported() -> None:
    """With too few evaluations the report says so, and a notice names the way out."""
    body = bar()
    solver = solver_of(body, 20, static_most=3)
    solver.solve_static(hanging(body, 60.0))
    assert not solver.static_report.converged and solver.static_report.residual > 1e-8
    assert "consistent" in solver.notices[0]


def test_a_guess_starts_the_search() -> None:
    """From the answer the search ends at once."""
    body = bar()
    solver = solver_of(body, 20)
    state = solver.solve_static(hanging(body, 5.0))
    first = solver.static_report.iterations
    again = solver.solve_static(hanging(body, 5.0), state)
    np.testing.assert_allclose(again.q, state.q, rtol=1e-6, atol=1e-9)
    assert solver.static_report.iterations < first
    assert displaced(solver, again)[node_at(body, 1.0, 0.1, 0.1), 1] < -0.3


def test_long_steps_are_stable_under_a_muscle_near_its_point() -> None:
    """A pull that stiffens as its point comes near ends where statics say, at steps of a thirtieth of a second too."""
    body = jawed_bar(damping=2000.0)
    control = Control.rest(body)
    control.activation[:] = 1.0
    for variant in ("rotation_strain", "consistent", "linear"):
        solver = solver_of(body, 12, variant)
        expected, found = body.surface.points.copy(), body.surface.points.copy()
        solver.surface(solver.solve_static(control), expected)
        state = solver.rest()
        for _ in range(150):
            solver.step(state, state, control, 1.0 / 30.0)
        solver.surface(state, found)
        np.testing.assert_allclose(found, expected, atol=0.02)
