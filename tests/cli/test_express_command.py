"""`faceanim express` from words to files, on a toy face with a toy solver."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from toys import toy_face

from faceanim.cli.choices import solver_options
from faceanim.cli.main import build_parser, main

QUICK = ["--backend", "toy", "--size", "48", "--fps", "10", "--duration", "0.6"]


@pytest.fixture(autouse=True)
def _toys(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, toy_backend: str) -> None:
    monkeypatch.setattr("faceanim.face.library.load_face", lambda *_: toy_face())
    monkeypatch.chdir(tmp_path)


def _record(folder: str = "frames") -> dict[str, Any]:
    return dict(json.loads(Path(folder, "run.json").read_text()))


def test_one_line_makes_pictures_film_sheet_and_record(capsys: pytest.CaptureFixture[str]) -> None:
    """Frames numbered from zero, a film of them all, a contact sheet, run.json; one closing line, nothing hidden."""
    assert main(["express", "27", *QUICK]) == 0
    names = sorted(path.name for path in Path("frames").iterdir())
    assert names == ["27.mp4", "contact_sheet.png", *(f"frame_{k:05d}.png" for k in range(6)), "run.json"]
    first, last = (cv2.imread(f"frames/frame_{k:05d}.png") for k in (0, 5))
    assert first.shape == (48, 48, 3)
    assert not np.array_equal(first, last)
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert out.startswith("27: 6 frames, 27.mp4, contact_sheet.png, run.json in frames; simulated ")
    assert "mm from the full run" in out


def test_the_record_says_what_was_run_and_how_well() -> None:
    """Options, versions, threads, the columns of Table 1, errors, movements and skin checks are in run.json."""
    assert main(["express", "happiness", "--au", "R12=0.5", "--jaw", "opening=0.2", *QUICK, "--quiet"]) == 0
    record = _record()
    assert record["expression"]["action_units"] == "6+L12+R12=0.5"
    assert record["expression"]["jaw"]["opening"] == 0.2
    assert record["expression"]["activation"]["zygomaticus_major_right"] > 0.0
    assert record["time"]["frames"] == 6
    assert record["time"]["timeline"]["onset"] == 0.5
    assert record["backend"] == {"name": "toy", "options": record["backend"]["options"]}
    assert record["machine"]["versions"]["faceanim"]
    assert {"dynamic", "quasi_static", "static", "partition_ms", "dynamic_ms", "drawing_ms", "fps"} <= set(
        record["table_1"]
    )
    assert record["accuracy_mm"]["partition"] == {"max": 0.0, "rms": 0.0}
    assert record["accuracy_mm"]["rest"]["max"] < 1e-9
    assert record["skin_worst_frame_mm"]["inverted_triangles"] == 0
    assert record["apex"]["movements"]["largest_movement_mm"] > 1.0
    assert record["files"][-1] == "run.json"


def test_saved_positions_are_the_frames(tmp_path: Path) -> None:
    """points.npy holds (frame, vertex, 3), the first frame at rest; the same command gives the same bytes."""
    command = ["express", "6+12+26", *QUICK, "--save-points", "--no-video", "--check", "none"]
    assert main([*command, "--out", "a"]) == 0
    assert main([*command, "--out", "b", "--threads", "1"]) == 0
    points = np.load("a/points.npy")
    assert points.shape == (6, 81, 3)
    assert np.array_equal(points[0], toy_face().mesh.points)
    assert Path("a/points.npy").read_bytes() == Path("b/points.npy").read_bytes()
    assert not list(Path("a").glob("*.mp4"))
    assert _record("a")["accuracy_mm"] is None


@pytest.mark.parametrize("colour", ["displacement", "strain"])
def test_views_stand_side_by_side_in_any_colour(colour: str) -> None:
    """Two views of 64 x 48 make frames of 128 x 48."""
    words = ["--views", "front,three-quarter", "--colour", colour, "--wireframe", "--show-skull", "--no-video"]
    assert main(["express", "12", "--backend", "toy", "--duration", "0.1", "--size", "64x48", *words]) == 0
    assert cv2.imread("frames/frame_00000.png").shape == (48, 128, 3)


def test_sets_need_a_partition(capsys: pytest.CaptureFixture[str]) -> None:
    """A solver without dynamic and static vertices has none to show, and says so."""
    assert main(["express", "12", *QUICK, "--colour", "sets"]) == 2
    assert "--colour sets shows the adaptive partition" in capsys.readouterr().err
    assert not Path("frames").exists()


def test_earlier_frames_are_not_overwritten_unasked(capsys: pytest.CaptureFixture[str]) -> None:
    """A second run into the same folder is refused, and allowed with --force."""
    assert main(["express", "12", *QUICK]) == 0
    before = Path("frames/run.json").read_bytes()
    assert main(["express", "26", *QUICK]) == 2
    assert "already holds 9 files" in capsys.readouterr().err
    assert Path("frames/run.json").read_bytes() == before
    assert main(["express", "26", *QUICK, "--force"]) == 0
    assert sorted(path.name for path in Path("frames").glob("*.mp4")) == ["26.mp4"]


def test_an_output_folder_under_a_file_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    """The message names the file in the way."""
    Path("file").write_text("")
    assert main(["express", "12", *QUICK, "--out", "file/frames"]) == 2
    assert "file is a file, not a folder" in capsys.readouterr().err


def test_divergence_leaves_no_picture(capsys: pytest.CaptureFixture[str]) -> None:
    """A run that leaves the finite numbers ends with status 1, names the frame, and leaves nothing behind."""
    assert main(["express", "12", *QUICK, "--option", "blow_up=0.25"]) == 1
    err = capsys.readouterr().err.splitlines()[-1]
    assert err.startswith("faceanim: error: the simulation diverged at frame 3 (t = 0.300 s")
    assert not Path("frames").exists()


def test_a_disk_that_fills_up_leaves_nothing_that_looks_whole(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Half-way through the frames the disk is full: status 1, one line, no frames, no run.json."""
    resource = pytest.importorskip("resource")
    assert main(["express", "12", *QUICK, "--out", "compiled"]) == 0
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, hard))
    try:
        status = main(["express", "12", *QUICK, "--no-video"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert status == 1
    assert "points.npy: cannot be written" in capsys.readouterr().err.splitlines()[-1]
    assert not Path("frames").exists()


def test_interruption_is_status_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Ctrl-C while drawing: one line, nothing left behind."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("faceanim.cli.production.PngSequence.write", interrupted)
    assert main(["express", "12", *QUICK]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "faceanim: error: interrupted"
    assert not Path("frames").exists()


def test_progress_is_on_standard_error_only(capsys: pytest.CaptureFixture[str]) -> None:
    """Stages are named while they run; --quiet leaves the closing line alone."""
    assert main(["express", "12", *QUICK]) == 0
    assert "faceanim: simulating ..." in capsys.readouterr().err
    assert main(["express", "12", *QUICK, "--force", "--quiet"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert out.count("\n") == 1


def test_unsound_skin_is_put_into_words() -> None:
    """What is wrong is named; what lies within the play of contact is not."""
    from faceanim.bench.metrics import Soundness
    from faceanim.cli.production import faults

    assert faults(Soundness(0, 0.05, 0.0, {"lips": 0.02})) == []
    words = faults(Soundness(3, 0.5, 0.2, {"lips": 1.25, "lids_left": 0.0}))
    assert words == [
        "3 triangles are turned over",
        "skin lies 0.5 mm inside bone",
        "skin lies 0.2 mm inside an eyeball",
        "lips cross by 1.2 mm",
    ]


@pytest.mark.parametrize(
    ("setting", "name", "value"),
    [
        ("cell_size=4.5", "cell_size", 4.5),
        ("box=0,0,0;10,20,30", "box", [[0.0, 0.0, 0.0], [10.0, 20.0, 30.0]]),
        ("cells=16", "cells", 16),
        ("hard=yes", "hard", True),
        ("rule=series", "rule", "series"),
    ],
)
def test_options_of_a_backend_are_read_as_what_they_are(setting: str, name: str, value: object) -> None:
    """Numbers, whole numbers, words, yes and no, and tables of numbers reach the backend's Options."""
    args = build_parser("express").parse_args(
        ["express", "blink", "--backend", "octree_mass_spring", "--option", setting]
    )
    assert getattr(solver_options(args), name) == value
