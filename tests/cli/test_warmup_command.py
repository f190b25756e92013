"""Compiling ahead: drawing is compiled beside the simulation, once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from faceanim.cli import warmup
from faceanim.cli.main import main


class _Process:
    started: list[list[str]]

    def __init__(self, command: list[str], **_: Any) -> None:
        self.started.append(command)
        self.waited = self.ended = False

    def wait(self) -> int:
        self.waited = True
        return 0

    def terminate(self) -> None:
        self.ended = True


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[list[str]]:
    """Command lines of the processes that were started; none really is."""
    commands: list[list[str]] = []
    monkeypatch.setattr(_Process, "started", commands, raising=False)
    monkeypatch.setattr(warmup.subprocess, "Popen", _Process)
    monkeypatch.setattr(warmup, "_mark", lambda: tmp_path / "drawing.compiled")
    return commands


def test_drawing_is_compiled_beside_the_simulation_once(started: list[list[str]], tmp_path: Path) -> None:
    """Where it has not been compiled a process does it; where it has, nothing is started."""
    with warmup.drawing_compiled() as finish:
        assert finish() == 0
    assert started[0][-4:] == ["warmup", "--only", "drawing", "--quiet"]
    (tmp_path / "drawing.compiled").touch()
    with warmup.drawing_compiled() as finish:
        finish()
    assert len(started) == 1


def test_an_unknown_part_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    """`warmup --only` knows two parts."""
    assert main(["warmup", "--only", "draw"]) == 2
    assert "did you mean 'drawing'" in capsys.readouterr().err


def test_warming_up_marks_what_is_compiled(
    started: list[list[str]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both parts run, progress goes to standard error, one closing line to standard output."""
    ran: list[str] = []
    monkeypatch.setattr(warmup, "_simulation", lambda backends: [("steps", lambda: ran.append("steps"))])
    monkeypatch.setattr(warmup, "_draw", lambda: ran.append("draw"))
    assert main(["warmup"]) == 0
    assert ran == ["steps", "draw"]
    assert (tmp_path / "drawing.compiled").exists()
    out, err = capsys.readouterr()
    assert out.startswith("compiled ahead in ")
    assert out.count("\n") == 1
    assert "compiling: drawing" in err
