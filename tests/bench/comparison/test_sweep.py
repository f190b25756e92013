"""A comparison in a folder: resumed where it stopped, never two at once, nothing lost by a stop or a broken process."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from faceanim.bench.comparison import sweep
from faceanim.bench.comparison.candidates import Candidate
from faceanim.bench.comparison.rows import Errors, Row, as_json, load
from faceanim.bench.comparison.scenes import SCENES
from faceanim.bench.comparison.sweep import TABLE, Sweep, blank
from faceanim.ground.errors import UserError

SCENE = SCENES["bar-tension"]
ONES = [Candidate("modal_warping", name, {"variant": name}, "coarse", 1) for name in ("linear", "warped", "consistent")]


def done(row: Row) -> Row:
    """Return the row as if it had been measured."""
    e = Errors(0.1, 0.2, 0.3, 0.01)
    return replace(row, outcome="done", reason="", frame_ms=1.0, frame_low_ms=0.9, frame_high_ms=1.1, rest=e, along=e)


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Stand in for the measuring process; the list names what was measured."""
    names: list[str] = []

    def stand_in(self: Sweep, row: Row, candidate: Candidate) -> Row:
        names.append(candidate.scheme)
        if candidate.scheme == "stop":
            raise KeyboardInterrupt
        return done(row)

    monkeypatch.setattr(Sweep, "measured", stand_in)
    return names


def run(folder: Path, ones: list[Candidate], **options: Any) -> Any:
    """Return the comparison of some candidates in a folder."""
    return Sweep(SCENE, ones, folder, **options).run("machine", lambda row: None)


def test_a_second_run_measures_nothing_again(tmp_path: Path, measured: list[str]) -> None:
    """The same rows come back, in the order that is asked for; `again` measures anew."""
    first = run(tmp_path, ONES)
    assert measured == ["linear", "warped", "consistent"]
    second = run(tmp_path, ONES[::-1])
    assert len(measured) == 3 and second.rows == first.rows[::-1]
    run(tmp_path, ONES[:1], again=True)
    assert len(measured) == 4


def test_a_stopped_run_goes_on_where_it_stopped(tmp_path: Path, measured: list[str]) -> None:
    """What was measured before the interruption is on disk; the next run measures the rest."""
    stop = Candidate("modal_warping", "stop", {}, "coarse", 1)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, [ONES[0], stop, ONES[1]])
    assert len(load((tmp_path / TABLE).read_bytes(), "table").rows) == 1
    measured.clear()
    assert len(run(tmp_path, ONES).rows) == 3
    assert measured == ["warped", "consistent"]


def test_rows_that_are_not_asked_for_stay(tmp_path: Path, measured: list[str]) -> None:
    """A smaller choice in the same folder loses nothing of the larger one."""
    run(tmp_path, ONES)
    extra = Candidate("modal_warping", "rotation_strain", {}, "coarse", 1)
    assert len(run(tmp_path, [extra]).rows) == 1
    measured.clear()
    run(tmp_path, [*ONES, extra])
    assert measured == []
    run(tmp_path, [extra], again=True)
    assert measured == ["rotation_strain"]
    assert len(load((tmp_path / TABLE).read_bytes(), "table").rows) == 4


def test_rows_of_an_older_program_are_measured_anew(
    tmp_path: Path, measured: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A change of the physics changes every key."""
    run(tmp_path, ONES[:1])
    monkeypatch.setattr(sweep, "physics_key", lambda backend: "another")
    run(tmp_path, ONES[:1])
    assert measured == ["linear", "linear"]


@pytest.mark.parametrize("content", [b"{", b"[]", b"\xff\xfe", b'{"scene": 1}'])
def test_a_damaged_table_is_an_error_and_stays(tmp_path: Path, measured: list[str], content: bytes) -> None:
    """The message names the file and the way out; the file is as it was."""
    (tmp_path / TABLE).write_bytes(content)
    with pytest.raises(UserError, match="move it away"):
        run(tmp_path, ONES)
    assert (tmp_path / TABLE).read_bytes() == content and measured == []


def test_a_table_of_another_scene_is_refused(tmp_path: Path, measured: list[str]) -> None:
    """Two scenes do not share a folder."""
    other = replace(run(tmp_path, ONES[:1]), scene="bar-bend")
    (tmp_path / TABLE).write_bytes(as_json(other))
    with pytest.raises(UserError, match="bar-bend"):
        run(tmp_path, ONES)


def test_two_runs_at_once_are_refused(tmp_path: Path, measured: list[str]) -> None:
    """While a process holds the folder another is turned away; afterwards it is free, however that process ended."""
    code = (
        "import sys, time; from pathlib import Path; from faceanim.bench.alone import alone\n"
        "with alone(Path(sys.argv[1])):\n    print('held', flush=True); time.sleep(60)\n"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
    try:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        with pytest.raises(UserError, match="another run"):
            run(tmp_path, ONES)
    finally:
        other.kill()
        other.communicate()
    assert len(run(tmp_path, ONES[:1]).rows) == 1


def test_a_process_that_dies_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed, out of patience or speaking nonsense: a row with the reason, and the comparison goes on."""
    monkeypatch.setattr(sweep.sys, "executable", "/bin/false")
    row = Sweep(SCENE, ONES, tmp_path).measured(blank(SCENE, ONES[0]), ONES[0])
    assert row.outcome == "failed" and "status 1" in row.reason


def test_one_candidate_in_a_process_of_its_own(tmp_path: Path) -> None:
    """The whole way once: a process measures, its row has cost, error and memory, and the last frame is on disk."""
    row = run(tmp_path, ONES[:1]).rows[0]
    assert row.outcome == "done", row.reason
    assert row.rest is not None and 0.03 < row.rest.relative < 0.12  # linear: a stretch of a third is beyond it
    assert row.threads == 1 and row.memory_mb is not None and row.machine
    assert (tmp_path / "last_frames" / f"{row.key}.npz").exists()
