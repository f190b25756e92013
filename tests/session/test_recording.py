"""Results: all of them or none, never over the work of an earlier run unless told so."""

from __future__ import annotations

import errno
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from faceanim.ground.errors import RunError, UserError
from faceanim.session.recording import PointsFile, Results, disk_errors, machine, plain, write_record


def _fill(results: Results, names: tuple[str, ...] = ("frame_0000.png", "frame_0001.png", "smile.mp4")) -> None:
    for name in names:
        results.part(name).write_text(name)
    write_record(results.part("run.json"), {"files": [*names, "run.json"]})


def test_results_appear_whole(tmp_path: Path) -> None:
    """Nothing is visible before the end; afterwards everything is, and nothing hidden is left."""
    out = tmp_path / "new" / "frames"
    with Results(out) as results:
        _fill(results)
        assert not [path for path in out.iterdir() if not path.name.startswith(".")]
        results.commit()
    assert sorted(path.name for path in out.iterdir()) == ["frame_0000.png", "frame_0001.png", "run.json", "smile.mp4"]


def test_a_failed_run_leaves_nothing(tmp_path: Path) -> None:
    """An error or an interruption half-way removes what was made, and the folder too if the run made it."""
    for trouble in (RunError("disk full"), KeyboardInterrupt()):
        with pytest.raises(type(trouble)), Results(tmp_path / "out") as results:
            _fill(results)
            raise trouble
        assert not (tmp_path / "out").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    with pytest.raises(RunError), Results(tmp_path / "mine") as results:
        raise RunError("no")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]


def test_earlier_results_are_kept_unless_told_otherwise(tmp_path: Path) -> None:
    """A folder that holds frames is refused; with overwrite the old results go, all of them, and nothing else."""
    with Results(tmp_path) as results:
        _fill(results)
        results.commit()
    (tmp_path / "holiday.mp4").write_text("mine")
    with pytest.raises(UserError, match=r"already holds 4 files.*--force"):
        Results(tmp_path)
    with Results(tmp_path, overwrite=True) as results:
        _fill(results, ("frame_0000.png",))
        results.commit()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame_0000.png", "holiday.mp4", "run.json"]


def test_a_failed_overwrite_keeps_the_old_results(tmp_path: Path) -> None:
    """The old results are removed only when the new ones are complete."""
    with Results(tmp_path) as results:
        _fill(results)
        results.commit()
    with pytest.raises(RunError), Results(tmp_path, overwrite=True) as results:
        raise RunError("no")
    assert (tmp_path / "frame_0001.png").read_text() == "frame_0001.png"


def test_what_a_killed_run_left_is_removed(tmp_path: Path) -> None:
    """The hidden folder of a process that is gone goes; that of a living one stays."""
    gone, living = tmp_path / ".faceanim-partial-999999999", tmp_path / f".faceanim-partial-{os.getppid()}"
    gone.mkdir()
    living.mkdir()
    with Results(tmp_path):
        pass
    assert not gone.exists()
    assert living.exists()


def test_folders_that_cannot_be_written_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file in the way and a folder without permission are the user's mistakes, found before any work."""
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"file is a file, not a folder; choose another --out"):
        Results(tmp_path / "file" / "frames")
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(UserError, match=r"cannot be written; choose another --out"):
        Results(tmp_path / "frames")


def test_a_full_disk_is_a_failed_run(tmp_path: Path) -> None:
    """The message names the file and the way out."""
    with (
        pytest.raises(RunError, match=r"run\.json: cannot be written \(No space.*make room"),
        disk_errors(tmp_path / "run.json"),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(RunError, match=r"none"):
        write_record(tmp_path / "none" / "run.json", {})


@dataclass
class _Pair:
    a: float
    b: np.ndarray


def test_records_hold_only_what_json_has(tmp_path: Path) -> None:
    """Arrays become lists, numbers that are not finite become null, anything else its name."""
    value = {"pair": _Pair(float("nan"), np.arange(2)), "path": Path("x"), 3: np.float64(2.5), "ok": (True, None)}
    write_record(tmp_path / "run.json", value)
    read = json.loads((tmp_path / "run.json").read_text())
    assert read == {"pair": {"a": None, "b": [0, 1]}, "path": "x", "3": 2.5, "ok": [True, None]}
    assert plain(np.int32(3)) == 3


def test_saved_points_read_back_exactly(tmp_path: Path) -> None:
    """What numpy.load returns is what was appended, to the bit."""
    points = np.random.default_rng(1).normal(size=(3, 5, 3))
    with PointsFile(tmp_path / "points.npy", 3, 5) as file:
        for frame in points:
            file.append(frame)
    assert np.array_equal(np.load(tmp_path / "points.npy"), points)


def test_the_machine_is_described() -> None:
    """Processor, cores, threads and versions are there."""
    found = machine()
    assert found["cores"] >= found["threads"] >= 1
    assert {"faceanim", "python", "numba", "numpy"} <= set(found["versions"])
    assert found["processor"]
