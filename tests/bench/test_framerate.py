"""The frame-rate table: complete, beside the published one, and saved so that others can read it."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from toys import ToyOptions, toy_face

from faceanim.bench.accuracy import apex_frame, measure
from faceanim.bench.charts import frame_rate_chart
from faceanim.bench.framerate import COLUMNS, PAPER, as_csv, as_markdown, beside_paper, cells, frame_rate, shares
from faceanim.expression.library import load_expression
from faceanim.session.session import Session


def _session(**options: object) -> Session:
    chosen = ToyOptions(**options)  # type: ignore[arg-type]
    return Session(toy_face(), load_expression("27"), backend="toy", options=chosen, fps=10.0, duration=1.2)


@pytest.mark.usefixtures("toy_backend")
def test_a_row_adds_up() -> None:
    """Simulation and drawing make the frame rate; a step that sleeps 4 ms, three times a frame, costs at least 12 ms."""
    row = frame_rate(_session(pause=0.004), lambda points, t: None)
    assert row.dynamic == 81
    assert row.quasi_static == row.static == 0
    assert row.dynamic_ms + row.quasi_static_ms >= 12.0
    assert row.drawing_ms is not None
    assert row.fps == pytest.approx(1e3 / (row.dynamic_ms + row.quasi_static_ms + row.drawing_ms))
    assert row.real_time == pytest.approx(100.0 / (row.dynamic_ms + row.quasi_static_ms))
    assert row.rest_max == pytest.approx(0.0, abs=1e-9)


@pytest.mark.usefixtures("toy_backend")
def test_a_partition_is_measured_against_the_full_run() -> None:
    """Only an adaptive run has an error of its partition; the last accuracy holds everything that was asked for."""
    for adaptive in (True, False):
        session = _session(adaptive=adaptive)
        positions = np.stack([frame.points for frame in session])
        found = list(measure(session, positions, trajectory=True))[-1]
        assert (found.partition is not None) == adaptive
        assert found.rest is not None
        assert found.trajectory is not None
        assert found.trajectory.max < 1e-9
        assert found.largest_movement > 1.0
        assert apex_frame(session) == 11
    assert shares(_session(adaptive=True), rounds=4)[0].share == 1.0
    assert shares(_session(adaptive=False)) == []


def test_the_published_figures_are_those_of_the_paper() -> None:
    """Vertices add up to 7,373 and the frame rate to the sum of the three times, to rounding."""
    for row in PAPER:
        assert row.dynamic + row.quasi_static + row.static == 7373
        assert row.drawing_ms is not None
        assert row.fps == pytest.approx(1e3 / (row.dynamic_ms + row.quasi_static_ms + row.drawing_ms), rel=0.006)


def test_tables_read_back(tmp_path: Path) -> None:
    """CSV and Markdown hold every row; the published row follows ours; the chart is a picture."""
    rows = list(PAPER)
    read = list(csv.DictReader(io.StringIO(as_csv(rows))))
    assert [r["expression"] for r in read] == [row.expression for row in PAPER]
    assert float(read[0]["fps"]) == 34.8
    lines = as_markdown(rows).splitlines()
    assert len(lines) == 2 + 2 * len(rows)
    assert all(line.count("|") == len(COLUMNS) + 1 for line in lines)
    assert beside_paper(rows)[0][1] is PAPER[0]
    assert cells(rows[0])[8] == "34.8"
    frame_rate_chart(rows, tmp_path / "chart.png", "this machine")
    assert (tmp_path / "chart.png").read_bytes()[:4] == b"\x89PNG"
