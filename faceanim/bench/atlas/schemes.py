"""Who is tried in the stability maps: every registered backend, with the schemes and laws that differ in stability."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

from faceanim.backends import BACKENDS, backend_class
from faceanim.body.body import Body
from faceanim.ground.errors import UserError

Choices = dict[str, dict[str, Any]]
TIME: dict[str, Choices] = {
    "mass_spring": {
        "paper": {"scheme": "paper"},
        "paper, tangent": {"scheme": "paper", "secant": False},
        "semi_implicit": {"scheme": "semi_implicit"},
        "explicit, undivided": {"scheme": "explicit", "safety": 1e12},
        "explicit": {"scheme": "explicit"},
        "block_descent": {"scheme": "block_descent"},
        "conjugate_gradient": {"scheme": "conjugate_gradient"},
        "newton": {"scheme": "newton"},
    },
    "finite_elements": {"backward_euler": {}, "trapezoid": {"integrator": "trapezoid"}},
    "mixed_fem": {"backward_euler": {}},
    "modal_warping": {
        name: {"variant": name}
        for name in ("warped", "consistent", "rotation_strain", "rotation_strain_shape", "linear")
    },
    "octree_mass_spring": {"uniform": {}, "dynamic": {"dynamic": True}},
}
"""Backend -> scheme -> its options, where time is the question; a backend that is not here is tried as it comes."""
SHAPE: dict[str, Choices] = TIME | {
    "mass_spring": {"conjugate_gradient": {}, "newton": {"scheme": "newton"}},
    "finite_elements": {
        "neo_hookean": {}, "neo_hookean, quadratic": {"order": 2}, "corotational": {"law": "corotational"},
        "stvk": {"law": "stvk"}, "linear": {"law": "linear"},
    },
    "mixed_fem": {"mixed": {}, "linear": {"model": "linear"}},
}  # fmt: skip
"""The same where the shape is the question."""
SMALL: dict[str, Any] = {"cache": False, "modes": 20, "cells": 8, "degree": 5}
"""Options for small bodies, given to every backend that knows them."""


@dataclass(frozen=True)
class Contender:
    """A scheme that is tried: `make(body)` returns its solver; `yardstick(body)` one whose equilibria it must reach."""

    backend: str
    scheme: str
    make: Callable[[Body], Any]

    @property
    def label(self) -> str:
        """Backend and scheme in words."""
        return f"{self.backend}: {self.scheme}" if self.scheme else self.backend

    def takes(self, body: Body) -> bool:
        """Whether it models such a body; a solver that breaks takes it, and its failure will be on the map."""
        try:
            self.make(body)
        except UserError:
            return False
        except Exception:
            return True
        return True


def contender(backend: str, scheme: str, options: dict[str, Any]) -> Contender:
    """Return a registered backend with these options."""

    def make(body: Body) -> Any:
        cls = backend_class(backend)
        known = {f.name for f in fields(cls.Options)}
        small = {name: value for name, value in SMALL.items() if name in known}
        return cls(body, cls.Options(**(small | options)))

    return Contender(backend, scheme, make)


def contenders(table: dict[str, Choices], backends: Sequence[str] | None = None) -> list[Contender]:
    """Return all schemes of `table` of these backends, in the registry's order (None = all of it)."""
    chosen = [name for name in BACKENDS if backends is None or name in backends]
    return [
        contender(name, scheme, options) for name in chosen for scheme, options in table.get(name, {"": {}}).items()
    ]
