"""The conjugate gradient scheme: its forces, its preconditioner, and the half that stands for a symmetric whole."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import control, crumpled, held_sheet
from scipy import sparse
from scipy.sparse.linalg import eigsh, spsolve

from faceanim.backends.mass_spring import kernels, preconditioner
from faceanim.backends.mass_spring.build import Tables
from faceanim.backends.mass_spring.load import Load
from faceanim.backends.mass_spring.options import Options
from faceanim.backends.mass_spring.solver import SolverMassSpring
from faceanim.backends.mass_spring.symmetry import find_symmetry
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.face.library import load_face
from faceanim.kernels.attachment import find_shift
from faceanim.kernels.triangular import solve_factored


def free_load(body: Body) -> Load:
    """Return the work space of all free vertices at rest."""
    load = Load(Tables(body).patch(np.flatnonzero(~body.pinned).astype(np.int32)))
    load.rest()
    return load


def test_the_inner_loop_computes_the_same_forces() -> None:
    """Springs, shear layer, tethers, muscles and contacts by triangles and by vertices agree."""
    body = held_sheet(force=2000.0)
    load = free_load(body)
    load.apply(control(body, [0.3, 0.7, 1.0]))
    x = np.ascontiguousarray(crumpled(body, 0.2)[load.patch.nodes])
    load.touch(x, 1.0)
    wanted = load.forces(x)[: load.patch.m, :3].copy()
    n, m = len(x), load.patch.m
    residual, centre, weight = np.zeros((m, 3)), np.zeros((n, 3)), np.zeros(n)
    find_shift(x, load.moment.anchor, load.moment.shift)
    kernels.residual_force(x, load.patch.scene, load.moment, load.scratch, weight, centre, load.force, residual)
    np.testing.assert_allclose(residual, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


def test_an_unthinned_factor_solves_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    """L L^T z = r for three right-hand sides, in whatever order of elimination."""
    monkeypatch.setattr(preconditioner, "DROPPED", 0.0)
    monkeypatch.setattr(preconditioner, "SOFTEST", 0.0)
    load = free_load(held_sheet())
    a = preconditioner.scalar_stiffness(load)
    m = load.patch.m
    weight = np.linspace(1.0, 2.0, m)
    order = preconditioner.elimination_order(a, load.patch.scene.tethers.rest[:m])
    assert np.array_equal(np.sort(order), np.arange(m))
    factor = preconditioner.incomplete_factor(a, order, weight, np.ones(m))
    r, z = np.random.default_rng(3).standard_normal((m, 3)), np.zeros((m, 3))
    solve_factored(factor, r, np.zeros((m, 4)), z)
    np.testing.assert_allclose((a + sparse.diags(weight)) @ z, r, atol=1e-9)
    np.testing.assert_allclose(z, spsolve((a + sparse.diags(weight)).tocsc(), r), rtol=1e-7, atol=1e-12)


def test_a_thinned_factor_still_conditions_the_matrix() -> None:
    """Eigenvalues of the preconditioned matrix stay within a factor of two of 1."""
    load = free_load(held_sheet(20, 20))
    a, m = preconditioner.scalar_stiffness(load), load.patch.m
    factor = preconditioner.incomplete_factor(a, np.arange(m, dtype=np.int32), np.zeros(m), np.ones(m))
    lower = sparse.csr_matrix((factor.lower, factor.lower_column, factor.lower_start), shape=(m, m))
    lower = (lower + sparse.diags(1.0 / factor.inverse_diagonal)).tocsc()
    product = (lower @ lower.T).tocsc()
    high = eigsh(a.tocsc(), k=1, M=product, which="LA", return_eigenvectors=False)[0]
    low = 1.0 / eigsh(product, k=1, M=a.tocsc(), which="LA", return_eigenvectors=False)[0]
    assert 0.5 < low < high < 2.0
    assert len(factor.lower) < 12 * m


@pytest.fixture(scope="module")
def head() -> Body:
    """The coarse face."""
    return load_face(density="coarse").body()


def smile(head: Body, left: float, right: float) -> Control:
    """Return a control that pulls the mouth corners, each by its own muscle."""
    case = Control.rest(head)
    names = head.muscles.names
    case.activation[names.index("zygomaticus_major_left")] = left
    case.activation[names.index("zygomaticus_major_right")] = right
    return case


def test_one_half_stands_for_a_symmetric_whole(head: Body) -> None:
    """A symmetric smile on one half is that of the whole face, and symmetric to the bit."""
    symmetry = find_symmetry(head)
    assert symmetry is not None
    results = []
    for symmetric in (True, False):
        solver = SolverMassSpring(head, Options(symmetric=symmetric, iterations=40, iteration_tolerance=1e-5))
        state = solver.rest()
        for k in range(6):
            solver.step(state, state, smile(head, k / 5, k / 5), 1 / 30)
        results.append(state.q)
    assert np.linalg.norm(results[0] - head.surface.points, axis=1).max() > 2.0
    np.testing.assert_allclose(results[0], results[1], atol=2e-3)
    assert np.abs(results[0] - results[0][symmetry.vertex] * [-1.0, 1.0, 1.0]).max() == 0.0


def test_a_crooked_smile_is_not_made_symmetric(head: Body) -> None:
    """One muscle alone moves one side; a symmetric command after it does not lose the other side's place."""
    solver = SolverMassSpring(head)
    state = solver.rest()
    for _ in range(4):
        solver.step(state, state, smile(head, 1.0, 0.0), 1 / 30)
    moved = np.linalg.norm(state.q - head.surface.points, axis=1)
    left = head.surface.points[:, 0] > 0.0
    assert moved[left].max() > 3.0 * moved[~left].max()
    before = state.q.copy()
    solver.step(state, state, smile(head, 1.0, 1.0), 1e-4)
    assert np.abs(state.q - before).max() < 0.1


def test_a_lopsided_body_has_no_symmetry() -> None:
    """A sheet with an eyeball behind one side only is worked on as a whole."""
    assert find_symmetry(held_sheet()) is None
