"""The octree example runs, draws a picture and ends in its number."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).resolve().parent.parent / "docs" / "examples" / "octree_block.py"


@pytest.mark.slow
def test_the_block_at_four_levels(tmp_path: Path) -> None:
    """Level 1 is 5.5 % off the leaves, and the picture has something in it."""
    spec = importlib.util.spec_from_file_location("octree_block", EXAMPLE)
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    picture = tmp_path / "block.png"
    assert example.main(picture) == pytest.approx(5.48, abs=0.1)
    assert picture.stat().st_size > 20_000
