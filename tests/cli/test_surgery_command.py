"""`faceanim surgery` as a user types it: what it makes, what it says, and what it keeps when things go wrong."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import cv2
import meshio
import numpy as np
import pytest
import trimesh

from faceanim.backends import BACKENDS
from faceanim.cli.choices import solver_options
from faceanim.cli.main import build_parser, main
from faceanim.ground.errors import UserError

QUICK = ["--density", "coarse", "--preview", "--size", "96", "--quiet"]
MADE = {
    "before.png", "after.png", "map.png", "bones.png", "statistics.csv", "statistics.json", "run.json",
    "skin_before.ply", "skin_after.ply", "bones_after.ply", "flesh.vtu",
}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a quick chin advance on the coarse face."""
    folder = tmp_path_factory.mktemp("surgery") / "chin"
    assert main(["surgery", "genioplasty", "--out", str(folder), *QUICK]) == 0
    return folder


def test_everything_is_there(made: Path) -> None:
    """All files, and run.json lists them."""
    assert {path.name for path in made.iterdir()} == MADE
    record = json.loads((made / "run.json").read_text(encoding="utf-8"))
    assert set(record["files"]) == MADE
    assert record["converged"] is True and record["fraction"] == 1.0 and record["failure"] is None
    assert record["backend"]["options"]["model"] == "linear"
    assert record["bones"]["chin"]["volume_mm3"] > 1000.0
    assert record["plan"]["piece"][0]["name"] == "chin"
    assert record["bone_travel_mm"] == pytest.approx(6.0)


def test_other_programs_can_read_the_meshes(made: Path) -> None:
    """trimesh the skins and bones, meshio the flesh; the scalars are those of the statistics."""
    before, after = (trimesh.load(made / f"skin_{when}.ply", process=False) for when in ("before", "after"))
    assert before.vertices.shape == after.vertices.shape == (3774, 3)
    way = np.linalg.norm(after.vertices - before.vertices, axis=1)
    data = after.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(data["displacement"].ravel(), way, atol=1e-4)
    assert 3.0 < np.abs(data["distance"]).max() < 7.0
    bones = trimesh.load(made / "bones_after.ply", process=False)
    assert set(np.unique(bones.metadata["_ply_raw"]["vertex"]["data"]["bone"])) == {0, 1, 2}
    flesh = meshio.read(made / "flesh.vtu")
    assert {"displacement", "bone"} <= set(flesh.point_data)
    assert {"material", "volume_ratio", "von_mises_strain", "least_stretch"} <= set(flesh.cell_data)
    held = flesh.point_data["bone"] == 2
    assert np.linalg.norm(flesh.point_data["displacement"][held], axis=1).max() == pytest.approx(6.0, abs=1e-6)


def test_figures_and_pictures(made: Path) -> None:
    """The chin has come forward, the forehead has not; pictures have three views and are not empty."""
    with (made / "statistics.csv").open(encoding="utf-8") as file:
        rows = {row["region"]: row for row in csv.DictReader(file)}
    assert float(rows["chin"]["signed_mean_mm"]) > 1.0 and float(rows["forehead"]["max_abs_mm"]) < 0.2
    assert rows["forehead, moved"]["mean_abs_mm"] == ""
    told = json.loads((made / "statistics.json").read_text(encoding="utf-8"))["regions"]
    assert told["chin"]["mean"] == pytest.approx(float(rows["chin"]["mean_abs_mm"]), rel=1e-4)
    for name, width in (("before", 3 * 96), ("after", 3 * 96), ("map", 3 * 96 + 84)):
        picture = cv2.imread(str(made / f"{name}.png"))
        assert picture is not None and picture.shape == (96, width, 3) and picture.std() > 20.0
    assert (cv2.imread(str(made / "before.png")) != cv2.imread(str(made / "after.png"))).any()  # type: ignore[operator]


def test_a_folder_in_use_is_left_alone(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Until --force is given."""
    before = (made / "run.json").read_bytes()
    assert main(["surgery", "genioplasty", "--out", str(made), *QUICK]) == 2
    assert "--force" in capsys.readouterr().err
    assert (made / "run.json").read_bytes() == before


PLAN = """
title = "block"
[[piece]]
name = "block"
bone = "jaw"
planes = [{ point = [0.0, -75.0, 80.0], normal = [0.0, -1.0, 0.0] }]
[[piece.move]]
translation = [0.0, 0.0, 3.0]
"""


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("-75.0", "-175.0", "leaves nothing"),
        ("-75.0", "175.0", "whole bone"),
        ("[0.0, 0.0, 3.0]", "[0.0, 7.0, 0.0]", "into the rest of the jaw"),
        ("[0.0, 0.0, 3.0]", "[0.0, 0.0, 70.0]", "at most 60 mm"),
        ('"jaw"', '"femur"', "unknown bone 'femur'; known: cranium, jaw"),
        ("[[piece]]", "[piece", "mine.toml"),
        ("title", "titel", "unknown field `titel`"),
        ("", "#" + "x" * 300_000, "larger than"),
    ],
)
def test_a_bad_plan_is_the_users_mistake(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, word: str
) -> None:
    """Exit status 2, one line that names it, nothing left behind."""
    path, out = tmp_path / "mine.toml", tmp_path / "out"
    path.write_text(PLAN.replace(old, new, 1), encoding="utf-8")
    assert main(["surgery", str(path), "--out", str(out), *QUICK]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and word in said and said.startswith("faceanim: ")
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["genioplastie"], "genioplasty"),
        (["missing.toml"], "No such file"),
        (["genioplasty", "--backend", "magic"], "unknown backend 'magic'"),
        (["genioplasty", "--option", "laww=linear"], "law"),
        (["genioplasty", "--preview", "--steps", "3"], "--preview"),
        (["genioplasty", "--steps", "0"], "--steps"),
        (["genioplasty", "--size", "9"], "--size"),
        (["genioplasty", "--density", "superfine"], "'fine'"),
        ([], "PLAN"),
    ],
)
def test_bad_words_are_the_users_mistake(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    """Exit status 2 and one line that names the way out."""
    assert main(["surgery", *words, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.splitlines()
    assert said in error[-1] and not (tmp_path / "out").exists()


def test_a_run_that_fails_keeps_its_last_balance(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit status 1, one closing line with the way out, all files, and run.json says how far it got.

    Every load step had its line, and --force has replaced what was in the folder.
    """
    monkeypatch.setitem(BACKENDS, "halting", "halting:SolverHalting")
    out = tmp_path / "out"
    out.mkdir()
    (out / "before.png").write_bytes(b"old")
    (out / "mine.txt").write_text("kept", encoding="utf-8")
    words = ["--density", "coarse", "--backend", "halting", "--steps", "2", "--size", "96", "--force"]
    assert main(["surgery", "genioplasty", "--out", str(out), *words]) == 1
    said = capsys.readouterr()
    assert "50% of the way" in said.err and not said.out
    last = said.err.splitlines()[-1]
    assert "75.0%" in last and "--steps" in last and last.endswith(f"is in {out}")
    assert {path.name for path in out.iterdir()} == {*MADE, "mine.txt"}
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert record["converged"] is False and record["fraction"] == pytest.approx(0.75)
    assert record["failure"] in last
    flesh = meshio.read(out / "flesh.vtu")
    assert np.linalg.norm(flesh.point_data["displacement"], axis=1).max() == pytest.approx(4.5, abs=1e-6)
    assert cv2.imread(str(out / "before.png")) is not None


def test_an_interrupt_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Control-C while the flesh is searched for its balance: exit status 130 and no folder."""
    import faceanim.surgery.predict as predict

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(predict, "make_solver", interrupted)
    assert main(["surgery", "genioplasty", "--out", str(tmp_path / "out"), *QUICK]) == 130
    assert not (tmp_path / "out").exists()


def test_help_loads_nothing_heavy() -> None:
    """Neither the compiler nor the plotter, nor NumPy."""
    code = (
        "import sys\nfrom faceanim.cli.main import main\n"
        "try:\n    main(['surgery', '--help'])\nexcept SystemExit:\n    pass\n"
        "print([m for m in ('numba', 'matplotlib', 'numpy', 'trimesh') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "--preview" in out.stdout and out.stdout.strip().endswith("[]")


@pytest.mark.slow
def test_the_papers_mid_face_advance(tmp_path: Path) -> None:
    """The default face and solver: the nose comes forward, within a minute."""
    out = tmp_path / "out"
    assert main(["surgery", "midface_advance", "--out", str(out), "--quiet", "--threads", "2"]) == 0
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert record["seconds"]["solve"] < 60.0
    assert 5.0 < record["movement_mm"]["nose"]["signed_mean"] < 12.0
    assert record["movement_mm"]["forehead"]["max"] < 0.5


def test_flags_without_a_default_are_read() -> None:
    """`--option shell=false` is a flag although its default is neither true nor false."""
    parser = build_parser("surgery")
    asked = ["surgery", "genioplasty", "--backend", "mixed_fem"]
    args = parser.parse_args([*asked, "--option", "shell=false", "--option", "pressure=yes"])
    options = solver_options(args)
    assert options.shell is False and options.pressure is True and options.homogeneous is None
    with pytest.raises(UserError, match="true or false is needed"):
        solver_options(parser.parse_args([*asked, "--option", "shell=perhaps"]))
