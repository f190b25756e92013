"""`faceanim claims`: the list, one claim with its files and verdict, all of them, and mistakes in one line."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import pytest

from faceanim.bench.claims.claim import CLAIMS, Claim, Criterion, Finding, Line, Request
from faceanim.cli.main import main
from faceanim.ground.errors import RunError
from faceanim.ground.notes import tell

ASKED: list[Request] = []


@dataclass(frozen=True)
class ToyClaim(Claim):
    """A claim that is measured at once: it finds `value` where the paper prints 1."""

    value: float = 1.0

    def measure(self, request: Request | None = None) -> Finding:
        """Tell something, remember the request, and fail if the value is negative."""
        tell("measuring a toy", 1, 2)
        if self.value < 0.0:
            raise RunError("the toy is broken")
        assert request is not None
        ASKED.append(request)
        lines = (Line("toy", "size", "mm", self.value, 1.0), Line("toy", "hidden", "mm", 2.0, None, "no", detail=True))
        criterion = Criterion("size [mm]", self.value, 0.9, 1.1, printed=True)
        return Finding(lines, (criterion,), lambda path: path.write_bytes(b"\x89PNG") and None)


@pytest.fixture(autouse=True)
def _toys(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    toys = {
        name: ToyClaim(name, "Table 0", "Nobody", "a toy", "nowhere:nothing", value=value)
        for name, value in (("toy", 1.05), ("mixed-fig-8", 3.0), ("broken", -1.0))
    }
    for name in list(CLAIMS):
        monkeypatch.delitem(CLAIMS, name)
    for name, toy in toys.items():
        monkeypatch.setitem(CLAIMS, name, toy)
    monkeypatch.chdir(tmp_path)
    ASKED.clear()


@pytest.mark.parametrize("words", [[], ["list"]])
def test_claims_are_listed(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """Without a name every claim is named with what it shows; nothing is measured or written."""
    assert main(["claims", *words]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in CLAIMS) and "a toy" in out
    assert not ASKED and not list(Path().iterdir())


def test_a_claim_leaves_table_picture_and_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    """PNG, CSV and Markdown are in the folder; the table is printed without details, and one sentence judges."""
    assert main(["claims", "toy", "--out", "found", "--rounds", "7", "--size", "0", "--quiet"]) == 0
    told = capsys.readouterr()
    assert "toy: reproduced: 1 of 1 criteria met." in told.out.splitlines()[-1]
    assert "hidden" not in told.out and told.err == ""
    assert sorted(p.name for p in Path("found").iterdir()) == ["toy.csv", "toy.md", "toy.png"]
    rows = list(csv.DictReader(Path("found/toy.csv").read_text(encoding="utf-8").splitlines()))
    assert rows[0]["ours"] == "1.05" and rows[0]["published"] == "1" and rows[1]["quantity"] == "hidden"
    assert "**Reproduced: " in Path("found/toy.md").read_text(encoding="utf-8")
    assert ASKED[0].rounds == 7 and ASKED[0].draw_frame is None and ASKED[0].moves == ("mandible_advance",)


def test_all_goes_on_after_a_failure_and_tells(capsys: pytest.CaptureFixture[str]) -> None:
    """Each claim is written as it is found, the overview at the end; what failed is named, and the status is 1."""
    assert main(["claims", "all", "--out", "found", "--moves", "le_fort_1,midface_lower"]) == 1
    told = capsys.readouterr()
    assert "broken failed: the toy is broken" in told.err and "measuring a toy" in told.err and "3 of 3" in told.err
    text = Path("found/claims.md").read_text(encoding="utf-8")
    assert "| [toy](toy.md) |" in text and "| not reproduced | 0 of 1 |" in text and "broken" not in text
    assert ASKED[1].moves == ("le_fort_1", "midface_lower") and ASKED[0].draw_frame is not None


@pytest.mark.parametrize(
    ("words", "part", "status"),
    [
        (["toyy"], "unknown claim 'toyy'; did you mean 'toy'?", 2),
        (["zhang"], "unknown claim 'zhang'; known: all, broken, list, mixed-fig-8, toy", 2),
        (["toy", "--out", "file"], "output folder file is a file", 2),
        (["toy", "--rounds", "0"], "--rounds 0 is outside", 2),
        (["toy", "--size", "-1"], "--size -1 is outside", 2),
        (["toy", "--moves", "le_fort_1"], "--moves belongs to mixed-fig-8", 2),
        (["mixed-fig-8", "--moves", "le_fort"], "did you mean 'le_fort_1'", 2),
        (["mixed-fig-8", "--moves", ","], "no operation is named", 2),
        (["toy", "--threads", "none"], "--threads 'none' is not a number", 2),
        (["broken"], "the toy is broken", 1),
    ],
)
def test_a_mistake_is_one_line(words: list[str], part: str, status: int, capsys: pytest.CaptureFixture[str]) -> None:
    """The same manners as everywhere, before anything is measured."""
    Path("file").write_text("")
    assert main(["claims", *words]) == status
    assert part in capsys.readouterr().err.splitlines()[-1]
    assert not ASKED
