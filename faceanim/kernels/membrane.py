"""Elastic laws of a thin incompressible sheet in plane stress: energy density w and its derivatives.

With C (2, 2) the metric of the deformed sheet, T = tr C and D = det C, the stretch across the sheet follows from
incompressibility, C33 = 1 / D, so that I1 = T + 1/D and I2 = D + T/D.

LINEAR         mu E : E + lambda'/2 (tr E)^2, E = (C - I)/2, lambda' = E nu / (1 - nu^2): St. Venant-Kirchhoff, any nu
MOONEY_RIVLIN  c10 (I1 - 3) + c01 (I2 - 3); neo-Hookean for c01 = 0
TENSION        f(I1) of `kernels.tension`

`c` (4,) holds lambda', mu, c10 and c01 [kPa]. Holzapfel, Nonlinear Solid Mechanics, 2000, section 6.5.
"""

from __future__ import annotations

import math

from faceanim.ground.jit import kernel
from faceanim.kernels.tension import tension_curvature, tension_energy, tension_slope

LINEAR = 0
MOONEY_RIVLIN = 1
TENSION = 2


@kernel
def membrane_energy(law, x, z, c):
    """Return w [kPa] for x = tr (C - I) and z = det (C - I); infinite where an incompressible sheet has no area."""
    if law == LINEAR:
        return 0.25 * c[1] * (x * x - 2.0 * z) + 0.125 * c[0] * x * x
    y = x + z
    if not y > -1.0:
        return math.inf
    first = y * y / (1.0 + y) - z
    if law == TENSION:
        return tension_energy(first, c[2], c[3])
    return c[2] * first + c[3] * (y * y - z) / (1.0 + y)


@kernel
def membrane_slopes(law, x, z, c):
    """Return dw/dT and dw/dD [kPa]."""
    if law == LINEAR:
        return 0.5 * c[1] * (1.0 + x) + 0.25 * c[0] * x, -0.5 * c[1]
    y = x + z
    D = 1.0 + y
    if law == TENSION:
        slope = tension_slope(y * y / D - z, c[2], c[3])
        return slope, -slope / (D * D)
    return c[2] + c[3] / D, c[3] - (c[2] + c[3] * (2.0 + x)) / (D * D)


@kernel
def membrane_curvatures(law, x, z, c):
    """Return d2w/dT2, d2w/dTdD and d2w/dD2 [kPa]."""
    if law == LINEAR:
        return 0.5 * c[1] + 0.25 * c[0], 0.0, 0.0
    y = x + z
    D = 1.0 + y
    square = D * D
    if law == TENSION:
        first = y * y / D - z
        slope = tension_slope(first, c[2], c[3])
        bend = tension_curvature(first, c[2], c[3])
        return bend, -bend / square, bend / (square * square) + 2.0 * slope / (square * D)
    return 0.0, -c[3] / square, 2.0 * (c[2] + c[3] * (2.0 + x)) / (square * D)
