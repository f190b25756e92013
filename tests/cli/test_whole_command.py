"""`faceanim express` on the real face (coarse), with the real solver and the real renderer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from faceanim.cli.main import main
from faceanim.expression.library import load_expression
from faceanim.face.library import load_face
from faceanim.session.session import Session

QUICK = ["--density", "coarse", "--size", "96", "--fps", "20", "--duration", "0.9", "--onset", "0.3", "--quiet"]


@pytest.fixture(scope="module")
def smile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a short smile."""
    folder = tmp_path_factory.mktemp("smile") / "frames"
    words = ["--save-points", "--threads", "1"]
    assert main(["express", "happiness", *QUICK, *words, "--out", str(folder)]) == 0
    return folder


def test_the_pictures_show_a_face_that_changes(smile: Path) -> None:
    """Frames differ from each other where the mouth is, and none is empty."""
    pictures = [cv2.imread(str(path)).astype(float) for path in sorted(smile.glob("frame_*.png"))]
    assert len(pictures) == 18
    assert all(picture.std() > 10.0 for picture in pictures)
    change = np.abs(pictures[-1] - pictures[0]).sum(axis=2)
    assert change.max() > 30.0
    assert change[:40].mean() < change[40:].mean()


def test_the_record_shows_an_accurate_run(smile: Path) -> None:
    """The partition stays within 0.3 mm of the full run, the held apex within 0.1 mm of its equilibrium."""
    record = json.loads((smile / "run.json").read_text())
    assert record["accuracy_mm"]["partition"]["max"] < 0.3
    assert record["accuracy_mm"]["rest"]["max"] < 0.1
    moved = record["apex"]["movements"]
    for side in ("left", "right"):
        assert all(moved[f"mouth_corner_{side}_{way}_mm"] > 0.5 for way in ("out", "up", "back"))
    table = record["table_1"]
    assert table["dynamic"] > 0
    assert table["static"] > 0
    assert table["dynamic"] + table["quasi_static"] + table["static"] == record["face"]["vertices"]


def test_the_skin_stays_out_of_bone_and_eyeballs(smile: Path) -> None:
    """No vertex enters bone or an eyeball by more than a tenth of a millimetre in any frame."""
    skin = json.loads((smile / "run.json").read_text())["skin_worst_frame_mm"]
    assert max(skin["depth_in_bone"], skin["depth_in_eyeball"]) < 0.1


def test_no_triangle_folds_and_no_lip_crosses(tmp_path: Path) -> None:
    """On the default face the skin never folds and lips never pass through each other by 0.1 mm, in any frame."""
    words = ["--density", "default", "--size", "32", "--no-video"]
    assert main(["express", "happiness", *QUICK, *words, "--out", str(tmp_path)]) == 0
    skin = json.loads((tmp_path / "run.json").read_text())["skin_worst_frame_mm"]
    assert skin["inverted_triangles"] == 0
    assert max(skin["depth_crossed"].values()) < 0.1


def test_a_symmetric_expression_is_symmetric(smile: Path) -> None:
    """Left and right are mirror images within 1e-6 mm in every frame."""
    face = load_face(density="coarse")
    points = np.load(smile / "points.npy")
    assert np.abs(points - points[:, face.mirror] * [-1.0, 1.0, 1.0]).max() < 1e-6


def test_threads_do_not_change_a_bit(smile: Path, tmp_path: Path) -> None:
    """The same command with another number of threads gives the same bytes of positions."""
    words = ["--save-points", "--threads", "2" if (os.cpu_count() or 1) > 1 else "1", "--check", "none", "--no-video"]
    assert main(["express", "happiness", *QUICK, *words, "--out", str(tmp_path)]) == 0
    assert (tmp_path / "points.npy").read_bytes() == (smile / "points.npy").read_bytes()


def test_the_frame_loop_allocates_next_to_nothing() -> None:
    """No frame needs new memory worth a quarter of one copy of the positions of this small mesh."""
    session = Session(load_face(density="coarse"), load_expression("happiness"), duration=0.5)
    frames = session.frames(copy=False)
    next(frames)
    next(frames)
    tracemalloc.start()
    spent = []
    before = 0
    for _ in frames:
        now, peak = tracemalloc.get_traced_memory()
        spent.append(peak - before)
        before = now
        tracemalloc.reset_peak()
    tracemalloc.stop()
    assert np.median(spent) < 0.25 * session.body.surface.points.nbytes


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["happiness", "sadness", "surprise", "fear", "anger", "disgust", "contempt", "blink", "27", "18", "22"]
)
def test_every_expression_is_sound_in_every_frame(name: str, tmp_path: Path) -> None:
    """No triangle turned over, no skin in bone or eyeball, no lip or lid crossed, on the default face."""
    words = ["--size", "64", "--quiet", "--no-video", "--out", str(tmp_path)]
    assert main(["express", name, *words]) == 0
    record = json.loads((tmp_path / "run.json").read_text())
    skin = record["skin_worst_frame_mm"]
    assert skin["inverted_triangles"] == 0
    assert max(skin["depth_in_bone"], skin["depth_in_eyeball"], *skin["depth_crossed"].values()) < 0.1
    assert record["accuracy_mm"]["partition"]["max"] < 0.3
    assert record["accuracy_mm"]["rest"]["max"] < 0.1


@pytest.mark.slow
def test_the_way_is_right_too(tmp_path: Path) -> None:
    """The smile follows the converged trajectory within 2 % of its movement (RMS over vertices and frames)."""
    assert main(["express", "happiness", *QUICK, "--check", "trajectory", "--out", str(tmp_path)]) == 0
    accuracy = json.loads((tmp_path / "run.json").read_text())["accuracy_mm"]
    assert accuracy["trajectory_share"] < 0.02


@pytest.mark.slow
def test_a_read_only_cache_is_told_and_does_no_harm(tmp_path: Path) -> None:
    """With a cache folder that cannot be written the command works, and says where it keeps its files instead."""
    environment = {**os.environ, "FACEANIM_CACHE": os.devnull + "/cache"}
    words = ["express", "12", "--density", "coarse", "--size", "32", "--duration", "0.1", "--check", "none"]
    command = [sys.executable, "-m", "faceanim.cli.main", *words, "--out", str(tmp_path / "frames")]
    out = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert out.returncode == 0
    assert "kernel cache folder" in out.stderr
    assert (tmp_path / "frames" / "run.json").exists()
