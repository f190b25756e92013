"""Soft tissue as an elastic solid: a few constants from which every elastic law takes its own."""

from __future__ import annotations

import math
from dataclasses import dataclass

from faceanim.ground.errors import UserError


@dataclass(frozen=True)
class Material:
    """An isotropic solid, the same at small strain under every elastic law.

    density : [kg/mm^3]   young_modulus : [kPa]   poisson_ratio : [-] in (-1, 1/2)
    mooney : [-] share of the shear modulus that the Mooney-Rivlin law gives to its second invariant, c01 / (c10 + c01),
    at most 1. Below 0 (c01 < 0, as fits of tension curves give) that law is elliptic only below `stretch_limit`; the
    law "tension" has the same tension curve and is stable everywhere (`tissue.stability`).
    """

    name: str
    density: float
    young_modulus: float
    poisson_ratio: float
    mooney: float = 0.0

    def __post_init__(self) -> None:
        for name, sound, rule in (
            ("density", self.density > 0, "positive"),
            ("young_modulus", self.young_modulus > 0, "positive"),
            ("poisson_ratio", -1 < self.poisson_ratio < 0.5, "above -1 and below 0.5 (0.499 is nearly incompressible)"),
            ("mooney", self.mooney <= 1, "at most 1 (c10 >= 0); negative values mean c01 < 0"),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and sound):
                raise UserError(f"material {self.name!r}: {name} = {value} must be finite and {rule}")

    @classmethod
    def mooney_rivlin(cls, name: str, density: float, c10: float, c01: float, bulk_modulus: float) -> Material:
        """Return the material with these Mooney-Rivlin constants and bulk modulus [kPa]; c01 may be negative.

        Raises `UserError` if c10 + c01 <= 0 (unstable at rest: no shear stiffness), c10 < 0 or bulk_modulus <= 0.
        """
        shear = 2.0 * (c10 + c01)
        for what, value, sound, rule in (
            ("c10 + c01", c10 + c01, shear > 0, "positive: half the shear modulus at rest, else unstable there"),
            ("c10", c10, c10 >= 0, "not negative"),
            ("bulk_modulus", bulk_modulus, bulk_modulus > 0, "positive"),
        ):
            if not (math.isfinite(value) and sound):
                raise UserError(f"material {name!r}: {what} = {value} kPa must be finite and {rule}")
        young = 9.0 * bulk_modulus * shear / (3.0 * bulk_modulus + shear)
        poisson = (3.0 * bulk_modulus - 2.0 * shear) / (2.0 * (3.0 * bulk_modulus + shear))
        return cls(name, density, young, poisson, 2.0 * c01 / shear)

    @property
    def shear_modulus(self) -> float:
        """mu [kPa]."""
        return self.young_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def lame_first(self) -> float:
        """lambda [kPa]."""
        v = self.poisson_ratio
        return self.young_modulus * v / ((1.0 + v) * (1.0 - 2.0 * v))

    @property
    def bulk_modulus(self) -> float:
        """kappa [kPa]."""
        return self.young_modulus / (3.0 * (1.0 - 2.0 * self.poisson_ratio))

    @property
    def c10(self) -> float:
        """Mooney-Rivlin constant of the first invariant [kPa]."""
        return 0.5 * self.shear_modulus * (1.0 - self.mooney)

    @property
    def c01(self) -> float:
        """Mooney-Rivlin constant of the second invariant [kPa]."""
        return 0.5 * self.shear_modulus * self.mooney

    @property
    def stretch_limit(self) -> float:
        """Principal stretch at which the incompressible Mooney-Rivlin law loses its ellipticity, inf if c01 >= 0 [-].

        It is elliptic where c10 + c01 l_i^2 > 0 for i = 1, 2, 3.
        """
        return math.sqrt(-self.c10 / self.c01) if self.c01 < 0 else math.inf
