"""`faceanim muscles`: draw, map and check as a user types them."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from faceanim.cli.main import main
from faceanim.face.library import read_muscles


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the built-in muscle image, drawn by the command."""
    path = tmp_path_factory.mktemp("muscles") / "front.png"
    assert main(["muscles", "draw", "--out", str(path)]) == 0
    return path


def test_an_image_becomes_muscles_and_an_image_again(
    image: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a list, a table for other programs and a picture; the list is sound and can be drawn."""
    out = tmp_path / "mine.toml"
    assert main(["muscles", "map", str(image), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "36 muscles, 0 faults" in said and "procerus" in said
    table = read_muscles(out)
    assert table["zygomaticus_major"].paired and not table["procerus"].paired
    assert "mm off the bone" in out.read_text(encoding="utf-8")
    with out.with_suffix(".csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 36
    assert all(float(row["insertion_to_skin"]) < 0.5 for row in rows if row["bone"])
    picture = cv2.imread(str(tmp_path / "mine_views.png"))
    assert picture is not None and picture.shape == (1024, 1536, 3)
    assert main(["muscles", "check", str(out)]) == 0
    again = tmp_path / "again.png"
    assert main(["muscles", "draw", str(out), "--kind", "cylinder", "--size", "300", "--out", str(again)]) == 0
    assert cv2.imread(str(again)).shape == (300, 300, 3)  # type: ignore[union-attr]


@pytest.mark.slow
def test_own_muscles_move_the_face(image: Path, tmp_path: Path) -> None:
    """`express --muscles` takes the list, and says so in run.json."""
    out = tmp_path / "mine.toml"
    assert main(["muscles", "map", str(image), "--out", str(out), "--quiet"]) == 0
    frames = tmp_path / "frames"
    words = ["--duration", "0.1", "--size", "64", "--no-video", "--check", "none", "--quiet", "--density", "coarse"]
    assert main(["express", "happiness", "--muscles", str(out), "--out", str(frames), *words]) == 0
    assert str(out) in (frames / "run.json").read_text(encoding="utf-8")


def test_nothing_is_overwritten_without_force(image: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither the list nor what is written beside it."""
    out = tmp_path / "mine.toml"
    for name in ("mine.toml", "mine.csv", "mine_views.png"):
        (tmp_path / name).write_text("precious", encoding="utf-8")
        assert main(["muscles", "map", str(image), "--out", str(out)]) == 2
        assert "--force" in capsys.readouterr().err
        assert (tmp_path / name).read_text(encoding="utf-8") == "precious"
        assert sorted(p.name for p in tmp_path.iterdir()) == [name]
        (tmp_path / name).unlink()
    picture = tmp_path / "there.png"
    picture.write_text("precious", encoding="utf-8")
    assert main(["muscles", "draw", "--out", str(picture)]) == 2
    assert picture.read_text(encoding="utf-8") == "precious"
    assert main(["muscles", "draw", "--out", str(picture), "--force"]) == 0
    assert cv2.imread(str(picture)) is not None


def test_the_picture_that_is_read_is_never_written(image: Path, tmp_path: Path) -> None:
    """Not even with --force."""
    source = tmp_path / "m_views.png"
    source.write_bytes(image.read_bytes())
    assert main(["muscles", "map", str(source), "--out", str(tmp_path / "m.toml"), "--force"]) == 2
    assert main(["muscles", "check", str(source), "--marked", str(source), "--force"]) == 2
    assert source.read_bytes() == image.read_bytes()


def test_check_lists_what_is_wrong_and_marks_it(
    image: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With exit status 1 for errors, and a copy of the picture with rings."""
    picture = cv2.imread(str(image))
    assert picture is not None
    cv2.circle(picture, (160, 250), 3, (0, 220, 255), -1)
    bad = tmp_path / "bad.png"
    cv2.imwrite(str(bad), picture)
    assert main(["muscles", "check", str(bad)]) == 1
    said = capsys.readouterr().out
    assert "wrong-colour at pixel (16" in said and "bad_checked.png" in said
    assert cv2.imread(str(tmp_path / "bad_checked.png")) is not None
    assert main(["muscles", "map", str(bad), "--out", str(tmp_path / "bad.toml")]) == 2
    assert "wrong-colour" in capsys.readouterr().err and not (tmp_path / "bad.toml").exists()
    assert main(["muscles", "map", str(bad), "--out", str(tmp_path / "part.toml"), "--partial", "--quiet"]) == 0
    assert main(["muscles", "check", str(image)]) == 0
    assert not image.with_name("front_checked.png").exists()


@pytest.mark.slow
def test_a_picture_without_some_muscles_can_be_completed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Those that it lacks come from the built-in list, when asked."""
    few = tmp_path / "few.toml"
    rows = read_muscles(Path(__file__).parents[2] / "assets" / "muscles.toml")
    from faceanim.face.muscles import muscles_text

    kept = {n: m for n, m in rows.items() if n not in ("risorius", "mentalis")}
    few.write_text(muscles_text(kept), encoding="utf-8")
    assert main(["muscles", "draw", str(few), "--out", str(tmp_path / "few.png")]) == 0
    for words, wanted in (([], False), (["--complete"], True)):
        out = tmp_path / f"out{len(words)}.toml"
        assert main(["muscles", "map", str(tmp_path / "few.png"), "--out", str(out), "--quiet", *words]) == 0
        assert ("risorius" in read_muscles(out)) is wanted
    words = ["express", "17", "--muscles", str(tmp_path / "out0.toml"), "--out", str(tmp_path / "frames"), "--quiet"]
    assert main(words) == 2
    assert "'mentalis'" in (said := capsys.readouterr().err) and "--complete" in said


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["map", "none.png"], "cannot be read"),
        (["map", "front.png", "--kind", "side"], "kind"),
        (["map", "front.png", "--out", "m.txt"], ".toml"),
        (["map", "front.png", "--out", "no/such/m.toml"], "does not exist"),
        (["map", "front.png", "--face", "nobody"], "nobody"),
        (["map", "blank.png"], "no muscle was found"),
        (["map", "grey.png"], "three channels"),
        (["map", "empty.png"], "empty"),
        (["draw", "none.toml"], "cannot be read"),
        (["draw", "front.png"], "UTF-8"),
        (["draw", "--size", "9999"], "--size"),
        (["draw", "--kind", "auto"], "kind"),
        (["draw", "x.toml", "--blank"], "--blank"),
        (["draw", "--out", "m.jpg"], ".png"),
        (["check", "none.toml"], "cannot be read"),
        (["check", "broken.toml"], "force"),
        (["paint"], "paint"),
        ([], "TASK"),
    ],
)
def test_mistakes_are_one_line_each(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    words: list[str], complaint: str,
) -> None:  # fmt: skip
    """With exit status 2, and nothing written."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "front.png").write_bytes(image.read_bytes())
    (tmp_path / "empty.png").write_bytes(b"")
    blank = np.full((512, 512, 3), 120, dtype=np.uint8)
    cv2.imwrite("blank.png", blank)
    cv2.imwrite("grey.png", blank[:, :, 0])
    row = 'kind = "linear"\norigin = [1.0, 2.0, 3.0]\ninsertion = [4.0, 5.0, 6.0]\nforce = -1.0\nradius = 5.0\n'
    (tmp_path / "broken.toml").write_text(f"[m]\n{row}", encoding="utf-8")
    before = sorted(tmp_path.iterdir())
    assert main(["muscles", *words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and complaint in said
    assert sorted(tmp_path.iterdir()) == before


def test_a_blank_to_draw_on(tmp_path: Path) -> None:
    """The face alone, with nothing on it that could be taken for a mark."""
    out = tmp_path / "blank.png"
    assert main(["muscles", "draw", "--blank", "--out", str(out)]) == 0
    assert main(["muscles", "check", str(out), "--kind", "front"]) == 1  # nothing-found
