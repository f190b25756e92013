"""The flesh of an octree: what every leaf weighs and how stiff it is, and the same for the cells of every level."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from faceanim.backends.octree_mass_spring import harmonic, simplify
from faceanim.geometry.octree import Octree
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError, unknown_name


@dataclass(frozen=True, eq=False)
class Lattice:
    """An octree with tissue in its leaves.

    stiffness : (c,) [mN/mm] of a leaf's whole edge, E h / simplify.YOUNG   mass : (c,) [kg]
    rule, chain : how many cells become one, see `Options`
    barrier, least : [-] what resists a corner Jacobian below `least`, in the cell's modulus times its volume
    low, high : [-] the share of its rest length between which a spring is linear   ramp : [-] stiffness factor outside
    """

    tree: Octree
    stiffness: Floats
    mass: Floats
    rule: str = "energy"
    chain: str = "small_strain"
    low: float = 0.3
    high: float = 1.7
    ramp: float = 100.0
    barrier: float = 0.0
    least: float = 0.5
    _known: dict[int, tuple[Floats, Floats]] = field(default_factory=dict, repr=False)
    _cubes: dict[int, Floats] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        count = len(self.tree.leaves.index)
        for name, value in (("stiffness", self.stiffness), ("mass", self.mass)):
            if value.shape != (count,) or not (np.isfinite(value) & (value > 0)).all():
                raise UserError(f"lattice: {name} must give each of the {count} leaves a positive number")
        if self.rule not in simplify.RULES:
            raise unknown_name("rule", self.rule, simplify.RULES)
        if self.chain not in simplify.CHAINS:
            raise unknown_name("chain", self.chain, simplify.CHAINS)

    @property
    def top(self) -> int:
        """The number of the coarsest level."""
        return len(self.tree.levels) - 1

    def cell_tables(self, level: int) -> tuple[Floats, Floats]:
        """Return the springs (c, 28) [mN/mm] and corner masses (c, 8) [kg] of all cells of `level`, from the leaves."""
        if level not in self._known:
            springs = simplify.simplify_springs(self._spread(self.stiffness, level), self.rule, self.chain)
            self._known[level] = springs, simplify.simplify_mass(self._spread(self.mass, level))
        return self._known[level]

    def cubes(self, level: int) -> Floats:
        """Return the stiffness (c, 24, 24) [mN/mm] of all cells of `level` > 0 under the rule "harmonic"."""
        if level not in self._cubes:
            self._cubes.update(harmonic.cubes(self.tree, self.stiffness))
        return self._cubes[level]

    def _spread(self, value: Floats, level: int) -> Floats:
        """Return the leaves' `value` (c,) in their places in the cells of `level`, (cells, s, s, s), zero where none is."""
        s = 1 << level
        parent, place = self.tree.ancestor[level], self.tree.leaves.index % s
        out = np.zeros((len(self.tree.levels[level].index), s, s, s))
        np.add.at(out, (parent, *place.T), value)
        return out
