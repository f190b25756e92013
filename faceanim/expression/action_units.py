"""Action units of the Facial Action Coding System (FACS), as muscles and jaw controls.

The table itself, with its gains, is `assets/action_units.toml`; nothing here knows a muscle by name.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import msgspec

from faceanim.face.library import asset_folder
from faceanim.ground.errors import AssetError, UserError

Side = Literal["both", "left", "right"]
LETTERS = {"A": 0.2, "B": 0.4, "C": 0.6, "D": 0.8, "E": 1.0}
"""FACS intensity letters as fractions of the full action.

The FACS manual orders the letters (A trace, B slight, C marked, D extreme, E maximum) without numbers. Even steps are
the usual choice: data sets such as DISFA (Mavadati et al. 2013) code A to E as 1 to 5 out of 5.
"""

_UNIT = re.compile(r"^([A-Za-z]*?)(\d+)([A-Za-z]*)$")


class Jaw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Jaw controls: opening [0, 1], lateral [-1, 1] (positive to the subject's left), protrusion [0, 1]."""

    opening: float = 0.0
    lateral: float = 0.0
    protrusion: float = 0.0

    LIMITS: ClassVar[dict[str, tuple[float, float]]] = {
        "opening": (0.0, 1.0),
        "lateral": (-1.0, 1.0),
        "protrusion": (0.0, 1.0),
    }


class ActionUnit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One row of the table.

    name : what FACS calls it    muscles : muscle name without its side -> activation at full intensity [0, 1]
    jaw : jaw controls at full intensity
    sides : "pair" acts on both sides or on one; "none" has no sides; "one" must be asked for with a side
    """

    name: str
    muscles: dict[str, float] = {}
    jaw: Jaw = Jaw()
    sides: Literal["pair", "none", "one"] = "pair"


class _Table(msgspec.Struct, forbid_unknown_fields=True):
    source: str
    unit: dict[str, ActionUnit]


@dataclass(frozen=True)
class UnitUse:
    """An action unit as asked for: `number`, `side`, `intensity` in [0, 1]."""

    number: int
    side: Side
    intensity: float


def in_range(what: str, value: float, low: float, high: float) -> float:
    """Return `value` if it is a number within [low, high]; raise `UserError` naming `what` otherwise."""
    if math.isnan(value):
        raise UserError(f"{what} is not a number (nan); give a value from {low:g} to {high:g}")
    if not low <= value <= high:
        raise UserError(f"{what} = {value:g} is outside {low:g}..{high:g}")
    return value


def read_toml(path: Path, kind: type) -> Any:
    """Return the TOML file `path` as the msgspec structure `kind`; raise `AssetError` naming file and fault."""
    try:
        return msgspec.toml.decode(path.read_bytes(), type=kind)
    except FileNotFoundError:
        raise AssetError(f"{path}: no such file") from None
    except OSError as error:
        raise AssetError(f"{path}: cannot be read ({error.strerror})") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise AssetError(f"{path}: {error}") from None


@lru_cache(maxsize=4)
def _load(path: Path) -> dict[int, ActionUnit]:
    table = read_toml(path, _Table)
    units: dict[int, ActionUnit] = {}
    for key, unit in table.unit.items():
        if not key.isdigit():
            raise AssetError(f"{path}: unit {key!r} is not a number")
        for what, value, (low, high) in [
            *((f"muscle {m!r}", gain, (0.0, 1.0)) for m, gain in unit.muscles.items()),
            *((f"jaw {c}", getattr(unit.jaw, c), limits) for c, limits in Jaw.LIMITS.items()),
        ]:
            if not low <= value <= high:
                raise AssetError(f"{path}: unit {key}: {what} = {value:g} is outside {low:g}..{high:g}")
        units[int(key)] = unit
    return units


def load_action_units(path: Path | None = None) -> dict[int, ActionUnit]:
    """Return the table of action units by number; raise `AssetError` when the file is missing or broken."""
    return _load(path or asset_folder() / "action_units.toml")


def intensity_of(text: str, what: str) -> float:
    """Return a FACS letter A-E or a number in [0, 1] as a fraction; raise `UserError` naming `what` otherwise."""
    if text.upper() in LETTERS:
        return LETTERS[text.upper()]
    return in_range(what, number_of(text, f"{what}: a number from 0 to 1 or a letter A to E"), 0.0, 1.0)


def number_of(text: str, wanted: str) -> float:
    """Return `text` as a number; raise `UserError` saying what is `wanted` otherwise."""
    try:
        return float(text)
    except ValueError:
        raise UserError(f"{wanted} is needed, not {text!r}") from None


def parse_unit(text: str, units: dict[int, ActionUnit]) -> UnitUse:
    """Return the meaning of `12`, `12=0.8`, `12C`, `R12=0.5` or `L14A`; no intensity means the full action.

    Raises `UserError` for an unknown unit (naming the nearest), an unknown side, or an intensity outside [0, 1].
    """
    code, _, amount = (part.strip() for part in text.partition("="))
    match = _UNIT.match(code)
    if match is None or (amount and match[3]) or ("=" in text and not amount):
        raise UserError(f"action unit {text!r} is not understood; write 12, 12=0.8, 12C, R12=0.5 or L14A")
    prefix, number, letter = match[1].upper(), int(match[2]), match[3].upper()
    prefix = prefix[2:] if prefix.startswith("AU") else prefix
    if prefix not in ("", "L", "R"):
        raise UserError(f"unknown side {match[1]!r} in action unit {text!r}; write L{number} or R{number}")
    if letter and letter not in LETTERS:
        raise UserError(f"unknown intensity {match[3]!r} in action unit {text!r}; use a letter A to E, or {number}=0.8")
    intensity = LETTERS.get(letter, 1.0) if not amount else intensity_of(amount, f"action unit {code}")
    side: Side = "both" if not prefix else "left" if prefix == "L" else "right"
    if number not in units:
        raise _unknown_unit(number, units)
    unit = units[number]
    if unit.sides == "none" and side != "both":
        raise UserError(f"action unit {number} ({unit.name}) has no sides; write {number} instead of {code}")
    if unit.sides == "one" and side == "both":
        raise UserError(f"action unit {number} ({unit.name}) needs a side; write L{number} or R{number}")
    return UnitUse(number, side, intensity)


def _unknown_unit(number: int, units: dict[int, ActionUnit]) -> UserError:
    near = sorted(sorted(units, key=lambda known: abs(known - number))[:3])
    names = ", ".join(f"{n} ({units[n].name})" for n in near)
    return UserError(f"unknown action unit {number}; nearest: {names}; `faceanim info action-units` lists all")


def parse_units(text: str, units: dict[int, ActionUnit]) -> tuple[UnitUse, ...]:
    """Return the units of a FACS formula such as `1+2+5B+26` or `R12A+R14A`."""
    return tuple(parse_unit(part, units) for part in text.split("+") if part.strip())


def is_formula(text: str) -> bool:
    """Return whether `text` reads like a FACS formula (`12`, `6+12C`) rather than a name."""
    return all(re.match(r"^[A-Za-z]{0,3}\d+[A-Za-z]?$", part.strip()) for part in text.split("+"))
