"""Momentum, rest, rigid motion and mirror symmetry of the mass-spring skin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import control, crumpled, free_sheet, held_sheet, turned, two_lips

from faceanim.backends.mass_spring.options import SCHEMES, Options
from faceanim.backends.mass_spring.solver import SolverMassSpring
from faceanim.body.control import Control
from faceanim.tissue.spring_law import SpringLaw


def resultant(x: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return sum of forces, sum of torques about the origin, and the sum of the forces' sizes."""
    return force.sum(axis=0), np.cross(x, force).sum(axis=0), float(np.abs(force).sum())


@pytest.mark.parametrize("beta", [1.0, 2.0, 2.5])
def test_with_reaction_springs_conserve_momentum(beta: float) -> None:
    """Forces and torques of a free, crumpled sheet sum to zero to round-off; those of the paper's form do not."""
    body = free_sheet(law=SpringLaw(beta=beta))
    solver = SolverMassSpring(body)
    state = solver.rest()
    state.q[:] = crumpled(body, 0.3)
    total, torque, size = resultant(state.q, solver.forces(state, Control.rest(body)))
    assert np.abs(total).max() < 1e-12 * size
    assert np.abs(torque).max() < 1e-11 * size
    paper = SolverMassSpring(replace(body, law=SpringLaw(beta=beta, reaction=False)))
    total, _, size = resultant(state.q, paper.forces(state, Control.rest(body)))
    assert np.abs(total).max() > 1e-4 * size


def test_lips_that_press_on_each_other_conserve_momentum() -> None:
    """The contact force on a vertex comes back on the triangle's corners; torques too, for it acts where it pushes."""
    body = two_lips()
    body = replace(body, attachment=replace(body.attachment, stiffness=0.0 * body.attachment.stiffness))
    solver = SolverMassSpring(body)
    state = solver.rest()
    state.q[: len(state.q) // 2, 2] -= 1.9
    force = solver.forces(state, Control.rest(body))
    total, torque, size = resultant(state.q, force)
    assert size > 1.0
    assert np.abs(total).max() < 1e-12 * size
    assert np.abs(torque).max() < 1e-10 * size


@pytest.mark.parametrize("scheme", SCHEMES)
def test_rest_stays_at_rest(scheme: str) -> None:
    """Without activation nothing moves, by no scheme (the paper's amplifies round-off at large steps)."""
    body = held_sheet()
    solver = SolverMassSpring(body, Options(scheme=scheme))
    state = solver.rest()
    for _ in range(5):
        solver.step(state, state, Control.rest(body), 1e-4 if scheme == "paper" else 1 / 60)
    np.testing.assert_allclose(state.q, body.surface.points, atol=1e-9)
    np.testing.assert_allclose(solver.solve_static(Control.rest(body)).q, body.surface.points, atol=1e-9)


def test_rigid_motion_of_bones_and_skin_gives_no_force() -> None:
    """Carry every bone and the skin by one rigid motion: springs, tethers and bone contact feel nothing."""
    body = replace(held_sheet(), spheres=())
    solver = SolverMassSpring(body)
    moved = Control.rest(body)
    pose = turned(25.0, (3.0, -10.0, 5.0))
    pose[:3, 3] += [1.0, -2.0, 3.0]
    moved.bone_pose[:] = pose
    state = solver.rest()
    state.q[:] = body.surface.points @ pose[:3, :3].T + pose[:3, 3]
    assert np.abs(solver.forces(state, moved)).max() < 1e-8
    np.testing.assert_allclose(solver.solve_static(moved).q, state.q, atol=1e-7)


@pytest.mark.parametrize("scheme", ["conjugate_gradient", "block_descent", "semi_implicit", "newton"])
def test_symmetric_activation_gives_a_symmetric_face(scheme: str) -> None:
    """A sheet that is its own mirror image, pulled alike on both sides, stays so to round-off."""
    body = replace(held_sheet(), spheres=())
    x = body.surface.points
    twin = np.array([np.flatnonzero((x == p).all(axis=1))[0] for p in x * [-1.0, 1.0, 1.0]])
    case = control(body, 0.4, jaw=5.0)
    solver = SolverMassSpring(body, Options(scheme=scheme))
    state = solver.rest()
    for _ in range(6):
        solver.step(state, state, case, 1 / 60)
    assert np.linalg.norm(state.q - x, axis=1).max() > 0.5
    np.testing.assert_allclose(state.q[twin] * [-1.0, 1.0, 1.0], state.q, atol=1e-6 if scheme == "newton" else 1e-9)
