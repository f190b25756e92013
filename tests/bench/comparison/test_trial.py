"""One candidate measured: its row holds cost and error, and every way to fail is an outcome with a reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from broken import registry

from faceanim.backends import BACKENDS
from faceanim.bench.comparison import trial
from faceanim.bench.comparison.candidates import Candidate
from faceanim.bench.comparison.reference import reference
from faceanim.bench.comparison.rows import Row
from faceanim.bench.comparison.scenes import SCENES
from faceanim.bench.comparison.sweep import blank

SCENE = SCENES["bar-tension"]


def measured(backend: str, settings: dict[str, object] | None = None, limit: float = 60.0) -> Row:
    """Return the row of a candidate on the coarse hanging bar."""
    candidate = Candidate(backend, "test", settings or {}, "coarse", 1)
    return trial.measure(SCENE, candidate, blank(SCENE, candidate), limit)


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register backends that are wrong on purpose."""
    for name, place in registry().items():
        monkeypatch.setitem(BACKENDS, name, place)


def test_a_row_holds_cost_and_error(tmp_path: Path) -> None:
    """The nonlinear elements come to the exact balance within 0.5 %; costs are positive and ordered, memory known."""
    candidate = Candidate("finite_elements", "test", {}, "coarse", 1)
    row = trial.measure(SCENE, candidate, blank(SCENE, candidate), 60.0, str(tmp_path / "last.npz"))
    assert row.outcome == "done" and row.reason == ""
    assert row.rest is not None and row.along is not None
    assert row.rest.relative < 0.005 and row.rest.rms <= row.rest.p95 * 2 and row.rest.p95 <= row.rest.max
    assert 0.0 < row.frame_low_ms <= row.frame_ms <= row.frame_high_ms  # type: ignore[operator]
    assert row.frames == SCENE.frames and row.setup_s is not None and row.memory_mb is not None and row.unknowns > 100
    assert row.inverted == 0 and row.regions == {} and row.scheme_error is None
    points = np.load(tmp_path / "last.npz")["points"]
    assert points.shape == SCENE.stage("coarse").body.surface.points.shape


def test_errors_repeat_to_the_bit() -> None:
    """Two measurements of one candidate give the same errors, whatever they cost."""
    first, second = measured("modal_warping"), measured("modal_warping")
    assert (first.rest, first.along, first.key) == (second.rest, second.along, second.key)


@pytest.mark.parametrize(
    ("backend", "outcome", "words"),
    [
        ("exploding", "diverged", "away"),
        ("nan", "diverged", "nan"),
        ("inside_out", "inverted", "inside out"),
        ("starving", "failed", "MemoryError"),
        ("mass_spring", "refused", "gravity"),
    ],
)
def test_failures_are_outcomes_with_a_reason(broken: None, backend: str, outcome: str, words: str) -> None:
    """A backend that is wrong, gives up or declines gets a row that says so and cannot stand on a front."""
    row = measured(backend)
    assert row.outcome == outcome and words in row.reason
    assert not row.counts


def test_a_backend_that_does_not_move_is_all_wrong(broken: None) -> None:
    """It comes through, with an error as large as the movement: its row says 100 %."""
    row = measured("frozen")
    assert row.rest is not None and row.rest.relative == pytest.approx(1.0)


def test_the_time_limit_is_a_reason() -> None:
    """A run over the limit is stopped and says how far it came."""
    row = measured("finite_elements", limit=1e-6)
    assert row.outcome == "too slow" and "1 of 24 frames" in row.reason


def test_errors_of_known_fields() -> None:
    """RMS, 95 %, largest and relative error of a shift of 3 mm in one of twenty points that all move by 10 mm."""
    wanted = np.tile([10.0, 0.0, 0.0], (20, 1))
    found = wanted.copy()
    found[3, 1] += 3.0
    e = trial.errors(found, wanted)
    assert e.rms == pytest.approx(3.0 / np.sqrt(20.0)) and e.max == pytest.approx(3.0)
    assert e.relative == pytest.approx(e.rms / 10.0) and 0.0 <= e.p95 < 3.0


def test_the_reference_of_the_hanging_bar_is_exact() -> None:
    """Its balance is the closed form; at the lower end it agrees with the series of the stretch's integral."""
    found = reference(SCENE)
    assert found.balance_error == 0.0 and found.motion_error < 0.02
    tip = SCENE.probes[:, 0] > 99.9
    s = np.linspace(0.0, 1.04e-6 * 6 * 9810.0 / 15.0 * 100.0, 20001)
    stretch = 0.5 * (s + np.sqrt(s**2 + 4.0))
    length = 100.0 * float((0.5 * (stretch[1:] + stretch[:-1])).mean())
    np.testing.assert_allclose(found.balance[tip, 0], length - 100.0, atol=1e-3)
