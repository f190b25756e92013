"""Lists of muscles: written, read, split into sides and joined again; what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faceanim.face.library import asset_text, load_face, read_muscles
from faceanim.face.muscles import (
    AnyMuscle,
    LidMuscle,
    LinearMuscle,
    SheetMuscle,
    SphincterMuscle,
    both_sides,
    build_muscles,
    mirrored,
    moved,
    muscles_text,
    one_sided,
    paired,
    parse_muscles,
)
from faceanim.ground.errors import AssetError

BUILT_IN = parse_muscles(asset_text("muscles.toml"), "muscles.toml")
number = st.floats(-200.0, 200.0, allow_nan=False)
positive = st.floats(0.01, 500.0)
point = st.tuples(number, number, number)
names = st.from_regex(r"[a-z]{3,9}_[a-z]{3,9}", fullmatch=True)
linear = st.builds(LinearMuscle, point, point, positive, positive, positive, st.none() | point, st.just("jaw"))
sheet = st.builds(SheetMuscle, point, point, positive, positive, positive, st.floats(0.0, 1.0))
ring = st.builds(SphincterMuscle, point, st.tuples(positive, positive), positive, positive, paired=st.booleans())
lid = st.builds(LidMuscle, positive, positive)
tables = st.dictionaries(names, linear | sheet | ring | lid, max_size=6)


@settings(max_examples=60, deadline=None)
@given(tables)
def test_a_written_list_reads_back_equal(table: dict[str, AnyMuscle]) -> None:
    """To the last bit, notes and all (muscles whose points coincide are refused, as they must be)."""
    ends = [(m.origin, m.insertion, m.via) for m in table.values() if isinstance(m, (LinearMuscle, SheetMuscle))]
    if any(len({p for p in points if p}) < len([p for p in points if p]) for points in ends):
        return
    text = muscles_text(table, dict.fromkeys(table, "a note\nof two lines"), "a heading")
    assert parse_muscles(text, "text") == table
    assert text.startswith("# a heading\n")


@settings(max_examples=60, deadline=None)
@given(tables)
def test_sides_are_split_and_joined_without_loss(table: dict[str, AnyMuscle]) -> None:
    """Exactly, for paired muscles and for those in the middle that are their own mirror image."""
    one = one_sided(table)
    assert set(one) == set(both_sides(table))
    assert not any(m.paired for m in one.values())
    assert one_sided(paired(one)) == one


def test_the_built_in_muscles_are_joined_from_their_sides() -> None:
    """And act as before."""
    again = paired(one_sided(BUILT_IN))
    assert again == BUILT_IN
    terrain = load_face(density="coarse").terrain
    a, b = build_muscles(BUILT_IN, terrain), build_muscles(one_sided(BUILT_IN), terrain)
    assert a.names == b.names
    np.testing.assert_array_equal(a.weight, b.weight)
    np.testing.assert_array_equal(a.point, b.point)


def test_twins_that_differ_a_little_are_joined_at_their_mean() -> None:
    """Within the distance asked for, and not beyond."""
    left = LinearMuscle((10.0, 0.0, 50.0), (20.0, 0.0, 60.0), 100.0, 9.0, paired=False)
    right = msgspec.structs.replace(mirrored(left), insertion=(-20.5, 0.0, 60.0))
    rows: dict[str, AnyMuscle] = {"some_muscle_left": left, "some_muscle_right": right}
    assert paired(rows, within=0.4) == rows
    joined = paired(rows, within=0.6)
    assert list(joined) == ["some_muscle"]
    assert joined["some_muscle"].insertion == (20.25, 0.0, 60.0)
    middle = {"lone": LinearMuscle((0.2, 0.0, 50.0), (0.0, 9.0, 60.0), 100.0, 9.0, paired=False)}
    assert paired(middle, within=0.5)["lone"].origin == (0.0, 0.0, 50.0)


@settings(max_examples=30, deadline=None)
@given(linear | sheet | ring, st.floats(0.3, 3.0), point)
def test_a_muscle_is_carried_to_another_head_and_back(muscle: AnyMuscle, scale: float, offset: Any) -> None:
    """Scaling and moving it back gives it again."""
    away = moved(muscle, scale * np.eye(3), np.array(offset), scale)
    back = moved(away, np.eye(3) / scale, -np.array(offset) / scale, 1.0 / scale)
    for name in muscle.__struct_fields__:
        a, b = getattr(muscle, name), getattr(back, name)
        if isinstance(a, (float, tuple)):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
        else:
            assert a == b


GOOD = 'kind = "linear"\norigin = [1.0, 2.0, 3.0]\ninsertion = [4.0, 5.0, 6.0]\nforce = 10.0\nradius = 5.0\n'


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (f"[m]\n{GOOD}".replace("10.0", "-1.0"), "force"),
        (f"[m]\n{GOOD}".replace("10.0", "nan"), "finite"),
        (f"[m]\n{GOOD}".replace("[4.0, 5.0, 6.0]", "[4.0, inf, 6.0]"), "finite"),
        (f"[m]\n{GOOD}".replace("radius = 5.0", "radius = 0.0"), "radius"),
        (f"[m]\n{GOOD}".replace("[4.0, 5.0, 6.0]", "[1.0, 2.0, 3.0]"), "differ"),
        (f'[m]\n{GOOD}bone = "femur"\n', "femur"),
        (f"[m]\n{GOOD}colour = 3\n", "colour"),
        (f'["m m!"]\n{GOOD}', "no name"),
        (f"[m]\n{GOOD}[m_left]\n{GOOD}", "twice"),
        ('[m]\nkind = "lid"\nforce = 1.0\nreach = 5.0\npaired = false\n', "_left"),
        ('[m]\nkind = "ghost"\n', "ghost"),
        ("[m\n", "TOML"),
    ],
)
def test_what_cannot_be_is_refused_with_the_muscle_named(text: str, word: str) -> None:
    """Never built into a face."""
    with pytest.raises(AssetError, match=word if word != "TOML" else "text"):
        parse_muscles(text, "text")


def test_files_that_are_no_lists_are_refused(tmp_path: Path) -> None:
    """Missing, empty, binary and huge ones, a folder."""
    (tmp_path / "empty.toml").write_bytes(b"")
    (tmp_path / "binary.toml").write_bytes(bytes(range(256)))
    (tmp_path / "huge.toml").write_bytes(b"#" * (2**20 + 1))
    for name, word in (("none", "cannot be read"), ("empty", "no muscles"), ("binary", "UTF-8"), ("huge", "larger")):
        with pytest.raises(AssetError, match=word):
            read_muscles(tmp_path / f"{name}.toml")
    with pytest.raises(AssetError, match="cannot be read"):
        read_muscles(tmp_path)
