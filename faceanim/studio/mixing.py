"""From slider values to what the muscles and the jaw are asked for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache

from faceanim.expression.action_units import Jaw, Side, UnitUse
from faceanim.expression.expression import Drive, Expression
from faceanim.expression.library import load_expression
from faceanim.studio.simulation import Target


@dataclass
class Demands:
    """What the sliders say, each value in [0, 1] but the jaw's lateral movement, in [-1, 1].

    expressions : name -> share of it    units : (number, side) -> intensity    muscles : full name -> activation
    jaw : control name -> value
    """

    expressions: dict[str, float] = field(default_factory=dict)
    units: dict[tuple[int, Side], float] = field(default_factory=dict)
    muscles: dict[str, float] = field(default_factory=dict)
    jaw: dict[str, float] = field(default_factory=dict)


class Mixer:
    """Adds up demands as action units add up: the largest counts, lateral movements of the jaw add.

    names : every muscle that expressions and action units may ask for, by full name
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.names = tuple(names)
        self._expression = lru_cache(maxsize=256)(self._driven_by_name)
        self._unit = lru_cache(maxsize=256)(self._driven_by_unit)

    def _driven_by_name(self, name: str) -> Drive:
        return load_expression(name).drive(self.names)

    def _driven_by_unit(self, number: int, side: Side) -> Drive:
        return Expression("unit", (UnitUse(number, side, 1.0),)).drive(self.names)

    def target(self, demands: Demands) -> Target:
        """Return where the face is to go."""
        asked = [(self._expression(name), share) for name, share in demands.expressions.items() if share]
        asked += [(self._unit(*unit), share) for unit, share in demands.units.items() if share]
        activation: dict[str, float] = {}
        jaw = {name: demands.jaw.get(name, 0.0) for name in Jaw.LIMITS}
        for drive, share in asked:
            for name, value in zip(self.names, drive.activation, strict=True):
                if value:
                    activation[name] = max(activation.get(name, 0.0), share * float(value))
            jaw["opening"] = max(jaw["opening"], share * drive.jaw.opening)
            jaw["protrusion"] = max(jaw["protrusion"], share * drive.jaw.protrusion)
            jaw["lateral"] += share * drive.jaw.lateral
        for name, value in demands.muscles.items():
            if value:
                activation[name] = max(activation.get(name, 0.0), value)
        limited = {name: min(max(jaw[name], low), high) for name, (low, high) in Jaw.LIMITS.items()}
        return Target(activation, Jaw(**limited))
