"""Finite elements in motion: modes of a bar, numerical damping, order in time, momentum, Rayleigh damping."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import eigsh

from faceanim.backends.finite_elements.options import Options
from faceanim.backends.finite_elements.solver import SolverFiniteElements
from faceanim.backends.pulls import Quadratic
from faceanim.body.control import Control
from faceanim.body.solid import solid_body
from faceanim.elements.newton import newton
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.shapes import box_tets
from faceanim.tissue.material import Material


def bar(material: Material, **changes: Any) -> Any:
    """Return a bar of 10 x 2 x 2 mm held at x = 0."""
    mesh = box_tets((5, 1, 1), (10.0, 2.0, 2.0))
    return solid_body(mesh, material, mesh.points[:, 0] < 1e-9, **changes)


def modes(solver: SolverFiniteElements, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest angular frequencies [1/s] and shapes (3n, count) of a held body, shapes of unit mass."""
    free = np.flatnonzero(solver.free.ravel())
    stiffness = solver.elements.tangent(solver.elements.points)[free][:, free].tocsc()
    values, vectors = eigsh(stiffness, count, M=solver.mass[free][:, free].tocsc(), sigma=0.0)
    shapes = np.zeros((solver.elements.size, count))
    shapes[free] = vectors
    return np.sqrt(values), shapes


def test_cantilever_modes() -> None:
    """beta L = 1.875104, 4.694091, 7.854757 of a slender bar within 0.3 %; every mode twice, once a side."""
    side, young, density = 0.02, 1e5, 1.0
    elements = Elements(box_tets((30, 1, 1), (1.0, side, side)), Material("m", density, young, 0.0), order=2)
    free = np.flatnonzero(np.repeat(elements.points[:, 0] > 1e-9, 3))
    stiffness, mass = (m[free][:, free].tocsc() for m in (elements.tangent(elements.points), elements.mass))
    omega = np.sqrt(np.sort(eigsh(stiffness, 6, M=mass, sigma=0.0)[0]))
    beta = (omega**2 * density * side**2 / (young * side**4 / 12.0)) ** 0.25
    np.testing.assert_allclose(beta, np.repeat([1.875104, 4.694091, 7.854757], 2), rtol=3e-3)


@pytest.mark.parametrize("product", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("integrator", ["backward_euler", "trapezoid"])
def test_one_linear_mode(integrator: str, product: float) -> None:
    """A step multiplies the amplitude by 1 / sqrt(1 + (w h)^2) (backward Euler) or by 1 (trapezoid)."""
    body = bar(Material("m", 1e-6, 10.0, 0.3))
    solver = SolverFiniteElements(body, Options(law="linear", integrator=integrator))
    omega, shapes = modes(solver, 3)
    state, rest = solver.rest(), Control.rest(body)
    state.q += 1e-3 * shapes[:, 2].reshape(-1, 3) / np.abs(shapes[:, 2]).max()
    before = solver.energy(state, rest).total
    for steps in range(1, 4):
        solver.step(state, state, rest, product / float(omega[2]))
        ratio = np.sqrt(solver.energy(state, rest).total / before)
        expected = 1.0 if integrator == "trapezoid" else (1.0 + product**2) ** (-0.5 * steps)
        assert ratio == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("integrator", "order"), [("backward_euler", 1.0), ("trapezoid", 2.0)])
def test_order_in_time(integrator: str, order: float) -> None:
    """Let go from where gravity bends it, the error at one time halves, or quarters, with half the step."""
    body = bar(Material("m", 1e-6, 10.0, 0.3), damping=5.0, stiffness_damping=3e-3)
    solver = SolverFiniteElements(body, Options(integrator=integrator))
    hanging, rest = Control.rest(body), Control.rest(body)
    hanging.gravity[:] = [0.0, -9810.0, 0.0]
    start = solver.solve_static(hanging)
    assert np.abs(start.q - solver.elements.points).max() > 1.0
    ends = []
    for steps in (32, 64, 128):
        state = start.copy()
        for _ in range(steps):
            solver.step(state, state, rest, 0.015 / steps)
        ends.append(state.q)
    away = [np.abs(a - b).max() for a, b in pairwise(ends)]
    assert np.log2(away[0] / away[1]) == pytest.approx(order, abs=0.15)


def test_rayleigh_damping() -> None:
    """A mode under drag xi M and zeta K decays as exp(-(xi + zeta w^2) t / 2)."""
    body = bar(Material("m", 1e-6, 10.0, 0.3), damping=15.0, stiffness_damping=2e-4)
    solver = SolverFiniteElements(body, Options(law="linear", integrator="trapezoid"))
    omega, shapes = modes(solver, 1)
    w = float(omega[0])
    rate = 0.5 * (15.0 + 2e-4 * w**2)
    state = solver.rest()
    shape = shapes[:, 0].reshape(-1, 3) / np.abs(shapes[:, 0]).max()
    state.q += 1e-3 * shape
    state.qd -= rate * 1e-3 * shape  # on the decaying cosine
    turning = np.sqrt(w**2 - rate**2)
    steps = 200
    for _ in range(steps):
        solver.step(state, state, Control.rest(body), 2.0 * np.pi / turning / steps)
    found = float(((state.q - solver.elements.points) * shape).sum() / (1e-3 * (shape**2).sum()))
    assert found == pytest.approx(np.exp(-rate * 2.0 * np.pi / turning), rel=3e-3)


def test_free_flight_keeps_momentum() -> None:
    """A spinning, wobbling body that nothing holds: linear momentum and the centre's straight path are exact."""
    elements = Elements(box_tets((3, 1, 1), (3.0, 1.0, 1.0)), Material("m", 1e-3, 5.0, 0.3), order=2)
    rng = np.random.default_rng(3)
    x = elements.points + 0.03 * rng.standard_normal(elements.points.shape)
    v = np.cross([0.0, 2.0, 1.0], x - x.mean(axis=0)) + [1.0, -2.0, 0.5] + 0.2 * rng.standard_normal(x.shape)
    h = 0.05
    inertia: sparse.csr_matrix = elements.mass / h**2
    whole = elements.gravity_mass.sum()

    def momentum(rate: np.ndarray) -> np.ndarray:
        return (elements.mass @ rate.ravel()).reshape(-1, 3).sum(axis=0)

    first, centre = momentum(v), momentum(x) / whole
    nothing = np.zeros(len(x), dtype=bool)
    for step in range(1, 11):
        moved, report = newton(
            elements, fixed=nothing, start=x, values=x, terms=[Quadratic(inertia, x + h * v)], tolerance=1e-12
        )
        assert report.converged
        v, x = (moved - x) / h, moved
        np.testing.assert_allclose(momentum(v), first, atol=1e-10 * np.abs(first).max())
        np.testing.assert_allclose(momentum(x) / whole, centre + step * h * first / whole, atol=1e-11)


@pytest.mark.parametrize("integrator", ["backward_euler", "trapezoid"])
def test_free_fall_of_what_is_held_far_away(integrator: str) -> None:
    """Under gravity the unheld end first falls as g t^2 / 2: before waves from the root arrive, flesh is in free fall."""
    mesh = box_tets((40, 1, 1), (40.0, 1.0, 1.0))
    body = solid_body(mesh, Material("m", 1e-6, 1e-4, 0.3), mesh.points[:, 0] < 1e-9)
    solver = SolverFiniteElements(body, Options(integrator=integrator))
    control = Control.rest(body)
    control.gravity[:] = [0.0, -100.0, 0.0]
    state, h, steps = solver.rest(), 0.005, 20
    for _ in range(steps):
        solver.step(state, state, control, h)
    t = steps * h
    expected = 0.5 * 100.0 * t * (t + h) if integrator == "backward_euler" else 0.5 * 100.0 * t**2
    tip = (state.q - solver.elements.points)[mesh.points[:, 0] > 39.9]
    np.testing.assert_allclose(tip, np.tile([0.0, -expected, 0.0], (len(tip), 1)), atol=1e-6 * expected)
