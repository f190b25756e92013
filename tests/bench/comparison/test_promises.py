"""What plans promise on expressions that they are not made from, and that `express` keeps to them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from faceanim.bench.comparison import memory
from faceanim.bench.comparison.candidates import candidate_of
from faceanim.bench.comparison.plan import cost
from faceanim.bench.comparison.rows import worst
from faceanim.bench.comparison.scenes import scene_named
from faceanim.bench.comparison.sweep import Sweep
from faceanim.cli.main import main

pytestmark = pytest.mark.slow

BACKENDS, DENSITIES = ("modal_warping", "weighted_residual"), ("coarse",)


@pytest.fixture(scope="module")
def own_memory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A memory of this module alone, filled as plans ask for it."""
    folder = tmp_path_factory.mktemp("memory")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory, "user_cache", lambda: folder)
        yield folder


@pytest.mark.parametrize("name", ["face-sadness", "face-disgust@0.6", "face-blink@0.5"])
def test_the_promise_holds_where_nothing_was_measured(own_memory: Path, name: str, tmp_path: Path) -> None:
    """The error that comes out is within the tolerance, though it was only forecast; so is the cost of a frame."""
    found = memory.plan_for(scene_named(name), 3.0, 30.0, backends=BACKENDS, densities=DENSITIES, unseen=True)
    assert not found.measured and found.trials > 0 and "forecast" in found.sentence()
    assert found.chosen is not None
    row = Sweep(scene_named(name), [candidate_of(found.chosen.row)], tmp_path).run("machine", lambda row: None).rows[0]
    assert row.counts, row.reason
    assert worst(row) <= 3.0
    assert cost(row, 30.0)[0] < 1e3 / 30.0


def test_an_impossible_wish_is_refused_with_the_way_out(own_memory: Path) -> None:
    """A hundredth of a millimetre is beyond all of them; the sentence says what is not."""
    found = memory.plan_for(
        scene_named("face-sadness"), 0.01, 30.0, backends=BACKENDS, densities=DENSITIES, unseen=True
    )
    assert found.chosen is None and "allow" in found.sentence()


def test_express_does_what_the_plan_says(own_memory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Backend, density and step are those that were chosen, and run.json tells the promise; else status 1."""
    words = ["express", "sadness", "--fps", "30", "--backend", "modal_warping", "--density", "coarse", "--duration", "0.2",
             "--size", "64", "--no-video", "--check", "none", "--quiet"]  # fmt: skip
    assert main([*words, "--tolerance", "3", "--out", str(tmp_path / "kept")]) == 0
    record = json.loads((tmp_path / "kept" / "run.json").read_text())
    assert record["backend"]["name"] == "modal_warping" and record["face"]["density"] == "coarse"
    assert record["plan"]["tolerance_mm"] == 3.0 and record["plan"]["promised_mm"] <= 3.0
    assert main([*words, "--tolerance", "0.01", "--out", str(tmp_path / "broken")]) == 1
    assert "nothing meets 0.01 mm" in capsys.readouterr().err
    assert not (tmp_path / "broken" / "run.json").exists()
