"""An expression: action units, single muscles and jaw controls, and what they ask of the muscles of a face."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from faceanim.expression.action_units import ActionUnit, Jaw, Side, UnitUse, in_range, load_action_units, number_of
from faceanim.expression.timeline import Timeline
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError, unknown_name

_SIDES: dict[Side, tuple[str, ...]] = {"both": ("_left", "_right"), "left": ("_left",), "right": ("_right",)}


@dataclass(frozen=True, eq=False)
class Drive:
    """What an expression asks for at its apex: `activation` (m,) in [0, 1] and the `jaw` controls."""

    activation: Floats
    jaw: Jaw


@dataclass(frozen=True)
class Expression:
    """A named set of action units, with single muscles and jaw controls set on top of them.

    muscles : muscle name (with or without its side) -> activation in [0, 1]; replaces what the action units ask of it
    jaw : control name -> value; replaces what the action units ask of it
    timeline : the course in time that suits it, None for the usual one
    """

    name: str
    units: tuple[UnitUse, ...] = ()
    muscles: dict[str, float] = field(default_factory=dict)
    jaw: dict[str, float] = field(default_factory=dict)
    timeline: Timeline | None = None
    source: str = ""

    def __post_init__(self) -> None:
        for name, value in self.muscles.items():
            in_range(f"activation of {name}", value, 0.0, 1.0)
        for name, value in self.jaw.items():
            if name not in Jaw.LIMITS:
                raise unknown_name("jaw control", name, Jaw.LIMITS)
            in_range(f"jaw {name}", value, *Jaw.LIMITS[name])

    @property
    def formula(self) -> str:
        """The action units as FACS writes them, intensities as numbers: `6+12=0.8`."""
        parts = []
        for use in self.units:
            side = {"both": "", "left": "L", "right": "R"}[use.side]
            parts.append(f"{side}{use.number}" + ("" if use.intensity == 1.0 else f"={use.intensity:g}"))
        return "+".join(parts)

    def with_units(self, uses: Iterable[UnitUse]) -> Expression:
        """Return a copy in which `uses` are added; a unit already there takes the new intensity on the side named."""
        units = list(self.units)
        for use in uses:
            units = [kept for old in units for kept in _without(old, use)] + [use]
        return replace(self, units=tuple(units))

    def drive(self, muscle_names: Sequence[str], table: dict[int, ActionUnit] | None = None) -> Drive:
        """Return what the expression asks of a face with `muscle_names`.

        Where several action units use one muscle, the largest demand counts: asking twice for the same thing changes
        nothing, a unit alone is answered exactly, and nothing leaves [0, 1]. Jaw opening and protrusion likewise;
        lateral movements add up, within [-1, 1].
        Raises `UserError` for a muscle that the face does not have, naming the nearest.
        """
        table = load_action_units() if table is None else table
        index = {name: k for k, name in enumerate(muscle_names)}
        activation = np.zeros(len(muscle_names))
        jaw = {"opening": 0.0, "lateral": 0.0, "protrusion": 0.0}
        for use in self.units:
            unit = table[use.number]
            for name, gain in unit.muscles.items():
                for k, share in _targets(name, use.side, index, f"action unit {use.number} ({unit.name})"):
                    activation[k] = max(activation[k], use.intensity * gain * share)
            turn = -1.0 if use.side == "right" else 1.0
            jaw["opening"] = max(jaw["opening"], use.intensity * unit.jaw.opening)
            jaw["protrusion"] = max(jaw["protrusion"], use.intensity * unit.jaw.protrusion)
            jaw["lateral"] = min(1.0, max(-1.0, jaw["lateral"] + turn * use.intensity * unit.jaw.lateral))
        for name, value in self.muscles.items():
            for k, _ in _targets(name, "both", index, ""):
                activation[k] = value
        return Drive(activation, Jaw(**(jaw | self.jaw)))


def _without(old: UnitUse, new: UnitUse) -> list[UnitUse]:
    """Return what is left of `old` once `new` has taken its side of the same unit."""
    if old.number != new.number or (old.side != "both" and new.side not in ("both", old.side)):
        return [old]
    if old.side == "both" and new.side != "both":
        return [replace(old, side="right" if new.side == "left" else "left")]
    return []


def _targets(name: str, side: Side, index: dict[str, int], asker: str) -> list[tuple[int, float]]:
    """Return (muscle index, share) for a muscle `name` given without or with its side."""
    if name in index:
        return [(index[name], 1.0 if side == "both" else 0.5)]
    found = [(index[name + end], 1.0) for end in _SIDES[side] if name + end in index]
    if found:
        return found
    if asker:
        raise UserError(
            f"{asker} needs the muscle {name!r}, which this face lacks; `faceanim muscles map --complete` adds what a "
            "list of muscles lacks"
        )
    bases = {n.removesuffix("_left").removesuffix("_right") for n in index}
    raise unknown_name("muscle", name, bases | set(index) if name.endswith(("_left", "_right")) else bases)


def parse_setting(text: str, what: str) -> tuple[str, float]:
    """Return (name, value) of `name=value`; raise `UserError` naming `what` otherwise."""
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (name and equals and value):
        raise UserError(f"{what} {text!r} is not understood; write name=value")
    return name, number_of(value, f"{what} {name}: a number")
