"""Action units: every way of writing them, and every mistake answered in one line that helps."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from faceanim.expression.action_units import (
    LETTERS,
    UnitUse,
    is_formula,
    load_action_units,
    parse_unit,
    parse_units,
)
from faceanim.ground.errors import AssetError, UserError

UNITS = load_action_units()


@pytest.mark.parametrize(
    ("text", "use"),
    [
        ("12", UnitUse(12, "both", 1.0)),
        ("AU12", UnitUse(12, "both", 1.0)),
        ("12=0.8", UnitUse(12, "both", 0.8)),
        ("r12 = .5", UnitUse(12, "right", 0.5)),
        ("L14A", UnitUse(14, "left", LETTERS["A"])),
        ("5b", UnitUse(5, "both", LETTERS["B"])),
        ("12=C", UnitUse(12, "both", LETTERS["C"])),
        ("AUR30", UnitUse(30, "right", 1.0)),
    ],
)
def test_every_notation_means_what_facs_means(text: str, use: UnitUse) -> None:
    """A unit can be written with a side, a letter, or a number."""
    assert parse_unit(text, UNITS) == use


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("3", "2 (outer brow raiser), 4 (brow lowerer)"),
        ("12=1.5", "12 = 1.5 is outside 0..1"),
        ("12=-0.1", "outside 0..1"),
        ("12=nan", "not a number"),
        ("12=inf", "outside 0..1"),
        ("12=much", "not 'much'"),
        ("X12", "unknown side 'X'"),
        ("12F", "unknown intensity 'F'"),
        ("12C=0.5", "not understood"),
        ("12=", "not understood"),
        ("smile", "not understood"),
        ("", "not understood"),
        ("L18", "has no sides"),
        ("30", "needs a side"),
    ],
)
def test_a_mistake_is_named_with_its_way_out(text: str, part: str) -> None:
    """What cannot be is refused, never guessed."""
    with pytest.raises(UserError, match=r"^[^\n]*$") as caught:
        parse_unit(text, UNITS)
    assert part in str(caught.value)


@given(st.text(max_size=8))
def test_any_text_parses_or_is_a_user_error(text: str) -> None:
    """No text makes the parser fail in another way, and intensities stay in [0, 1]."""
    try:
        use = parse_unit(text, UNITS)
    except UserError:
        return
    assert 0.0 <= use.intensity <= 1.0
    assert use.number in UNITS


def test_the_table_holds_the_units_of_the_reference() -> None:
    """Every action unit that the expressions and the published table name is there, and does something."""
    wanted = {1, 2, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 20, 22, 23, 24, 26, 27, 43, 45}
    assert wanted <= set(UNITS)
    assert all(unit.muscles or any(getattr(unit.jaw, c) for c in unit.jaw.LIMITS) for unit in UNITS.values())


def test_formulas_are_told_from_names() -> None:
    """`6+12C` is a formula, `happiness` is a name."""
    assert is_formula("6+12C")
    assert is_formula("R12A+R14A")
    assert not is_formula("happiness")
    assert not is_formula("")
    assert [use.number for use in parse_units("1+2+5B+26", UNITS)] == [1, 2, 5, 26]
    assert parse_units("", UNITS) == ()


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("source = 'x'\n[unit.1]\nname = 'a'\nmuscles = { m = 1.5 }", "muscle 'm' = 1.5"),
        ("source = 'x'\n[unit.1]\nname = 'a'\njaw = { opening = -1.0 }", "opening = -1"),
        ("source = 'x'\n[unit.one]\nname = 'a'", "'one' is not a number"),
        ("source = 'x'\n[unit.1]\nname = 'a'\nmuscels = {}", "muscels"),
        ("source = ", "Invalid"),
        ("[unit.1]\nname = 'a'", "source"),
    ],
)
def test_a_broken_table_is_refused_by_name(tmp_path: Path, text: str, part: str) -> None:
    """The message names the file and the fault."""
    file = tmp_path / "units.toml"
    file.write_text(text)
    with pytest.raises(AssetError, match=r"units\.toml") as caught:
        load_action_units(file)
    assert part in str(caught.value)
