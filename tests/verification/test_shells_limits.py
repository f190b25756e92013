"""Skin clamped at its edge and pushed out by a disc: what the stable law does, and where the fitted one ends."""

from __future__ import annotations

import numpy as np
import pytest
from shell_meshes import grid_points, grid_triangles

from faceanim.elements.newton import Report, newton
from faceanim.elements.shells import Sheet, Shells, ShellSystem

SKIN = (186.164, -151.093)
"""c10 and c01 of skin [kPa]."""


def pushed(law: str, advance: float, n: int = 12) -> tuple[np.ndarray, Report, Shells]:
    """Return the stretches, the report and the shells of a skin of 60 x 60 mm with a disc of 20 mm moved by `advance`."""
    points = grid_points((n, n), (-30.0, -30.0), (30.0, 30.0))
    shells = Shells(points, grid_triangles((n, n), "crossed"), Sheet.rubber(1.5, *SKIN, law))
    m = len(points)
    disc = np.hypot(points[:, 0], points[:, 1]) < 10.1
    held = np.tile(disc | (np.abs(points[:, :2]) > 30.0 - 1e-9).any(axis=1), 2)
    goal = shells.points.copy()
    goal[:m][disc, 2] = advance
    x, report = newton(ShellSystem(shells), fixed=held, values=goal, tolerance=1e-7, check_definite=True)
    return shells.stretches(x), report, shells


@pytest.mark.parametrize("advance", [5.0, 8.0, 12.0])
def test_the_stable_law_takes_the_whole_movement(advance: float) -> None:
    """Law `tension`: converged in one load step with a definite tangent, at stretches up to 1.22."""
    stretch, report, shells = pushed("tension", advance)
    assert report.converged and report.load_steps == 1 and report.iterations < 12
    assert report.definite
    assert (stretch < shells.stretch_limits).all()


def test_the_fitted_law_is_sound_below_its_limit() -> None:
    """At 2 mm no triangle is beyond 1.11, and both laws stretch every triangle alike."""
    stretch, report, shells = pushed("mooney_rivlin", 2.0)
    assert report.converged and report.definite
    assert (stretch < shells.stretch_limits).all()
    assert stretch == pytest.approx(pushed("tension", 2.0)[0], abs=1e-3)


@pytest.mark.slow
def test_the_fitted_law_fails_beyond_its_limit() -> None:
    """At 8 mm some triangles are beyond 1.11, where the law is not elliptic; at 12 mm there is no sound solution."""
    stretch, _, shells = pushed("mooney_rivlin", 8.0)
    assert 0.0 < (stretch > shells.stretch_limits).mean() < 0.1
    stretch, report, shells = pushed("mooney_rivlin", 12.0)
    assert not (report.converged and report.definite)
    assert (stretch > shells.stretch_limits).mean() > 0.05
