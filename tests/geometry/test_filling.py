"""Closed surfaces get a volume that carries them."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.backends import BACKENDS, backend_class, make_solver
from faceanim.body.control import Control
from faceanim.body.solid import solid_body
from faceanim.geometry.filling import filled
from faceanim.geometry.shapes import sheet, sphere
from faceanim.ground.errors import UserError
from faceanim.tissue.material import Material


def test_a_ball_is_filled_and_carried() -> None:
    """Elements are sound, their volume comes near that of the ball, and its vertices are reproduced."""
    ball = sphere(10.0, 2)
    mesh, skin = filled(ball, 2.5)
    mesh.reject_bad()
    assert mesh.parts.max() == 0
    assert 1.0 < mesh.volumes.sum() / (4.0 / 3.0 * np.pi * 1000.0) < 1.6
    np.testing.assert_allclose(skin.apply(mesh.points), ball.points, atol=1e-10)
    assert skin.weight.min() > -0.7


@pytest.mark.parametrize("backend", sorted(set(BACKENDS) - {"mass_spring"}))
def test_every_backend_moves_a_filled_surface(backend: str) -> None:
    """A ball on a stand sags under its weight, straight down, and the stand stays."""
    ball = sphere(10.0, 2)
    mesh, skin = filled(ball, 4.0)
    held = mesh.points[:, 1] < mesh.points[:, 1].min() + 4.1
    body = solid_body(mesh, Material("jelly", 1e-6, 1.0, 0.4), held, surface=ball, skin=skin, damping=100.0)
    coarse = backend_class(backend).Options(**({"cells": 8} if backend == "octree_mass_spring" else {}))
    solver, control = make_solver(backend, body, coarse), Control.rest(body)
    control.gravity[:] = (0.0, -2000.0, 0.0)
    found = ball.points.copy()
    solver.surface(solver.solve_static(control), found)
    moved = found - ball.points
    top = ball.points[:, 1] > 9.0
    assert (
        moved[top, 1].max() < -1e-3 and np.abs(moved[top][:, [0, 2]].mean(axis=0)).max() < 0.05 * -moved[top, 1].mean()
    )
    assert body.pinned.any() and np.abs(moved[body.pinned]).max() < 1e-9


def test_an_open_surface_is_refused() -> None:
    """A sheet has an edge: it holds no volume."""
    with pytest.raises(UserError, match="open"):
        filled(sheet(4, 4, 10.0, 10.0), 2.0)
