"""Choices of the octree backend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from faceanim.backends.octree_mass_spring.simplify import CHAINS, RULES
from faceanim.ground.errors import UserError, unknown_name

CUTS = ("uniform", "force", "importance", "budget")
SAFE_BETA = 1.0 / 6.0 - 1e-3
"""Half-width of a safe box that keeps every corner Jacobian positive: det > 1 - 6 beta in the worst case."""
PAPER_BETA = 0.49
"""The paper's beta(i, j) + beta(j, i) < 1, which only forbids that two ends of a spring pass each other."""


@dataclass(frozen=True, eq=False)
class Options:
    """How flesh is cut into cubes and moved in time. The lattice's Poisson ratio is 1/4 whatever the material says.

    cells : leaves along the body's longest side   cell_size : [mm] of a leaf instead (None = by `cells`)
    levels : most levels of the octree, 1 = the leaves only
    cut : "uniform" one `level` everywhere; "force" as fine as no cell is unsafe under the full pull of all muscles;
        "importance" fine where `importance` is painted or inside `box`; "budget" the finest with at most `budget` springs
    level : 0 = the leaves; of "uniform", and the coarsest outside `box`
    importance : (n_surface,) in [0, 1], 1 = leaves, 0 = `level`   box : (2, 3) [mm] lowest and highest corner
    rule : how diagonals of many cells become one: "energy" keeps the energy of homogeneous strain (the default),
        "series" and "literal" as in the paper with and without its omissions (too soft in shear), "harmonic" cubes whose
        elasticity is measured on the fine lattice
    chain : how edges in a row become one: "small_strain", or the paper's "equal_energy"
    beta : [-] half-width of a cell's safe box   dynamic : cells change size while stepping, to stay safe
    quiet : steps without danger before a cell becomes finer again
    ks : [-] stiffness of the ties between cells of unlike size, in fine edges   hard : tie them exactly instead
    hold : [-] stiffness of the ties to bones, in fine edges, where bones do not carry nodes exactly
    floor : [-] least share to which a partly filled leaf counts as filled
    low, high : [-] of its rest length between which a spring is linear   ramp : [-] stiffness factor outside
    film : [-] elements softer than this share of the body's mean modulus join no cells: between lips and teeth flesh slides
    barrier : [-] resistance of a cell to turning inside out, in its modulus: where a corner Jacobian J is below `least`,
        the energy density barrier * E (least - J)^2 / 2; none near rest, and 0 = none at all
    safety : [-] share of the largest stable step that is used
    static_tolerance : [-] unbalanced force of an equilibrium, as a share of the largest force   static_most : cap of steps
    """

    cells: int = 24
    cell_size: float | None = None
    levels: int = 4
    cut: str = "uniform"
    level: int = 0
    importance: Any = None
    box: Any = None
    budget: int = 20_000
    rule: str = "energy"
    chain: str = "small_strain"
    beta: float = SAFE_BETA
    dynamic: bool = False
    quiet: int = 20
    ks: float = 10.0
    hard: bool = False
    hold: float = 20.0
    floor: float = 0.1
    low: float = 0.3
    high: float = 1.7
    ramp: float = 4.0
    film: float = 0.05
    barrier: float = 5.0
    least: float = 0.5
    safety: float = 0.8
    static_tolerance: float = 1e-10
    static_most: int = 200

    def __post_init__(self) -> None:
        for kind, value, known in (("cut", self.cut, CUTS), ("rule", self.rule, RULES), ("chain", self.chain, CHAINS)):
            if value not in known:
                raise unknown_name(kind, value, known)
        for name, least in (
            ("cells", 1),
            ("levels", 1),
            ("level", 0),
            ("budget", 28),
            ("quiet", 1),
            ("static_most", 1),
        ):
            if getattr(self, name) < least:
                raise UserError(f"{name} = {getattr(self, name)} must be at least {least}")
        if self.level >= self.levels:
            raise UserError(f"level = {self.level} must be below levels = {self.levels}")
        for name, sound, rule in (
            ("cell_size", self.cell_size is None or self.cell_size > 0, "positive"),
            ("beta", 0 < self.beta < 0.5, "between 0 and 1/2"),
            ("ks", self.ks > 0, "positive"),
            ("hold", self.hold > 0, "positive"),
            ("floor", 0 < self.floor <= 1, "above 0 and at most 1"),
            ("low", 0 < self.low < 1, "between 0 and 1"),
            ("high", self.high > 1, "above 1"),
            ("ramp", self.ramp >= 1, "at least 1"),
            ("film", 0 <= self.film < 1, "in 0..1"),
            ("barrier", self.barrier >= 0, "not negative"),
            ("least", 0 < self.least < 1, "between 0 and 1"),
            ("safety", 0 < self.safety < 1, "between 0 and 1"),
            ("static_tolerance", self.static_tolerance > 0, "positive"),
        ):
            value = getattr(self, name)
            if not (sound and (value is None or np.isfinite(value))):
                raise UserError(f"{name} = {value} must be finite and {rule}")
        self._check_painting()

    def _check_painting(self) -> None:
        if self.cut == "importance" and (self.importance is None) == (self.box is None):
            raise UserError("cut 'importance' needs either importance (n_surface,) or box (2, 3)")
        if self.importance is not None:
            value = np.asarray(self.importance, dtype=np.float64)
            if value.ndim != 1 or not ((value >= 0) & (value <= 1)).all():
                raise UserError("importance must give each surface vertex a number in 0..1")
        if self.box is not None:
            box = np.asarray(self.box, dtype=np.float64)
            if box.shape != (2, 3) or not (np.isfinite(box).all() and (box[0] < box[1]).all()):
                raise UserError(f"box = {box.tolist()} must be (2, 3), its first corner below its second")
