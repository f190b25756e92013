"""Who takes part in a comparison: every registered backend, with the schemes, densities and steps worth trying."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from faceanim.backends import BACKENDS, backend_class
from faceanim.bench.comparison.rows import Row
from faceanim.bench.comparison.scenes import DENSITIES, FPS
from faceanim.ground.errors import UserError, unknown_name

STEPS = (1, 2, 4)
"""Steps per frame at 30 frames per second: 1/30, 1/60, 1/120 s."""


@dataclass(frozen=True)
class Kind:
    """One way to use a backend: `scheme` in one word, the options that make it, and where it is tried.

    densities, steps : of the full comparison   quick : (density, steps per frame) of the short one
    scenes : beginnings of the names of the scenes that it is for, all if empty
    """

    scheme: str
    settings: dict[str, Any] = field(default_factory=dict)
    densities: tuple[str, ...] = ("coarse", "default")
    steps: tuple[int, ...] = (1, 2)
    quick: tuple[tuple[str, int], ...] = ()
    scenes: tuple[str, ...] = ()


KINDS: dict[str, tuple[Kind, ...]] = {
    "mass_spring": (
        Kind("conjugate_gradient", {}, DENSITIES, STEPS, (("coarse", 1), ("default", 1), ("default", 2))),
        Kind("conjugate_gradient adaptive", {"adaptive": True}, DENSITIES, STEPS, (("default", 2),)),
        Kind("block_descent", {"scheme": "block_descent"}, ("coarse", "default"), STEPS, (("default", 2),)),
        Kind("newton", {"scheme": "newton"}, ("coarse", "default"), STEPS),
        Kind("explicit", {"scheme": "explicit"}, ("coarse", "default"), (2,)),
        Kind("semi_implicit", {"scheme": "semi_implicit"}, ("coarse", "default"), STEPS, (("default", 2),)),
        Kind("paper", {"scheme": "paper"}, ("coarse", "default"), STEPS, (("default", 2),)),
    ),
    "modal_warping": (
        Kind("rotation_strain", {}, quick=(("coarse", 1), ("default", 1), ("default", 2))),
        Kind("rotation_strain 120 modes", {"modes": 120}, quick=(("default", 1),)),
        Kind("consistent", {"variant": "consistent"}, DENSITIES, STEPS, quick=(("default", 1), ("default", 2))),
        Kind("consistent 120 modes", {"variant": "consistent", "modes": 120}),
        Kind("warped", {"variant": "warped"}, quick=(("default", 1),)),
        Kind("linear", {"variant": "linear"}, quick=(("default", 1),)),
    ),
    "weighted_residual": (
        Kind("patches corrected", {}, steps=(1,), quick=(("coarse", 1),), scenes=("face", "skin")),
        Kind("patches alone", {"corrections": 0}, steps=(1,), scenes=("face", "skin")),
        Kind("whole body", {"reach": 100.0, "degree": 5}, ("coarse",), (1,), (("coarse", 1),), ("bar", "block")),
    ),
    "octree_mass_spring": (
        Kind("12 cells", {"cells": 12}, ("default",), quick=(("default", 1),)),
        Kind("24 cells", {}, ("default",), quick=(("default", 1),)),
        Kind("24 cells harmonic", {"rule": "harmonic", "level": 1}, ("default",), steps=(1,)),
    ),
    "mixed_fem": (
        Kind("neo_hookean, pressure", {"law": "neo_hookean", "shell": False}, steps=(1,)),
        Kind("tension, shell", {}, steps=(1,)),
        Kind("linear", {"model": "linear"}, steps=(1,), quick=(("coarse", 1),)),
    ),
    "finite_elements": (
        Kind("neo_hookean", {}, quick=(("coarse", 1),)),
        Kind("corotational", {"law": "corotational"}, steps=(1,)),
        Kind("linear", {"law": "linear"}, steps=(1, 2), quick=(("coarse", 1),)),
        Kind("quadratic", {"order": 2}, ("coarse",), steps=(1,)),
    ),
}
"""What is tried of each backend; one that is not listed takes part with its defaults."""
DEFAULT = (Kind("default", quick=(("coarse", 1),)),)


@dataclass(frozen=True)
class Candidate:
    """One entry of a comparison."""

    backend: str
    scheme: str
    settings: dict[str, Any]
    density: str
    steps_per_frame: int

    @property
    def step(self) -> float:
        """Time step [s]."""
        return 1.0 / FPS / self.steps_per_frame

    @property
    def label(self) -> str:
        """In words: backend, scheme, density and step."""
        return f"{self.backend} {self.scheme}, {self.density}, 1/{round(1.0 / self.step)} s"

    def options(self) -> Any:
        """Return the backend's options."""
        return backend_class(self.backend).Options(**self.settings)


def candidate_of(row: Row) -> Candidate:
    """Return the candidate that a row is about."""
    return Candidate(row.backend, row.scheme, row.settings, row.density, row.steps_per_frame)


def candidates(
    scene: str, *, quick: bool = False, backends: tuple[str, ...] = (), densities: tuple[str, ...] = ()
) -> list[Candidate]:
    """Return everything to compare on the scene of that name; `quick` a fifth of it.

    backends, densities : only these (empty = all)
    Raises `UserError` for unknown names, or if nothing is left.
    """
    for what, asked, known in (("backend", backends, tuple(BACKENDS)), ("density", densities, DENSITIES)):
        for name in asked:
            if name not in known:
                raise unknown_name(what, name, known)
    out = []
    for backend in BACKENDS:
        for kind in KINDS.get(backend, DEFAULT):
            if kind.scenes and not scene.startswith(kind.scenes):
                continue
            places = kind.quick if quick else [(d, n) for d in kind.densities for n in kind.steps]
            out += [
                Candidate(backend, kind.scheme, kind.settings, density, steps)
                for density, steps in places
                if (not backends or backend in backends) and (not densities or density in densities)
            ]
    if not out:
        raise UserError("nothing is left to compare after the choice of backends and densities; leave one of them out")
    return out
