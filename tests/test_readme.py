"""The README tells the truth: its code runs, its commands exist, its links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
TEXT = README.read_text(encoding="utf-8")


def test_the_python_example_runs() -> None:
    """Every python block runs as it stands, and ends with points: those of the last frame, or its own."""
    blocks = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
    assert blocks
    for block in blocks:
        space: dict[str, object] = {}
        exec(compile(block, str(README), "exec"), space)
        points = space["frame"].points if "frame" in space else space["points"]  # type: ignore[attr-defined]
        assert np.isfinite(points).all()
        assert points.shape[1] == 3


def test_relative_links_and_pictures_exist() -> None:
    """What the README shows or points to is in the repository."""
    targets = re.findall(r"\]\(([^)#\s]+)\)", TEXT) + re.findall(r'src="([^"]+)"', TEXT)
    missing = [t for t in targets if "://" not in t and not (ROOT / t).exists()]
    assert not missing


@pytest.mark.parametrize("line", sorted(set(re.findall(r"^(faceanim [^\n#|&>]+)", TEXT, flags=re.MULTILINE))))
def test_every_command_line_is_understood(line: str) -> None:
    """Each command and option that the README names is one that the parser knows."""
    import shlex

    from faceanim.cli.main import COMMANDS, build_parser

    words = shlex.split(line)[1:]
    assert words[0] in COMMANDS or words[0].startswith("--")
    if words[0] in COMMANDS:
        build_parser(words[0]).parse_args(words)
