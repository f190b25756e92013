"""`faceanim framerate` on a toy face: a table on the screen, the same in files, and a chart."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from toys import toy_face

from faceanim.cli.framerate import NAMES
from faceanim.cli.main import main


@pytest.fixture(autouse=True)
def _toys(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, toy_backend: str) -> None:
    monkeypatch.setattr("faceanim.face.library.load_face", lambda *_: toy_face())
    monkeypatch.chdir(tmp_path)


def test_the_table_is_shown_and_saved(capsys: pytest.CaptureFixture[str]) -> None:
    """Each expression has a row beside the published one; CSV, JSON, Markdown and chart are in the folder."""
    words = ["framerate", "--backend", "toy", "--expressions", "happiness,27", "--size", "32", "--fps", "10", "--quiet"]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "happiness" in out
    assert "34.8" in out
    assert sorted(path.name for path in Path("framerate").iterdir()) == sorted(NAMES)
    record = json.loads(Path("framerate/framerate.json").read_text())
    assert [row["expression"] for row in record["rows"]] == ["happiness", "27"]
    assert record["machine"]["processor"]
    assert record["rows"][0]["drawing_ms"] > 0.0


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--expressions", "hapiness"], "did you mean 'happiness'"),
        (["--expressions", ","], "--expressions names none"),
        (["--size", "-5"], "--size -5 is outside"),
        (["--fps", "0"], "--fps 0 is outside"),
        (["--out", "file"], "output folder file is a file"),
    ],
)
def test_a_mistake_is_one_line_and_status_two(words: list[str], part: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The same manners as everywhere."""
    Path("file").write_text("")
    assert main(["framerate", "--backend", "toy", *words]) == 2
    assert part in capsys.readouterr().err.splitlines()[-1]
