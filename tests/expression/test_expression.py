"""Expressions: what they ask of the muscles, whatever way they are put together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from faceanim.expression.action_units import UnitUse, load_action_units, parse_units
from faceanim.expression.expression import Expression, parse_setting
from faceanim.expression.library import expression_names, load_expression, read_expression
from faceanim.face.library import asset_text
from faceanim.face.muscles import both_sides, parse_muscles
from faceanim.ground.errors import AssetError, UserError

UNITS = load_action_units()
NAMES = tuple(
    full
    for base in sorted({m for unit in UNITS.values() for m in unit.muscles})
    for full in ((base,) if base.startswith("orbicularis_oris") else (f"{base}_left", f"{base}_right"))
)
K = {name: k for k, name in enumerate(NAMES)}


def _swap(name: str) -> str:
    return name.replace("_left", "_x").replace("_right", "_left").replace("_x", "_right")


uses = st.lists(
    st.builds(
        UnitUse,
        st.sampled_from([n for n, unit in UNITS.items() if unit.sides == "pair"]),
        st.sampled_from(["both", "left", "right"]),
        st.floats(0.0, 1.0),
    ),
    max_size=6,
)


@given(uses)
def test_nothing_leaves_its_range(units: list[UnitUse]) -> None:
    """Any combination of units gives activations and jaw controls within their limits."""
    drive = Expression("any").with_units(units).drive(NAMES)
    assert ((drive.activation >= 0.0) & (drive.activation <= 1.0)).all()


@given(uses)
def test_the_mirrored_expression_drives_the_mirrored_muscles(units: list[UnitUse]) -> None:
    """Left and right are treated alike."""
    sides = {"both": "both", "left": "right", "right": "left"}
    mirrored = [UnitUse(u.number, sides[u.side], u.intensity) for u in units]  # type: ignore[arg-type]
    a = Expression("any").with_units(units).drive(NAMES).activation
    b = Expression("any").with_units(mirrored).drive(NAMES).activation
    assert np.array_equal(a, b[[K[_swap(name)] for name in NAMES]])


@given(uses)
def test_asking_twice_changes_nothing(units: list[UnitUse]) -> None:
    """Units combine by the largest demand, and a repeated unit replaces itself."""
    once = Expression("any").with_units(units)
    assert np.array_equal(once.drive(NAMES).activation, once.with_units(once.units).drive(NAMES).activation)


def test_a_unit_of_one_side_replaces_that_side_only() -> None:
    """`R12=0.5` on a full smile leaves the left at 1."""
    smile = load_expression("happiness").with_units(parse_units("R12", UNITS))
    smile = smile.with_units([UnitUse(12, "right", 0.5)])
    drive = smile.drive(NAMES)
    assert drive.activation[K["zygomaticus_major_left"]] == UNITS[12].muscles["zygomaticus_major"]
    assert drive.activation[K["zygomaticus_major_right"]] == 0.5 * UNITS[12].muscles["zygomaticus_major"]


def test_muscles_and_jaw_are_set_on_top() -> None:
    """An activation of one's own replaces what the units ask; without a side it sets both."""
    e = Expression("e", (), {"zygomaticus_major": 0.7, "corrugator_left": 0.2}, {"opening": 0.5})
    drive = e.with_units(parse_units("12+26", UNITS)).drive(NAMES)
    assert drive.activation[[K["zygomaticus_major_left"], K["zygomaticus_major_right"]]].tolist() == [0.7, 0.7]
    assert drive.activation[K["corrugator_left"]] == 0.2
    assert drive.activation[K["corrugator_right"]] == 0.0
    assert drive.jaw.opening == 0.5


def test_the_jaw_moves_to_the_side_asked_for() -> None:
    """L30 is positive (to the subject's left), R30 negative, both together nothing."""
    assert Expression("e").with_units(parse_units("L30", UNITS)).drive(NAMES).jaw.lateral == 1.0
    assert Expression("e").with_units(parse_units("R30C", UNITS)).drive(NAMES).jaw.lateral == -0.6
    assert Expression("e").with_units(parse_units("L30+R30", UNITS)).drive(NAMES).jaw.lateral == 0.0


@pytest.mark.parametrize(
    ("make", "part"),
    [
        (lambda: Expression("e", muscles={"m": 1.2}), "activation of m = 1.2 is outside 0..1"),
        (lambda: Expression("e", muscles={"m": float("nan")}), "not a number"),
        (lambda: Expression("e", jaw={"openning": 0.2}), "did you mean 'opening'"),
        (lambda: Expression("e", jaw={"lateral": -2.0}), "outside -1..1"),
        (lambda: Expression("e", muscles={"zygomaticus_majr_left": 1.0}).drive(NAMES), "zygomaticus_major_left"),
        (lambda: Expression("e", muscles={"zygomatic": 1.0}).drive(NAMES), "zygomaticus_m"),
        (lambda: Expression("e", units=(UnitUse(12, "both", 1.0),)).drive(("risorius_left",)), "action unit 12"),
        (lambda: load_expression("hapiness"), "did you mean 'happiness'"),
        (lambda: load_expression("6+99"), "unknown action unit 99"),
        (lambda: load_expression("6+X12"), "unknown side"),
        (lambda: parse_setting("opening", "jaw control"), "write name=value"),
        (lambda: parse_setting("opening=wide", "jaw control"), "a number is needed, not 'wide'"),
    ],
)
def test_a_mistake_is_named_with_its_way_out(make: object, part: str) -> None:
    """Unknown names suggest the nearest; values outside their range are refused."""
    with pytest.raises(UserError) as caught:
        make()  # type: ignore[operator]
    assert part in str(caught.value)


def test_the_library_holds_the_basic_expressions_with_their_units() -> None:
    """The lists are those of EMFACS, and each file says where its list comes from."""
    lists = {
        "happiness": "6+12",
        "sadness": "1+4=0.4+15",
        "surprise": "1+2+5=0.4+26",
        "fear": "1+2+4=0.4+5+7=0.4+20+26",
        "anger": "4+5+7+23",
        "disgust": "9+15+16",
        "contempt": "R12=0.4+R14=0.8",
        "neutral": "",
        "blink": "45",
    }
    assert set(lists) <= set(expression_names())
    for name, formula in lists.items():
        expression = load_expression(name)
        assert expression.formula == formula
        assert expression.source


def test_every_expression_and_unit_finds_its_muscles_on_the_default_face() -> None:
    """No name in the tables is missing from the muscles of the face."""
    names = tuple(both_sides(parse_muscles(asset_text("muscles.toml"), "muscles.toml")))
    for name in (*expression_names(), *(f"{'L' if u.sides == 'one' else ''}{n}" for n, u in UNITS.items())):
        load_expression(name).drive(names)


def test_a_formula_is_an_expression() -> None:
    """`faceanim express 6+12C` needs no file."""
    assert load_expression("6+12C").formula == "6+12=0.6"


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("units = '6+99'\nsource = 'x'", "unknown action unit 99"),
        ("units = '6'", "source"),
        ("units = '6'\nsource = 'x'\nmuscles = { m = 2.0 }", "outside 0..1"),
        ("units = '6'\nsource = 'x'\ntimeline = { onset = -1.0 }", "onset = -1"),
        ("units = 6\nsource = 'x'", "units"),
        ("units = '\xff", "broken.toml"),
    ],
)
def test_a_broken_file_is_refused_by_name(tmp_path: Path, text: str, part: str) -> None:
    """The message names the file and the fault."""
    file = tmp_path / "broken.toml"
    file.write_text(text, encoding="latin-1")
    with pytest.raises(AssetError, match=r"broken\.toml") as caught:
        read_expression(file)
    assert part in str(caught.value)


def test_a_file_of_ones_own_is_an_expression(tmp_path: Path) -> None:
    """A path ending in .toml is read like the library's files; a missing one is named."""
    file = tmp_path / "smirk.toml"
    file.write_text("units = 'R12=0.5'\nsource = 'mine'\njaw = { opening = 0.1 }\ntimeline = { onset = 0.2 }")
    mine = load_expression(str(file))
    assert (mine.name, mine.formula, mine.jaw["opening"]) == ("smirk", "R12=0.5", 0.1)
    assert mine.timeline is not None
    assert mine.timeline.onset == 0.2
    with pytest.raises(AssetError, match="no such file"):
        load_expression(str(tmp_path / "none.toml"))
