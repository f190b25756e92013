"""Strips that bend far: the elastica under a dead force at its tip, and a full circle under a moment."""

from __future__ import annotations

import numpy as np
import pytest
from shell_meshes import grid_points, grid_triangles

from faceanim.elements.newton import newton
from faceanim.elements.shells import Sheet, Shells, ShellSystem

LENGTH = 10.0
BENDING = 100.0
"""E I of a strip with E = 1.2e6, nu = 0, width 1 and thickness 0.1."""
ELASTICA = {
    0.4: (0.010354, 0.130975),
    1.0: (0.056433, 0.301721),
    2.0: (0.160642, 0.493457),
    4.0: (0.328941, 0.669964),
    10.0: (0.554996, 0.810609),
}
"""P L^2 / E I -> shortening and deflection over the length of an inextensible cantilever, from its elliptic integrals."""


class Strip:
    """A cantilever strip of `cells` squares, held at x = 0; with `flat` it moves in the plane y = const alone."""

    def __init__(self, cells: tuple[int, int], diagonal: str = "crossed", *, flat: bool = False) -> None:
        points = grid_points(cells, (0.0, 0.0), (LENGTH, 1.0))
        self.m, self.x = len(points), points[:, 0]
        self.shells = Shells(points, grid_triangles(cells, diagonal), Sheet.elastic(0.1, 1.2e6, 0.0))
        self.system = ShellSystem(self.shells)
        self.fixed = np.zeros((2 * self.m, 3), dtype=bool)
        self.fixed[: self.m][self.x < 1e-9] = True
        self.fixed[self.m :][self.x < 1e-9] = True
        if flat:
            self.fixed[: self.m, 1] = True
            self.fixed[self.m :, [0, 2]] = True
        self.tip = np.flatnonzero(self.x > LENGTH - 1e-9)
        self.share = np.full(cells[1] + 1, 1.0 / cells[1])
        self.share[[0, -1]] *= 0.5

    def pulled(self, force: float) -> np.ndarray:
        """Return the tip's displacement under a dead force across the strip at rest."""
        load = np.zeros_like(self.system.points)
        load[self.tip, 2] = force * self.share
        x, report = newton(self.system, fixed=self.fixed, force=load, tolerance=1e-8)
        assert report.converged
        return np.asarray((x - self.system.points)[self.tip].mean(axis=0))

    def rolled(self, moment: float, steps: int) -> np.ndarray:
        """Return the state under a moment at the tip, reached in `steps` with the rotations rebased in between."""
        x = self.system.points.copy()
        for k in range(steps):
            load = np.zeros_like(x)
            load[self.m + self.tip, 1] = -moment * (k + 1) / steps * self.share
            x = self.shells.rebase(x)
            x, report = newton(self.system, fixed=self.fixed, values=x, start=x, force=load, tolerance=1e-8)
            assert report.converged
        return x


@pytest.mark.parametrize("load", ELASTICA)
def test_elastica(load: float) -> None:
    """Tip of a strip of 20 x 1 squares within 0.1 % of the elastica, at every load, in one load step."""
    tip = Strip((20, 1)).pulled(load * BENDING / LENGTH**2)
    shortening, deflection = ELASTICA[load]
    assert -tip[0] / LENGTH == pytest.approx(shortening, rel=1e-3)
    assert tip[2] / LENGTH == pytest.approx(deflection, rel=1e-3)


def test_strip_of_the_literature() -> None:
    """L = 10, b = 1, h = 0.1, E = 1.2e6, P = 4: w = 6.70 and u = -3.29, a usual test of shells."""
    tip = Strip((16, 1)).pulled(4.0)
    assert tip[2] == pytest.approx(6.70, abs=0.01)
    assert tip[0] == pytest.approx(-3.29, abs=0.01)


def test_elastica_converges() -> None:
    """The error of the deflection falls at an order of about 1.5 and is 0.02 % with 40 squares."""
    exact = ELASTICA[4.0][1]
    error = [Strip((n, 1)).pulled(4.0)[2] / LENGTH / exact - 1.0 for n in (10, 20, 40)]
    assert min(np.log2(error[0] / error[1]), np.log2(error[1] / error[2])) > 1.3
    assert error[2] < 2.5e-4


@pytest.mark.parametrize(("cells", "gap"), [((8, 1), 2e-4), ((32, 2), 2e-6)])
def test_full_circle(cells: tuple[int, int], gap: float) -> None:
    """Under M = 2 pi E I / L the ends meet and the tip has turned by 360 degrees: eight steps, rebased at each."""
    strip = Strip(cells, flat=True)
    x = strip.rolled(2.0 * np.pi * BENDING / LENGTH, 8)
    ends = x[strip.tip] - strip.system.points[: len(strip.tip)]
    assert np.abs(ends).max() < gap * LENGTH
    turned = strip.shells.rotations(x)[strip.tip[0]]
    np.testing.assert_allclose(turned, np.eye(3), atol=6e-4)
    # chords as long as the arcs at rest: a regular polygon
    n = cells[0]
    height = LENGTH / n / np.sin(np.pi / n)
    middle = np.abs(strip.x - LENGTH / 2) < 1e-9
    assert x[: strip.m][middle, 2].mean() == pytest.approx(height, rel=2e-4)


@pytest.mark.slow
def test_full_circle_without_guides() -> None:
    """A strip of 32 x 2 squares that may also twist and go sideways still rolls into the circle."""
    strip = Strip((32, 2))
    x = strip.rolled(2.0 * np.pi * BENDING / LENGTH, 8)
    assert np.abs(x[strip.tip] - strip.system.points[:3]).max() < 2e-5 * LENGTH
