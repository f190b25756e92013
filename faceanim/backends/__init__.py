"""How flesh answers. Backends know bodies, never faces; siblings never import each other."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from faceanim.ground.errors import unknown_name

BACKENDS: dict[str, str] = {
    "mass_spring": "faceanim.backends.mass_spring.solver:SolverMassSpring",
    "finite_elements": "faceanim.backends.finite_elements.solver:SolverFiniteElements",
    "mixed_fem": "faceanim.backends.mixed_fem.solver:SolverMixedFem",
    "modal_warping": "faceanim.backends.modal_warping.solver:SolverModalWarping",
    "weighted_residual": "faceanim.backends.weighted_residual.solver:SolverWeightedResidual",
    "octree_mass_spring": "faceanim.backends.octree_mass_spring.solver:SolverOctreeMassSpring",
}
"""Name of each backend -> "module:class", loaded on first use."""


def backend_class(name: str) -> Any:
    """Return the solver class registered under `name`; raise `UserError` naming the known ones."""
    if name not in BACKENDS:
        raise unknown_name("backend", name, BACKENDS)
    module, cls = BACKENDS[name].split(":")
    return getattr(import_module(module), cls)


def make_solver(name: str, body: Any, options: Any = None) -> Any:
    """Return a solver of backend `name` for `body`; `options` is that backend's Options (None = its defaults)."""
    cls = backend_class(name)
    return cls(body, cls.Options() if options is None else options)
