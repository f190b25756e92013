"""Measurements: exact where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from toys import patch, toy_body

from faceanim.bench.metrics import (
    closest_on_triangles,
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


def test_the_closest_point_beats_every_sample() -> None:
    """No sample of the triangle is closer than the closest point, which lies in the triangle."""
    rng = np.random.default_rng(3)
    x, a, b, c = rng.normal(size=(4, 200, 3))
    bary = closest_on_triangles(x, a, b, c)
    assert bary.min() >= -1e-12
    assert np.allclose(bary.sum(axis=1), 1.0)
    foot = np.einsum("ek,kej->ej", bary, np.stack([a, b, c]))
    samples = rng.dirichlet([0.5, 0.5, 0.5], size=400)
    other = np.einsum("sk,kej->sej", samples, np.stack([a, b, c]))
    assert (np.linalg.norm(x - foot, axis=1) <= np.linalg.norm(x - other, axis=2).min(axis=0) + 1e-12).all()


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
    """A lower sheet that looks up and, `gap` above it, one vertex of an upper sheet."""
    lower = sheet(8, 8, 16.0, 16.0)
    points = np.concatenate([lower.points, [[0.3, 0.2, gap], [1.3, 0.2, gap], [0.3, 1.2, gap]]])
    n = len(lower.points)
    mesh = TriMesh(points, np.concatenate([lower.triangles, [[n, n + 2, n + 1]]]))
    everything = np.arange(len(lower.triangles), dtype=np.int32)
    pair = PairContact("lips", np.array([n], np.int32), np.array([0, len(everything)], np.int32), everything, 0.1)
    return mesh, pair


def test_crossing_is_measured_to_its_depth() -> None:
    """Apart is no crossing; pushed 1.5 mm through is 1.5 mm, less what was crossed at rest."""
    mesh, pair = _two_sheets(1.0)
    assert crossing_depth(mesh, pair, mesh.points) == 0.0
    pushed = mesh.points.copy()
    pushed[-3:, 2] = -1.5
    assert crossing_depth(mesh, pair, pushed) == pytest.approx(1.5)
    mesh, pair = _two_sheets(-0.5)
    assert crossing_depth(mesh, pair, pushed) == pytest.approx(1.0)


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
