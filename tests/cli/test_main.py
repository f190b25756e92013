"""The command's door: fast to open, one line for every mistake, the right exit status."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import pytest

from faceanim.cli import main as door
from faceanim.ground.errors import RunError, UserError


def _run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "faceanim.cli.main", *words], capture_output=True, text=True)


def test_help_is_fast_and_imports_nothing_heavy() -> None:
    """`faceanim --help` answers within 0.15 s (best of five) and neither it nor a command's help loads NumPy."""
    spent = []
    for _ in range(5):
        start = perf_counter()
        out = _run("--help")
        spent.append(perf_counter() - start)
        assert out.returncode == 0
    assert min(spent) < 0.15
    code = (
        "import sys, contextlib, io\nfrom faceanim.cli.main import main\n"
        "for words in [[]] + [[w] for w in 'express framerate info warmup claims compare plan atlas'.split()]:\n"
        "    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):\n"
        "        main([*words, '--help'])\n"
        "print(*sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(out.stdout.split())
    assert not loaded & {"numpy", "numba", "matplotlib", "rich", "scipy", "cv2", "msgspec"}
    assert "faceanim.cli.express" in loaded


def test_without_a_command_the_help_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing asked, everything explained."""
    assert door.main([]) == 0
    assert "express" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["expres"], "unknown command 'expres'; did you mean 'express'?"),
        (["express"], "which expression? one of anger"),
        (["express", "hapiness"], "did you mean 'happiness'"),
        (["express", "happiness", "--au", "99"], "unknown action unit 99; nearest:"),
        (["express", "--au", "12=1.5"], "12 = 1.5 is outside 0..1"),
        (["express", "--au", "Q12"], "unknown side 'Q'"),
        (["express", "--activation", "zygomaticus_major_left=nan"], "not a number (nan)"),
        (["express", "--activation", "zygomaticus_major_left"], "write name=value"),
        (["express", "--jaw", "open=1"], "did you mean 'opening'"),
        (["express", "happiness", "--fps", "0"], "--fps 0 is outside its limits; give 1 to 1000"),
        (["express", "happiness", "--fps", "nan"], "--fps nan is outside"),
        (["express", "happiness", "--duration", "-1"], "--duration -1 is outside its limits; give more than 0 to 600"),
        (["express", "happiness", "--size", "0"], "--size 0 is outside its limits; give 16 to 4096"),
        (["express", "happiness", "--size", "1x2x3"], "write 512 or 640x480"),
        (["express", "happiness", "--size", "big"], "'big' is not a number"),
        (["express", "happiness", "--views", "frnt"], "did you mean 'front'"),
        (["express", "happiness", "--colour", "skinn"], "did you mean 'skin'"),
        (["express", "happiness", "--threads", "100000"], "--threads 100000 is outside"),
        (["express", "happiness", "--onset", "-1"], "--onset -1 is outside"),
        (["express", "happiness", "--check", "all"], "unknown check 'all'"),
        (["express", "happiness", "--face", "nobody"], "unknown face 'nobody'; known: default"),
        (["express", "happiness", "--density", "finest"], "did you mean 'fine'"),
        (["express", "happiness", "--backend", "mass_sprin"], "did you mean 'mass_spring'"),
        (["express", "happiness", "--scheme", "blockdescent"], "did you mean 'block_descent'"),
        (["express", "happiness", "--option", "sweep=3"], "did you mean 'sweeps'"),
        (["express", "happiness", "--option", "sweeps=some"], "'some' is not a number"),
        (["express", "happiness", "--partition-tolerance", "0"], "--partition-tolerance 0 is outside"),
        (["express", "happiness", "--full", "--adaptive"], "not allowed with argument"),
        (["express", "happiness", "--nonsense"], "unrecognized arguments: --nonsense"),
        (["info", "muscle"], "did you mean 'muscles'"),
    ],
)
def test_a_mistake_is_one_line_and_status_two(
    words: list[str], part: str, capsys: pytest.CaptureFixture[str], tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`faceanim: error:` with the value and the way out, nothing on standard output, nothing made."""
    monkeypatch.chdir(str(tmp_path))
    assert door.main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    complaint = [line for line in err.splitlines() if not line.endswith("...")]
    assert len(complaint) == 1
    assert complaint[0].startswith("faceanim: error: ")
    assert part in complaint[0]
    assert not list(tmp_path.iterdir())  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("error", "status", "part"),
    [
        (UserError("no\nsuch thing"), 2, "no such thing"),
        (RunError("disk full"), 1, "disk full"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (MemoryError(), 1, "out of memory"),
        (ZeroDivisionError("oops"), 1, "unexpected ZeroDivisionError: oops"),
        (PermissionError(13, "Permission denied", "x.npz"), 1, "x.npz: Permission denied"),
    ],
)
def test_every_failure_has_its_status(
    error: BaseException, status: int, part: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """2 for the user's mistake, 1 for a failed run, 130 for an interruption; never a traceback."""

    def fail(_: object) -> int:
        raise error

    monkeypatch.delenv("FACEANIM_DEBUG", raising=False)
    monkeypatch.setattr(door, "run", fail)
    assert door.main(["info"]) == status
    assert capsys.readouterr().err == f"faceanim: error: {part}" + (
        "; FACEANIM_DEBUG=1 shows where\n"
        if "unexpected" in part
        else "; choose a smaller size, density or duration\n"
        if "memory" in part
        else "\n"
    )


@pytest.mark.parametrize("topic", ["expressions", "action-units"])
def test_info_lists_what_there_is(topic: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Tables of what can be asked for, to standard output."""
    assert door.main(["info", topic]) == 0
    out = capsys.readouterr().out
    assert ("happiness" if topic == "expressions" else "lip corner puller") in out


def test_a_cache_that_cannot_be_written_is_replaced_and_told() -> None:
    """Compiled code goes to a temporary folder instead, and a notice names both folders."""
    code = "import faceanim.ground.jit; from faceanim.ground import folders; print(*folders.cache_notice())"
    environment = {**os.environ, "FACEANIM_CACHE": os.devnull + "/cache"}
    environment.pop("NUMBA_CACHE_DIR", None)
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert "kernel cache folder" in out.stdout
    assert "cannot be written" in out.stdout
    assert "; using " in out.stdout


def test_a_broken_asset_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A face file that was cut off, or is missing, is an error that names the file and the way out."""
    from faceanim.face import library

    shutil.copytree(library.asset_folder() / "expressions", tmp_path / "expressions")
    shutil.copy(library.asset_folder() / "action_units.toml", tmp_path)
    monkeypatch.setattr(library, "asset_folder", lambda: tmp_path)
    for content in (b"PK\x03\x04 cut off", None):
        if content is not None:
            (tmp_path / "face_default.npz").write_bytes(content)
        else:
            (tmp_path / "face_default.npz").unlink()
        assert door.main(["express", "happiness", "--quiet", "--out", str(tmp_path / "frames")]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert "face_default.npz is missing or broken" in err
        assert "reinstall faceanim" in err
    assert not (tmp_path / "frames").exists()
