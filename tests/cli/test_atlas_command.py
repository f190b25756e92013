"""`faceanim atlas`: mistakes are one line, a second run tries nothing again, all files are there."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from faceanim.bench.alone import alone
from faceanim.bench.atlas import cells as atlas
from faceanim.cli.atlas import NAMES
from faceanim.cli.main import main

WORDS = ["atlas", "sheet", "--maps", "turn", "--backends", "mass_spring", "--quick", "--quiet"]


@pytest.fixture(autouse=True)
def _folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["shet"], "did you mean 'sheet'"),
        (["sheet", "--maps", "stretch"], "nothing is left"),
        (["sheet", "--maps", ","], "--maps names none"),
        (["sheet", "--maps", "times"], "unknown map 'times'"),
        (["sheet", "--backends", "mixed"], "did you mean 'mixed_fem'"),
        (["bar", "--backends", "mass_spring"], "nothing is left"),
        (["sheet", "--out", "file"], "output folder file is a file"),
        (["sheet", "--quick", "--full"], "not allowed with"),
        ([], "SCENE"),
    ],
)
def test_a_mistake_is_one_line_and_status_two(words: list[str], part: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The same manners as everywhere."""
    Path("file").write_text("")
    assert main(["atlas", *words]) == 2
    assert part in capsys.readouterr().err.splitlines()[-1]


def test_maps_are_made_once(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Table, pictures and page are saved; a second run tries no cell again and says the same."""
    assert main(WORDS) == 0
    first = capsys.readouterr().out
    assert "sheet" in first and "saved" in first
    assert {p.name for p in Path("atlas").glob("[!.]*")} == {*NAMES, "sheet_turn.png"}
    kept = json.loads(Path("atlas/atlas.json").read_text())
    assert all(cell["outcome"] == "converged" for cell in kept["maps"][0]["cells"].values())
    tried: list[object] = []
    monkeypatch.setattr(atlas, "tried", lambda *args: tried.append(args))
    assert main(WORDS) == 0
    assert not tried
    assert capsys.readouterr().out == first
    assert json.loads(Path("atlas/atlas.json").read_text()) == kept


def test_a_damaged_file_is_a_mistake_and_stays(capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is written over it."""
    Path("atlas").mkdir()
    Path("atlas/atlas.json").write_text('{"version": 1, "maps": [')
    assert main(WORDS) == 2
    assert "atlas.json is not an atlas" in capsys.readouterr().err.splitlines()[-1]
    assert Path("atlas/atlas.json").read_text() == '{"version": 1, "maps": ['
    assert [p.name for p in Path("atlas").glob("[!.]*")] == ["atlas.json"]


def test_two_runs_at_once_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    """While one run holds the folder another is turned away and touches nothing."""
    with alone(Path("atlas")):
        assert main(WORDS) == 2
    assert "another run" in capsys.readouterr().err
    assert not Path("atlas/atlas.json").exists()
