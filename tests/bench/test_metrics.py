"""Measurements: exact where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from toys import patch, toy_body

from faceanim.bench.metrics import (
    crossing_depth,
    field_error,
    inverted_triangles,
    principal_strain,
    soundness,
)
from faceanim.body.body import PairContact
from faceanim.body.control import Control
from faceanim.geometry.shapes import sheet
from faceanim.geometry.surface import TriMesh


def test_field_error_is_max_and_rms() -> None:
    """One vertex of four that moved by (3, 4, 0) gives 5 and 2.5 mm."""
    a = np.zeros((4, 3))
    b = a.copy()
    b[2] = 3.0, 4.0, 0.0
    error = field_error(b, a)
    assert (error.max, error.rms) == (5.0, 2.5)


def test_a_vertex_pulled_over_its_neighbours_turns_triangles() -> None:
    """A sheet at rest, moved or bent has none turned; a vertex dragged across three columns turns some."""
    mesh = patch()
    assert len(inverted_triangles(mesh, mesh.points)) == 0
    bent = mesh.points.copy()
    bent[:, 2] += 0.01 * bent[:, 0] ** 2
    assert len(inverted_triangles(mesh, bent)) == 0
    folded = mesh.points.copy()
    folded[40, 0] += 30.0
    assert len(inverted_triangles(mesh, folded)) > 0


def _two_sheets(gap: float) -> tuple[TriMesh, PairContact]:
    """A sheet in the plane z = 0 and, `gap` above it, a smaller one that is tilted."""
    lower, upper = sheet(8, 8, 16.0, 16.0), sheet(4, 4, 6.0, 6.0)
    raised = upper.points + np.array([0.31, 0.17, gap])
    raised[:, 2] += 0.1 * raised[:, 0]
    mesh = TriMesh(np.concatenate([lower.points, raised]), np.concatenate([lower.triangles, upper.triangles + 81]))
    everything = np.arange(len(mesh.triangles), dtype=np.int32)
    pair = PairContact("lips", np.array([81], np.int32), np.array([0, len(everything)], np.int32), everything, 0.1)
    return mesh, pair


def test_crossing_is_found_and_measured() -> None:
    """Apart, or bent together, is no crossing; a tilted sheet pushed half through crosses by part of an edge."""
    mesh, pair = _two_sheets(1.0)
    assert crossing_depth(mesh, pair, mesh.points) == 0.0
    bent = mesh.points.copy()
    bent[:, 2] += 0.02 * bent[:, 0] ** 2
    assert crossing_depth(mesh, pair, bent) == 0.0
    pushed = mesh.points.copy()
    pushed[81:, 2] -= 1.0
    assert 0.0 < crossing_depth(mesh, pair, pushed) < 0.3
    folded = mesh.points.copy()
    folded[81 + 12, 2] -= 2.0
    assert crossing_depth(mesh, pair, folded) == pytest.approx(1.0 - 0.031 - 0.069, abs=0.1)


def test_what_crosses_at_rest_does_not_count() -> None:
    """A mesh that is built with a crossing is not blamed for it."""
    mesh, pair = _two_sheets(0.0)
    assert crossing_depth(mesh, pair, mesh.points) == 0.0


def test_a_body_at_rest_is_sound() -> None:
    """Nothing is turned over, inside bone or crossed where nothing moved."""
    body = toy_body()
    check = soundness(body, body.surface.points, Control.rest(body))
    assert (check.inverted_triangles, check.depth_in_bone, check.depth_in_eyeball) == (0, 0.0, 0.0)


def test_principal_strain_of_a_stretched_sheet() -> None:
    """Stretched by 20 % along x and squeezed by 5 % along y, then turned: 0.2 everywhere; squeezed alone: -0.05."""
    mesh = sheet(8, 8, 16.0, 16.0)
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    assert np.allclose(principal_strain(mesh, (mesh.points * (1.2, 0.95, 1.0)) @ turn), 0.2)
    assert np.allclose(principal_strain(mesh, mesh.points * (1.0, 0.95, 1.0)), -0.05)
