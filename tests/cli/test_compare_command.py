"""`faceanim compare` and `faceanim plan`: their files, their words, and what they refuse."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from faceanim.bench.comparison.rows import front, load
from faceanim.cli.main import main

QUICK = ["--quick", "--backends", "modal_warping,weighted_residual", "--densities", "coarse", "--quiet"]


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small comparison."""
    folder = tmp_path_factory.mktemp("compared")
    assert main(["compare", "bar-tension", "--out", str(folder), *QUICK]) == 0
    return folder


def test_every_row_of_table_page_and_chart_is_a_measured_run(compared: Path) -> None:
    """JSON, CSV and page hold the same rows; each done one left its last frame and its picture."""
    comparison = load((compared / "comparison.json").read_bytes(), "table")
    assert len(comparison.rows) >= 2 and front(comparison.rows)
    with (compared / "comparison.csv").open(newline="") as file:
        flat = list(csv.DictReader(file))
    assert [row["key"] for row in flat] == [row.key for row in comparison.rows]
    page = (compared / "comparison.html").read_text()
    for row in comparison.rows:
        assert row.label in page
        if row.outcome == "done":
            assert (compared / "last_frames" / f"{row.key}.npz").exists()
            assert row.picture is not None and (compared / row.picture).exists()
    assert (compared / "comparison.png").stat().st_size > 10_000
    assert json.loads((compared / "comparison.json").read_text())["machine"]


def test_a_smaller_choice_loses_nothing(compared: Path) -> None:
    """A run of fewer candidates in the same folder shows those, and the table keeps the others."""
    before = {row.key for row in load((compared / "comparison.json").read_bytes(), "table").rows}
    fewer = ["--quick", "--backends", "weighted_residual", "--densities", "coarse", "--quiet"]
    assert main(["compare", "bar-tension", "--out", str(compared), *fewer]) == 0
    assert {row.key for row in load((compared / "comparison.json").read_bytes(), "table").rows} == before
    assert main(["compare", "bar-tension", "--out", str(compared), *QUICK]) == 0


@pytest.mark.slow
def test_a_repetition_changes_no_error(compared: Path, tmp_path: Path) -> None:
    """Measured again elsewhere, errors are the same to the last digit."""
    assert main(["compare", "bar-tension", "--out", str(tmp_path), *QUICK]) == 0
    first, second = (load((folder / "comparison.json").read_bytes(), "t").rows for folder in (compared, tmp_path))
    assert [(r.key, r.rest, r.along, r.outcome) for r in first] == [(r.key, r.rest, r.along, r.outcome) for r in second]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["compare", "bar-bent"], "bar-bend"),
        (["compare", "bar-bend", "--backends", "springs"], "mass_spring"),
        (["compare", "bar-bend", "--backends", "octree_mass_spring", "--densities", "fine"], "nothing is left"),
        (["compare", "bar-bend", "--limit", "0"], "--limit"),
        (["plan"], "which scene"),
        (["plan", "bar-bent"], "bar-bend"),
        (["plan", "bar-bend", "--tolerance", "0"], "--tolerance"),
        (["plan", "bar-bend", "--fps", "x"], "--fps"),
        (["plan", "bar-bend", "--against", "luck"], "reference"),
        (["express", "happiness", "--tolerance", "1", "--scheme", "newton"], "exclude each other"),
        (["express", "happiness", "--tolerance", "1", "--against", "luck"], "reference"),
    ],
)
def test_wrong_words_are_refused_in_one_line(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Status 2, one line that names what can be said instead."""
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.strip().splitlines()) == 1


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A damaged table is named, with the way out, and not overwritten."""
    (tmp_path / "comparison.json").write_text("not a table")
    assert main(["compare", "bar-tension", "--out", str(tmp_path), *QUICK]) == 2
    assert "move it away" in capsys.readouterr().err
    assert (tmp_path / "comparison.json").read_text() == "not a table"


def test_scenes_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    """Without a scene the command says which there are."""
    assert main(["compare"]) == 0
    assert "face-smile" in capsys.readouterr().out


@pytest.fixture
def own_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Remember measurements in a folder of this test alone."""
    monkeypatch.setattr("faceanim.bench.comparison.memory.user_cache", lambda: tmp_path / "memory")


PLAN = ["plan", "bar-tension", "--backends", "modal_warping,finite_elements", "--densities", "coarse", "--quiet"]


@pytest.mark.slow
def test_a_plan_is_measured_and_its_promise_holds(own_memory: None, capsys: pytest.CaptureFixture[str]) -> None:
    """A loose wish gets something cheap, a strict one the elements that are exact, an impossible one the way out."""
    assert main([*PLAN, "--tolerance", "1", "--fps", "60"]) == 0
    assert "measured on this machine" in capsys.readouterr().out
    assert main([*PLAN, "--tolerance", "0.2", "--fps", "5"]) == 0
    assert "finite_elements neo_hookean" in capsys.readouterr().out
    assert main([*PLAN, "--tolerance", "0.001", "--fps", "60"]) == 1
    assert "nothing meets 0.001 mm" in capsys.readouterr().out
