"""The scripts in docs/examples run, write what they say, and end in the number that they promise."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest

from faceanim.backends import BACKENDS

EXAMPLES = Path(__file__).resolve().parent.parent / "docs" / "examples"


def main_of(name: str) -> Any:
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"]


def test_every_example_is_tested() -> None:
    """A script that is added gets a test below."""
    named = {path.stem for path in EXAMPLES.glob("*.py")}
    assert named == {"bar_bending", "twist_and_drag", "octree_block", "face_backends", "muscle_blocks"}


@pytest.mark.slow
def test_bar_bending(tmp_path: Path) -> None:
    """Warping leaves about an eighth of the linear bar's error under full gravity; without it, it would be 1."""
    assert main_of("bar_bending")(tmp_path) == pytest.approx(0.131, abs=0.01)
    assert (tmp_path / "bar_bending.png").stat().st_size > 20_000


@pytest.mark.slow
@pytest.mark.parametrize("what", ["bar", "face"])
def test_twist_and_drag(tmp_path: Path, what: str) -> None:
    """The node is where it was asked to be, to 1e-9, in every frame; frames, film and sheet are there."""
    assert main_of("twist_and_drag")(tmp_path, what, 30) < 1e-9
    assert len(list((tmp_path / "frames").glob("frame_*.png"))) == 30
    assert (tmp_path / "twist_and_drag.mp4").stat().st_size > 1000
    assert (tmp_path / "twist_and_drag.png").stat().st_size > 1000


@pytest.mark.slow
def test_the_block_at_four_levels(tmp_path: Path) -> None:
    """Level 1 is 5.5 % off the leaves, and the picture has something in it."""
    assert main_of("octree_block")(tmp_path) == pytest.approx(5.48, abs=0.1)
    assert (tmp_path / "octree_block.png").stat().st_size > 20_000


@pytest.mark.slow
def test_one_face_by_every_backend(tmp_path: Path) -> None:
    """In a smile modal warping is within a millimetre and a half of finite elements, and the table has every backend."""
    assert 0.1 < main_of("face_backends")(tmp_path) < 1.5
    table = (tmp_path / "face_backends.md").read_text(encoding="utf-8")
    assert all(table.count(f"| {backend} |") == 2 for backend in BACKENDS)
    assert (tmp_path / "face_backends.png").stat().st_size > 100_000


@pytest.mark.slow
def test_the_three_blocks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nitsche's weights with the paper's own fields stay within a hundredth of the truth, and four tables are printed."""
    assert main_of("muscle_blocks")(tmp_path) == pytest.approx(0.51, abs=0.05)
    assert (tmp_path / "muscle_blocks.png").stat().st_size > 20_000
    printed = capsys.readouterr().out
    assert all(f"Table {n}" in printed for n in range(1, 5))
