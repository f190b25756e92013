"""Choices of the finite element backend."""

from __future__ import annotations

import math
from dataclasses import dataclass

from faceanim.elements.tetrahedra import LAWS
from faceanim.ground.errors import UserError, unknown_name

INTEGRATORS = ("backward_euler", "trapezoid")
MASSES = ("consistent", "lumped")


@dataclass(frozen=True)
class Options:
    """How the flesh is modelled and solved.

    order : 1 = linear, 2 = quadratic tetrahedra   law : one of `elements.LAWS`
    integrator : "backward_euler" (damps) or "trapezoid" (second order, keeps the energy of a linear body)
    mass : "consistent" or "lumped"
    tolerance : largest unbalanced force over the largest element force at which a solution is taken as converged [-]
    most : Newton steps before a load counts as too much at once
    least_step : share of the load below which load steps are given up [-]
    """

    order: int = 1
    law: str = "neo_hookean"
    integrator: str = "backward_euler"
    mass: str = "consistent"
    tolerance: float = 1e-9
    most: int = 60
    least_step: float = 1.0 / 512.0

    def __post_init__(self) -> None:
        for field, known in (("law", LAWS), ("integrator", INTEGRATORS), ("mass", MASSES)):
            if getattr(self, field) not in known:
                raise unknown_name(f"finite_elements: {field}", getattr(self, field), known)
        for field, sound, rule in (
            ("order", self.order in (1, 2), "1 or 2"),
            ("tolerance", math.isfinite(self.tolerance) and 0 < self.tolerance < 1, "in (0, 1)"),
            ("most", isinstance(self.most, int) and self.most >= 1, "a whole number, at least 1"),
            ("least_step", math.isfinite(self.least_step) and 0 < self.least_step <= 1, "in (0, 1]"),
        ):
            if not sound:
                raise UserError(f"finite_elements: {field} = {getattr(self, field)} must be {rule}")
