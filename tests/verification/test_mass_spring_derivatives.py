"""Every force is the downhill gradient of its energy, and every tangent the derivative of its force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from bodies import control, crumpled, free_sheet, held_sheet, two_lips

from faceanim.backends.mass_spring.build import Tables
from faceanim.backends.mass_spring.load import Load
from faceanim.backends.mass_spring.solver import SolverMassSpring
from faceanim.backends.solver import Energy
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.kernels import contact, tangent
from faceanim.tissue.spring_law import SpringLaw

LAWS = [
    SpringLaw(),
    SpringLaw(alpha=0.0, beta=1.0),
    SpringLaw(alpha=1.7, s0=0.6, beta=2.5, zeta=1.0),
    SpringLaw(alpha=2.0, beta=3.0, uniform_k0=2.0),
]


def assert_downhill(body: Body, control: Control, x: np.ndarray, part: Callable[[Energy], float]) -> None:
    """Assert that forces equal minus the central difference of the energy along random directions."""
    solver = SolverMassSpring(body)
    state = solver.rest()
    state.q[:] = x
    force = solver.forces(state, control)
    rng = np.random.default_rng(5)
    for _ in range(4):
        direction = rng.standard_normal(x.shape)
        step = 1e-6
        energies = []
        for sign in (1.0, -1.0):
            state.q[:] = x + sign * step * direction
            energies.append(part(solver.energy(state, control)))
        slope = (energies[0] - energies[1]) / (2.0 * step)
        assert slope == pytest.approx(-(force * direction).sum(), rel=2e-5, abs=1e-4)


@pytest.mark.parametrize("law", LAWS)
def test_spring_forces_are_the_gradient_of_their_energy(law: SpringLaw) -> None:
    """Structural and repulsion springs of every nonlinearity, on a crumpled sheet."""
    body = free_sheet(law=law)
    assert_downhill(body, Control.rest(body), crumpled(body, 0.3), lambda e: e.elastic)


@pytest.mark.parametrize("alpha", [0.0, 1.0, 1.4])
def test_attachment_forces_are_the_gradient_of_their_energy(alpha: float) -> None:
    """Tethers to a jaw that has moved, with springs at vanishing stiffness."""
    body = held_sheet(colliders=False)
    body = replace(
        body, attachment=replace(body.attachment, alpha=alpha, s0=2.0), membrane_modulus=body.membrane_modulus * 1e-9
    )
    case = control(body, jaw=8.0)
    assert SolverMassSpring(body).energy(SolverMassSpring(body).rest(), case).attachment > 1.0
    assert_downhill(body, case, crumpled(body, 0.3), lambda e: e.total)


def test_muscle_forces_are_the_gradient_of_their_energy() -> None:
    """Pulls to a point and along a direction, all at different activations."""
    body = held_sheet(colliders=False)
    body = replace(
        body,
        attachment=replace(body.attachment, stiffness=0.0 * body.attachment.stiffness, shear=None),
        membrane_modulus=body.membrane_modulus * 1e-9,
    )
    assert_downhill(body, control(body, [0.3, 0.7, 1.0]), crumpled(body, 0.3), lambda e: e.muscle)


def test_bone_and_eyeball_contact_forces_are_the_gradient_of_their_energy() -> None:
    """Pushed 3 mm into ball and eyeball, away from the kinks of the trilinear grid, the whole energy still agrees."""
    body = held_sheet()
    x = crumpled(body, 0.05) - [0.0, 0.0, 3.0]
    solver = SolverMassSpring(body)
    state = solver.rest()
    state.q[:] = x
    assert solver.energy(state, Control.rest(body)).contact > 10.0
    assert_downhill(body, Control.rest(body), x, lambda e: e.total)


def test_lip_contact_forces_are_the_gradient_of_their_energy() -> None:
    """Two sheets pressed into each other: exact for the half spaces that a step holds fixed."""
    body = two_lips()
    load = Load(Tables(body).patch(np.arange(len(body.mass), dtype=np.int32)))
    load.apply(Control.rest(body))
    x = crumpled(body, 0.02)
    x[: len(x) // 2, 2] -= 1.9
    x = np.ascontiguousarray(x[load.patch.nodes])
    load.touch(x, 1.0)
    assert load.energy(x).contact > 1.0
    force = load.forces(x)[:, :3].copy()
    rng = np.random.default_rng(5)
    for _ in range(4):
        direction = rng.standard_normal(x.shape)
        up, down = (load.energy(np.ascontiguousarray(x + s * 1e-6 * direction)).total for s in (1.0, -1.0))
        assert (up - down) / 2e-6 == pytest.approx(-(force * direction).sum(), rel=2e-5, abs=1e-4)


def dense(load: Load, exact: int) -> np.ndarray:
    """Return the assembled spring matrix of a patch at its positions, (3 m, 3 m)."""
    patch = load.patch
    n, e = len(patch.nodes), len(patch.pairs)
    diagonal, coupling = np.zeros((n, 6)), np.zeros((e, 9))
    tangent.spring_matrix(load.x, patch.scene.springs, patch.scene.law, patch.edge_of, exact, diagonal, coupling)
    columns, none = [], np.zeros(len(load.moment.planes.offset))
    for k in range(3 * patch.m):
        v, out = np.zeros((n, 3)), np.zeros((n, 3))
        v.ravel()[k] = 1.0
        tangent.matrix_product(diagonal, coupling, patch.pairs, patch.m, patch.n_pair, load.moment.planes, none, v, out)
        columns.append(out[: patch.m].ravel())
    return np.array(columns).T


def crumpled_load(law: SpringLaw, amount: float) -> Load:
    """Return a free sheet's patch at crumpled positions."""
    body = free_sheet(law=law)
    load = Load(Tables(body).patch(np.arange(len(body.mass), dtype=np.int32)))
    load.apply(Control.rest(body))
    load.x[:] = crumpled(body, amount)[load.patch.nodes]
    return load


@pytest.mark.parametrize("law", LAWS)
def test_the_exact_matrix_is_the_derivative_of_the_force(law: SpringLaw) -> None:
    """Matrix times direction equals the central difference of the forces."""
    load = crumpled_load(law, 0.3)
    matrix, x = dense(load, 1), load.x.copy()
    direction = np.random.default_rng(2).standard_normal(x.shape)
    forward = load.forces(x + 1e-6 * direction)[:, :3].copy()
    backward = load.forces(x - 1e-6 * direction)[:, :3].copy()
    expected = -(forward - backward).ravel() / 2e-6
    np.testing.assert_allclose(matrix @ direction.ravel(), expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())


@pytest.mark.parametrize("law", LAWS)
def test_the_projected_matrix_is_positive_and_bounded_by_its_blocks(law: SpringLaw) -> None:
    """No negative eigenvalue, and twice the Jacobi blocks exceed it: the condition for sweeps to converge."""
    load = crumpled_load(law, 0.3)
    matrix = dense(load, 0)
    size = np.abs(matrix).max()
    assert np.linalg.eigvalsh(matrix).min() > -1e-9 * size
    block = np.zeros((len(load.x), 6))
    tangent.spring_blocks(load.x, load.patch.scene.springs, load.patch.scene.law, 1, block)
    bound = np.zeros_like(matrix)
    for i, (xx, xy, xz, yy, yz, zz) in enumerate(block):
        bound[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    assert np.linalg.eigvalsh(2.0 * bound - matrix).min() > -1e-9 * size
    tangent.spring_blocks(load.x, load.patch.scene.springs, load.patch.scene.law, 0, block)
    own = matrix[np.arange(len(matrix)), np.arange(len(matrix))].reshape(-1, 3)
    np.testing.assert_allclose(block[:, [0, 3, 5]], own, rtol=1e-9)


def test_the_stiffness_bound_exceeds_the_exact_matrix() -> None:
    """2 k - H is positive semidefinite for the k that the forces carry, on a crumpled sheet."""
    load = crumpled_load(SpringLaw(), 0.3)
    matrix = dense(load, 1)
    k = np.repeat(load.forces(load.x)[:, 3], 3)
    assert np.linalg.eigvalsh(2.0 * np.diag(k) - matrix).min() > -1e-9 * np.abs(matrix).max()


def test_the_grid_gradient_is_the_derivative_of_its_value() -> None:
    """Trilinear value and gradient agree inside a cell, and the value is that of `DistanceGrid.sample`."""
    body = held_sheet()
    grids, grid = Tables(body).grids, body.bones[0].grid
    assert grid is not None
    for point in np.random.default_rng(1).uniform(-8.0, 8.0, (20, 3)):
        value, *gradient = contact.sample_grid(grids, 0, *point)
        assert value == pytest.approx(grid.sample(point[None])[0], abs=1e-5)
        for d in range(3):
            moved = point.copy()
            moved[d] += 1e-6
            assert (contact.sample_grid(grids, 0, *moved)[0] - value) / 1e-6 == pytest.approx(gradient[d], abs=1e-4)


def test_the_nearest_point_of_a_triangle_beats_all_others() -> None:
    """The distance found is the smallest over a fine sampling of the triangle, from any side."""
    rng = np.random.default_rng(4)
    u, v = np.meshgrid(np.linspace(0, 1, 41), np.linspace(0, 1, 41))
    u, v = u[u + v <= 1.0 + 1e-12], v[u + v <= 1.0 + 1e-12]
    for _ in range(50):
        x = rng.standard_normal((4, 3))
        distance, wa, wb, wc = contact.closest_on_triangle(x, 0, 1, 2, 3)
        samples = x[1] + np.outer(u, x[2] - x[1]) + np.outer(v, x[3] - x[1])
        best = ((samples - x[0]) ** 2).sum(axis=1).min()
        assert wa + wb + wc == pytest.approx(1.0)
        assert min(wa, wb, wc) > -1e-12
        assert distance == pytest.approx(((wa * x[1] + wb * x[2] + wc * x[3] - x[0]) ** 2).sum(), abs=1e-12)
        assert distance <= best + 1e-12 and np.sqrt(best) - np.sqrt(distance) < 0.1
