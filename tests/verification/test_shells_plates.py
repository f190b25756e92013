"""Square plates: the deflection of the centre by a linear solution, against the series of thin-plate theory."""

from __future__ import annotations

import numpy as np
import pytest
from shell_meshes import grid_points, grid_triangles, shared_load

from faceanim.elements.shells import Sheet, Shells, ShellSystem

SIDE = 10.0
PLATE = Sheet.elastic(0.1, 1e4, 0.3)
EXACT = {
    ("supported", "uniform"): 0.00406235,
    ("clamped", "uniform"): 0.00126532,
    ("supported", "point"): 0.01160084,
    ("clamped", "point"): 0.00561202,
}
"""Deflection of the centre over q a^4 / D or P a^2 / D (Timoshenko & Woinowsky-Krieger, Theory of Plates and Shells)."""
MEASURED = {
    ("supported", "uniform"): (0.9984, 1.0006, 1.0003, 1.0001),
    ("clamped", "uniform"): (1.2229, 1.0649, 1.0168, 1.0042),
    ("supported", "point"): (1.0075, 1.0029, 1.0011, 1.0004),
    ("clamped", "point"): (1.0434, 1.0170, 1.0052, 1.0015),
}
"""The same over the exact one for quarter meshes of n = 2, 4, 8, 16, by an independent code of the same element."""


def deflection(n: int, edge: str, load: str, diagonal: str = "rising") -> float:
    """Return the centre's deflection over the exact one; the centre is the first corner of a quarter of n x n squares."""
    points, triangles = grid_points((n, n), (0.0, 0.0), (SIDE / 2, SIDE / 2)), grid_triangles((n, n), diagonal)
    system = ShellSystem(Shells(points, triangles, PLATE))
    m = len(points)
    x, y = points[:, 0], points[:, 1]
    fixed = np.zeros((2 * m, 3), dtype=bool)
    fixed[:m, :2] = True
    fixed[m:, 2] = True
    far_x, far_y = x > SIDE / 2 - 1e-9, y > SIDE / 2 - 1e-9
    fixed[:m, 2] = far_x | far_y
    fixed[m:, 0] = (y < 1e-9) | far_x
    fixed[m:, 1] = (x < 1e-9) | far_y
    if edge == "clamped":
        fixed[m:][far_x | far_y] = True
    force = np.zeros((2 * m, 3))
    if load == "point":
        force[0, 2] = 0.25
    else:
        force[:m, 2] = shared_load(points, triangles)
    unit = SIDE**2 if load == "point" else SIDE**4
    return float(system.linear_answer(fixed, force)[0, 2] * PLATE.bending_stiffness / unit / EXACT[edge, load])


@pytest.mark.parametrize(("edge", "load"), EXACT)
def test_square_plate(edge: str, load: str) -> None:
    """The table of the discrete Kirchhoff triangle, each entry within 5e-4; diagonals run from the centre outwards."""
    found = [deflection(n, edge, load) for n in (2, 4, 8, 16)]
    np.testing.assert_allclose(found, MEASURED[edge, load], atol=5e-4)


@pytest.mark.parametrize("diagonal", ["rising", "falling", "crossed"])
@pytest.mark.parametrize(("edge", "load"), EXACT)
def test_plates_converge(edge: str, load: str, diagonal: str) -> None:
    """With any direction of the diagonals the error falls at second order; 0.6 % are left at n = 16 at most."""
    error = [abs(deflection(n, edge, load, diagonal) - 1.0) for n in (8, 16, 32)]
    assert error[1] < 6e-3
    assert error[2] < 2e-4 or np.log2(error[1] / error[2]) > 1.4
