"""Skin, muscle and fat of the head as measured in tension, with the constants of a craniofacial surgery model.

Table 1 of "An improved finite element model for craniofacial surgery simulation" (nonlinear finite mixed elements)
prints C10 and C01 in gf/mm^2 and a third column "D1" = .49, .3, .49. That column is taken as Poisson's ratio: as the
D1 = 2/kappa of a finite element program it would mean Poisson's ratios of -.05, .24 and .37 for tissues that the text
calls incompressible. Every digit counts: C10 and C01 nearly cancel, and 1 % of C10 is 28 % of the shear modulus of fat.

With C01 < 0 the Mooney-Rivlin law is unstable beyond `Material.stretch_limit` (1.110, 1.128, 1.019), less than the
stretches of the surgery itself; use the law "tension" with the same constants.
"""

from __future__ import annotations

from faceanim.ground.errors import UserError, unknown_name
from faceanim.tissue.material import Material

GRAM_FORCE = 9.80665
"""1 gf/mm^2 [kPa]."""
TABLE_1 = {
    "skin": (18.9834587, -15.4071649, 0.49),
    "muscle": (9.84540206, -7.74326281, 0.3),
    "fat": (16.6131140, -16.0126823, 0.49),
}
"""Tissue -> C10 and C01 [gf/mm^2] and Poisson's ratio [-] as printed."""
DENSITY = {"skin": 1.1e-6, "muscle": 1.06e-6, "fat": 0.92e-6}
"""Tissue -> usual density [kg/mm^3]; the table has none, and equilibrium under imposed movement needs none."""


def tissue(name: str, *, poisson_ratio: float | None = None) -> Material:
    """Return "skin", "muscle" or "fat" with the printed constants.

    poisson_ratio : None = as printed; .49 for muscle is what the text says of it (incompressible), .3 what the table says
    Raises `UserError` for an unknown tissue or a Poisson's ratio outside (-1, 1/2).
    """
    if name not in TABLE_1:
        raise unknown_name("craniofacial tissue", name, TABLE_1)
    c10, c01, printed = TABLE_1[name]
    poisson = printed if poisson_ratio is None else poisson_ratio
    if not -1 < poisson < 0.5:
        raise UserError(f"craniofacial tissue {name!r}: poisson_ratio = {poisson} must be above -1 and below 0.5")
    shear = 2.0 * (c10 + c01) * GRAM_FORCE
    return Material(name, DENSITY[name], 2.0 * shear * (1.0 + poisson), poisson, c01 / (c10 + c01))
