"""Plans of operations: what a file may say, and how it is told what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from faceanim.ground.errors import AssetError, UserError
from faceanim.surgery.plan import load_plan, parse_plan, plan_names, planes_of

SOUND = """
title = "chin"
[[piece]]
name = "chin"
bone = "jaw"
planes = [{ point = [0.0, -75.0, 80.0], normal = [0.0, -2.0, 0.0] }]
[[piece.move]]
translation = [0.0, 0.0, 6.0]
"""


def test_the_built_in_plans_are_sound() -> None:
    """Every one parses and says where it comes from; the four moves of the paper are there."""
    names = plan_names()
    assert {"midface_advance", "midface_lower", "midface_rotate", "mandible_advance", "genioplasty"} <= set(names)
    plans = {name: load_plan(name) for name in names}
    assert all(plan.name == name and plan.source for name, plan in plans.items())
    assert plans["midface_advance"].piece[0].move[0].translation == [0.0, 0.0, 12.0]
    assert plans["midface_lower"].piece[0].move[0].translation == [0.0, -5.0, 0.0]
    assert plans["midface_rotate"].piece[0].move[0].degrees == 5.0
    turn, shift = plans["mandible_advance"].piece[0].move
    assert (turn.degrees, shift.translation) == (3.0, [0.0, 0.0, 8.0])


def test_normals_become_unit_vectors_and_mirrors_and_boxes_planes() -> None:
    """A mirrored plane is two, a box six."""
    text = SOUND.replace("] }]", "], mirrored = true }]\nboxes = [{ min = [-9.0, -9.0, -9.0], max = [1.0, 2.0, 3.0] }]")
    planes = planes_of(parse_plan(text, "test").piece[0], lambda place: np.asarray(place, dtype=float))
    assert len(planes) == 8
    assert all(np.linalg.norm(normal) == pytest.approx(1.0) for _, _, normal in planes)
    np.testing.assert_allclose(planes[1][1], [-0.0, -75.0, 80.0])
    inside = np.array([0.5, 0.0, 0.0])
    assert all((inside - point) @ normal > 0 for _, point, normal in planes[2:])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('bone = "jaw"', 'bone = "mandible"', ("unknown bone 'mandible'", "cranium, jaw")),
        ('bone = "jaw"', 'bone = "jaw"\ncolour = 3', ("unknown field `colour`", "overlap")),
        ("normal =", "normals =", ("unknown field `normals`", "mirrored")),
        ('title = "chin"', 'title = "chin"\nsurgeon = "x"', ("unknown field `surgeon`", "title")),
        ("[0.0, -2.0, 0.0]", "[0.0, 0.0, 0.0]", ("plane 1: normal", "no direction")),
        ("[0.0, -2.0, 0.0]", "[0.0, nan, 0.0]", ("finite",)),
        ("[0.0, -2.0, 0.0]", "[0.0, 1.0]", ("length >= 3",)),
        ("[0.0, -75.0, 80.0]", "[0.0, -75.0]", ("landmark",)),
        ("translation = [0.0, 0.0, 6.0]", "degrees = 3.0", ("both axis",)),
        ("translation = [0.0, 0.0, 6.0]", "", ("either translation",)),
        ("6.0]", "6.0]\naxis = [1.0, 0.0, 0.0]\ndegrees = 2.0", ("either translation",)),
        ("6.0]", "6e9]", ("within 1000",)),
        ("translation = [0.0, 0.0, 6.0]", "axis = [1.0, 0.0, 0.0]\ndegrees = 90.0", ("<= 45",)),
        ('name = "chin"', 'name = "../chin"', ("letters",)),
        ('name = "chin"', 'name = "jaw"', ("taken",)),
        ('name = "chin"', 'name = "chin"\nkeep = "smallest"', ("keep", "largest")),
        ("planes =", "# planes =", ("planes or boxes",)),
        ("[[piece]]", "[[piece", ("test.toml",)),
    ],
)
def test_a_fault_is_named(old: str, new: str, words: tuple[str, ...]) -> None:
    """Every message names the file and the fault, and what would be right."""
    assert old in SOUND
    with pytest.raises(AssetError) as error:
        parse_plan(SOUND.replace(old, new, 1), "test.toml")
    for word in ("test.toml", *words):
        assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_pieces_need_names_of_their_own() -> None:
    """A pair takes two names."""
    again = SOUND + SOUND[SOUND.index("[[piece]]") :]
    with pytest.raises(AssetError, match="taken"):
        parse_plan(again, "test.toml")
    many = SOUND + "".join(SOUND[SOUND.index("[[piece]]") :].replace('"chin"', f'"c{k}"') for k in range(12))
    with pytest.raises(AssetError, match="length <= 12"):
        parse_plan(many, "test.toml")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    """Missing, a folder, too large, not text: each is one sentence."""
    huge, binary = tmp_path / "huge.toml", tmp_path / "binary.toml"
    huge.write_bytes(b"# " + b"x" * 2**18)
    binary.write_bytes(b'title = "\xff\xfe"')
    (tmp_path / "folder.toml").mkdir()
    for name, word in (("none", "No such file"), ("huge", "larger"), ("binary", "UTF-8"), ("folder", "folder")):
        with pytest.raises(AssetError, match=word):
            load_plan(str(tmp_path / f"{name}.toml"))
    deep = tmp_path / "deep.toml"
    deep.write_text("title = " + "[" * 50_000, encoding="utf-8")
    with pytest.raises(AssetError):
        load_plan(str(deep))
    with pytest.raises(UserError, match="genioplasty"):
        load_plan("genioplastie")
