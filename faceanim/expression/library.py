"""Expressions by name: every TOML file in `assets/expressions/`, a file of one's own, or a FACS formula."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec

from faceanim.expression.action_units import is_formula, load_action_units, parse_units, read_toml
from faceanim.expression.expression import Expression
from faceanim.expression.timeline import Timeline
from faceanim.face.library import asset_folder
from faceanim.ground.errors import AssetError, UserError, unknown_name


class _File(msgspec.Struct, forbid_unknown_fields=True):
    units: str
    source: str
    muscles: dict[str, float] = {}
    jaw: dict[str, float] = {}
    timeline: Timeline | None = None


def expression_names() -> tuple[str, ...]:
    """Return the names of the expressions in the library, sorted."""
    return tuple(sorted(path.stem for path in (asset_folder() / "expressions").glob("*.toml")))


def read_expression(path: Path) -> Expression:
    """Return the expression that the TOML file `path` describes; raise `AssetError` naming the file and the fault."""
    content = read_toml(path, _File)
    try:
        units = parse_units(content.units, load_action_units())
        return Expression(path.stem, (), content.muscles, content.jaw, content.timeline, content.source).with_units(
            units
        )
    except AssetError:
        raise
    except UserError as error:
        raise AssetError(f"{path}: {error}") from None


def load_expression(name: str) -> Expression:
    """Return the expression called `name`: a library name, a path ending in .toml, or a formula such as `6+12C`.

    Raises `UserError` for an unknown name, suggesting the nearest, and `AssetError` for a broken file.
    """
    if name.endswith(".toml"):
        return read_expression(Path(name))
    names = expression_names()
    if name.lower() in names:
        return read_expression(asset_folder() / "expressions" / f"{name.lower()}.toml")
    if is_formula(name):
        units = parse_units(name, load_action_units())
        return replace(Expression(name.upper()).with_units(units), source="asked for as a formula")
    raise unknown_name("expression", name, names)
