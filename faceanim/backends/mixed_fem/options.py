"""Choices of the mixed finite element backend."""

from __future__ import annotations

import math
from dataclasses import dataclass

from faceanim.ground.errors import UserError, unknown_name


@dataclass(frozen=True)
class Model:
    """One of the models of the paper's Fig. 8.

    law : the elastic law, None = the one that is asked for   shell : skin as a shell   homogeneous : one tissue for all
    pressure : volume changes averaged over the elements at each node, which keeps linear tetrahedra from locking
    """

    title: str
    law: str | None
    shell: bool
    homogeneous: bool
    pressure: bool


MODELS = {
    "mixed": Model("NFM-EM: nonlinear mixed elements", None, True, False, True),
    "nonlinear": Model("NFEM: nonlinear, one tissue", None, False, True, False),
    "mass_tensor": Model("MTM: St. Venant-Kirchhoff mass tensor, one tissue", "stvk", False, True, False),
    "linear": Model("LFEM: linear, one tissue", "linear", False, True, False),
}
"""Name of each model -> what it is."""
STABLE = ("tension", "neo_hookean")
LAWS = (*STABLE, "mooney_rivlin")
TISSUES = ("body", "craniofacial")
CONTACTS = ("film", "slide", "stick")
INTEGRATORS = ("backward_euler", "trapezoid")


@dataclass(frozen=True)
class Options:
    """How the flesh is modelled and solved.

    model : one of `MODELS`; `shell`, `homogeneous` and `pressure` override what it says (None = as the model)
    law : of the nonlinear models: "tension" (stable, the tension curve of the tissue), "mooney_rivlin" (as published;
    loses its stability at moderate stretches where c01 < 0) or "neo_hookean"
    tissue : "body" = the body's own constants; "craniofacial" = the published ones for its skin, fat and muscle
    contact : "film" (a soft film between flesh and teeth stands for it), "slide" (the film is taken out: flesh slides
    without friction on bone and teeth, lips and lids touch) or "stick" (nodes that a bone meets are moved out of it and
    stick for that step; equilibria only)
    integrator : "backward_euler" (damps) or "trapezoid"
    tolerance : largest unbalanced force over the largest element force at which a solution is taken as converged [-]
    most : Newton steps before a load counts as too much at once
    step : largest movement of a bone [mm] that is tried at once   least_step : share of the load at which it is given up
    """

    model: str = "mixed"
    law: str = "tension"
    tissue: str = "body"
    shell: bool | None = None
    homogeneous: bool | None = None
    pressure: bool | None = None
    contact: str = "film"
    integrator: str = "backward_euler"
    tolerance: float = 1e-6
    most: int = 30
    step: float = 3.0
    least_step: float = 1.0 / 256.0

    def __post_init__(self) -> None:
        for field, known in (("model", MODELS), ("law", LAWS), ("tissue", TISSUES),
                             ("contact", CONTACTS), ("integrator", INTEGRATORS)):  # fmt: skip
            if getattr(self, field) not in known:
                raise unknown_name(f"mixed_fem: {field}", getattr(self, field), known)
        for field, sound, rule in (
            ("tolerance", math.isfinite(self.tolerance) and 0 < self.tolerance < 1, "in (0, 1)"),
            ("most", isinstance(self.most, int) and self.most >= 1, "a whole number, at least 1"),
            ("step", math.isfinite(self.step) and self.step > 0, "positive [mm]"),
            ("least_step", math.isfinite(self.least_step) and 0 < self.least_step <= 1, "in (0, 1]"),
        ):
            if not sound:
                raise UserError(f"mixed_fem: {field} = {getattr(self, field)} must be {rule}")

    @property
    def resolved(self) -> Model:
        """The model with what the options override; a law without a barrier has no use for averaged pressure."""
        model = MODELS[self.model]

        def chosen(asked: bool | None, usual: bool) -> bool:
            return usual if asked is None else bool(asked)

        law = self.law if model.law is None else model.law
        pressure = chosen(self.pressure, model.pressure)
        if pressure and law not in LAWS:
            raise UserError(
                f"mixed_fem: model {self.model!r} has law {law!r}, which knows no pressure; leave `pressure` out"
            )
        return Model(
            model.title, law, chosen(self.shell, model.shell), chosen(self.homogeneous, model.homogeneous), pressure
        )
