"""A stable law with the tension curve of a Mooney-Rivlin material whose second constant is negative.

Skin, muscle and fat have been fitted in tension with c01 < 0; such a Mooney-Rivlin law loses its ellipticity at a
stretch of sqrt(-c10 / c01). The law f(I1) here has the same stress in uniaxial tension at every stretch and the same
shear modulus 2 (c10 + c01), but depends on I1 alone, with f' > 0 and f'' > 0: it is polyconvex, hence stable everywhere.
It replaces, and does not reproduce, compression and equibiaxial tension.

With l the stretch at which uniaxial tension has this I1, the largest root of l^3 - I1 l + 2 = 0, and c10 > 0 >= c01:
f = c10 (I1 - 3) + c01 (2 l + 1/l^2 - 3), f' = c10 + c01 / l, f'' = -c01 / (2 l^3 - 2).
"""

from __future__ import annotations

import math

from faceanim.ground.jit import kernel

ROOTS = 60
"""Most iterations for the stretch; ten are usual."""
FLATTEST = 1e-3
"""Least l - 1/l^2 by which f'' is divided: it is singular at rest, where it is multiplied by zero."""


@kernel
def stretch_over(s):
    """Return l - 1 >= 0 for I1 - 3 = `s`, without the loss of digits near rest: (l - 1)^2 (l + 2) = s l."""
    if s <= 0.0:
        return 0.0
    d = math.sqrt(s / 3.0)
    for _ in range(ROOTS):
        value = d * d * (3.0 + d) - s * (1.0 + d)
        slope = d * (6.0 + 3.0 * d) - s
        change = value / slope
        d -= change
        if abs(change) <= 1e-16 + 1e-15 * d:
            break
    return d


@kernel
def tension_energy(s, c10, c01):
    """Return f [kPa] for I1 - 3 = `s`."""
    d = stretch_over(s)
    return c10 * s + c01 * d * d * (3.0 + 2.0 * d) / ((1.0 + d) * (1.0 + d))


@kernel
def tension_slope(s, c10, c01):
    """Return f' = df/dI1 [kPa] for I1 - 3 = `s`."""
    return c10 + c01 / (1.0 + stretch_over(s))


@kernel
def tension_curvature(s, c10, c01):
    """Return f'' [kPa] for I1 - 3 = `s`, bounded near rest."""
    l = 1.0 + stretch_over(s)
    return -c01 / (2.0 * l * l * max(l - 1.0 / (l * l), FLATTEST))
