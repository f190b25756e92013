"""The adaptive partition: what it leaves out costs less accuracy than asked for, and it is remembered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies import control, held_sheet, two_muscles, zone

from faceanim.backends.mass_spring import partition
from faceanim.backends.mass_spring.options import QUASI_STATIC, Options
from faceanim.backends.mass_spring.solver import SolverMassSpring
from faceanim.body.body import Body
from faceanim.ground import cache


@pytest.fixture(autouse=True)
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Keep partitions of tests out of the user's cache (and of each other's)."""
    monkeypatch.setattr(cache, "user_cache", lambda: tmp_path)


def wide_sheet() -> Body:
    """Return a firmly held sheet in which one muscle moves only its own neighbourhood."""
    body = held_sheet(20, 20, colliders=False, force=60.0)
    return replace(body, attachment=replace(body.attachment, stiffness=4.0 * body.attachment.stiffness))


def test_every_vertex_is_in_one_set_and_the_zone_is_dynamic() -> None:
    """N_d + N_q + N_s = n; the acting muscle's zone is V_d; waves start at 1 beside it."""
    body = wide_sheet()
    solver = SolverMassSpring(body, Options(adaptive=True, tolerance=0.02))
    found = solver.prepare(control(body, [1.0, 0.0, 0.0]))
    assert found is not None
    assert found.n_dynamic + found.n_quasi_static + found.n_static == len(body.mass)
    assert min(found.n_dynamic, found.n_quasi_static, found.n_static) > 0
    node, weight = zone(body.surface.points, (9.0, -4.0), 7.0, ~body.pinned)
    strong = weight / body.surface.vertex_areas[node]
    assert (found.node_set[node[strong > partition.FAINT * strong.max()]] == partition.DYNAMIC).all()
    assert (found.wave[found.node_set == partition.QUASI_STATIC] >= 1).all()
    assert two_muscles(body.surface.points, ~body.pinned, 1.0).names == body.muscles.names


def test_the_partition_error_is_below_the_tolerance() -> None:
    """Equilibria with V_s frozen stay within the tolerance of the full ones; a finer tolerance freezes fewer."""
    body = wide_sheet()
    peak = control(body, [1.0, 0.0, 0.0])
    full = SolverMassSpring(body).solve_static(peak).q
    static = []
    for tolerance in (0.1, 0.01):
        solver = SolverMassSpring(body, Options(adaptive=True, tolerance=tolerance, sweep_tolerance=1e-7))
        found = solver.prepare(peak)
        assert found is not None and found.error_max <= tolerance and found.error_rms <= found.error_max
        static.append(found.n_static)
        state = solver.rest()
        for _ in range(240):
            solver.step(state, state, peak, 1 / 60)
        assert np.linalg.norm(state.q - full, axis=1).max() < 1.2 * tolerance + 2e-3
    assert static[0] > static[1]


@pytest.mark.parametrize("quasi_static", QUASI_STATIC)
def test_every_treatment_of_the_rest_reaches_the_same_equilibrium(quasi_static: str) -> None:
    """Integrated, accelerated or in waves: all settle where the full solution is."""
    body = wide_sheet()
    peak = control(body, [0.8, 0.0, 0.0])
    full = SolverMassSpring(body).solve_static(peak).q
    solver = SolverMassSpring(
        body, Options(adaptive=True, tolerance=0.02, quasi_static=quasi_static, passes=6, sweep_tolerance=1e-7)
    )
    state = solver.rest()
    for _ in range(400):
        solver.step(state, state, peak, 1 / 60)
    assert np.linalg.norm(state.q - full, axis=1).max() < 0.03


def test_static_vertices_are_never_touched() -> None:
    """V_s keeps its exact positions."""
    body = wide_sheet()
    solver = SolverMassSpring(body, Options(adaptive=True, tolerance=0.1))
    state = solver.rest()
    for _ in range(10):
        solver.step(state, state, control(body, [1.0, 0.0, 0.0]), 1 / 60)
    assert solver.partition is not None
    static = (solver.partition.node_set == partition.STATIC) & ~body.pinned
    assert (state.q[static] == body.surface.points[static]).all()


def test_a_new_muscle_or_bone_makes_a_new_partition() -> None:
    """The set of acting muscles decides: a subset keeps the partition, anything new recomputes it."""
    body = wide_sheet()
    solver = SolverMassSpring(body, Options(adaptive=True, tolerance=0.05))
    state = solver.rest()
    solver.step(state, state, control(body, [0.5, 0.0, 0.0]), 1 / 60)
    first = solver.partition
    solver.step(state, state, control(body, 0.0), 1 / 60)
    assert solver.partition is first
    solver.step(state, state, control(body, [0.5, 0.5, 0.0]), 1 / 60)
    second = solver.partition
    assert second is not first and second is not None and second.muscles.tolist() == [True, True, False]
    solver.step(state, state, control(body, [0.5, 0.5, 0.0], jaw=2.0), 1 / 60)
    assert solver.partition is not None and solver.partition.bones.tolist() == [False, True]


def test_what_an_abandoned_muscle_moved_still_comes_back() -> None:
    """After a switch from one muscle to another, the first one's skin returns to rest instead of freezing."""
    body = wide_sheet()
    solver = SolverMassSpring(body, Options(adaptive=True, tolerance=0.05))
    state = solver.rest()
    for _ in range(30):
        solver.step(state, state, control(body, [1.0, 0.0, 0.0]), 1 / 60)
    node, _ = zone(body.surface.points, (9.0, -4.0), 7.0, ~body.pinned)
    assert np.abs(state.q[node] - body.surface.points[node]).max() > 0.05
    for _ in range(240):
        solver.step(state, state, control(body, [0.0, 0.0, 1.0]), 1 / 60)
    expected = SolverMassSpring(body).solve_static(control(body, [0.0, 0.0, 1.0])).q
    assert np.abs(state.q[node] - expected[node]).max() < 0.05


def test_a_partition_is_read_back_from_the_cache() -> None:
    """A second solver finds the first one's partition; another tolerance or a broken file means computing anew."""
    body = wide_sheet()
    peak = control(body, [1.0, 0.0, 0.0])
    first = SolverMassSpring(body, Options(adaptive=True)).prepare(peak)
    again = SolverMassSpring(body, Options(adaptive=True)).prepare(peak)
    assert first is not None and again is not None
    assert first.seconds > 0.0 and again.seconds == 0.0
    assert (first.node_set == again.node_set).all() and (first.wave == again.wave).all()
    assert partition.content_key(body, [peak], 0.05) != partition.content_key(body, [peak], 0.06)
    for file in (cache.user_cache() / "partitions").glob("*.npz"):
        file.write_bytes(b"broken")
    third = SolverMassSpring(body, Options(adaptive=True)).prepare(peak)
    assert third is not None and third.seconds > 0.0


def test_without_adaptive_there_is_nothing_to_prepare() -> None:
    """`prepare` returns None and everything stays integrated."""
    body = wide_sheet()
    solver = SolverMassSpring(body)
    assert solver.prepare(control(body, 1.0)) is None and solver.partition is None
