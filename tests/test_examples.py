"""The scripts in docs/examples run, write what they say, and end in the number that they promise."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "docs" / "examples"


@pytest.mark.slow
def test_twist_and_drag(tmp_path: Path) -> None:
    """The end of the bar is where it was asked to be, to 1e-9, in every frame; frames, film and sheet are there."""
    main = runpy.run_path(str(EXAMPLES / "twist_and_drag.py"))["main"]
    assert main(tmp_path, 30) < 1e-9
    assert len(list((tmp_path / "frames").glob("frame_*.png"))) == 30
    assert (tmp_path / "twist_and_drag.mp4").stat().st_size > 1000
    assert (tmp_path / "twist_and_drag.png").stat().st_size > 1000
