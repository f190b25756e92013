"""Charts of a comparison: written, labelled without overlap, and sound whatever was measured."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from comparisons import failed_row, made_comparison, made_row
from PIL import Image

from faceanim.bench.comparison.charts import overview_chart, overview_figure, pareto_chart, pareto_figure
from faceanim.bench.comparison.label_places import Clutter, arranged
from faceanim.bench.comparison.rows import Comparison, front


def boxes(figure: Any, gid: str = "label") -> list[Any]:
    """Return the pixel boxes of the labels, for each panel."""
    renderer = figure.canvas.get_renderer()
    return [[t.get_window_extent(renderer) for t in a.texts if t.get_gid() == gid] for a in figure.axes]


def crowded() -> Comparison:
    """Return a comparison with a front of many rows close together."""
    rows = [made_row(key=str(k), label=str(k), frame_ms=1.25**k, rest=None, scheme=f"scheme_{k}") for k in range(14)]
    for k, r in enumerate(rows):
        object.__setattr__(r.along, "rms", 1.0 / (1.0 + 0.1 * k))
    return made_comparison(rows=rows)


@pytest.fixture(scope="module")
def figure() -> Any:
    return pareto_figure(made_comparison())


@pytest.mark.parametrize("seed", [2, 3])
def test_labels_do_not_overlap(seed: int) -> None:
    """Boxes of all labels are apart and inside their panel; every row of the front has one."""
    comparison = made_comparison(seed=seed)
    figure = pareto_figure(comparison)
    found = boxes(figure)
    assert len(found[0]) == len(front(comparison.rows)) and len(found[1]) == 7
    for axes, group, ground in zip(figure.axes, found, boxes(figure, "ground")):
        panel = axes.get_window_extent(figure.canvas.get_renderer())
        for box in group:
            assert panel.x0 <= box.x0 and box.x1 <= panel.x1 and panel.y0 <= box.y0 and box.y1 <= panel.y1
            assert not any(box.overlaps(other) for other in ground)
        assert not any(a.overlaps(b) for a, b in combinations(group, 2))


def test_a_crowded_front_is_labelled_or_says_what_is_left_out() -> None:
    """Where there is no room for all labels, none overlap and the axis tells how many are missing."""
    figure = pareto_figure(crowded())
    found = boxes(figure)[0]
    assert not any(a.overlaps(b) for a, b in combinations(found, 2))
    assert len(found) == 14 or f"{14 - len(found)} labels left out" in figure.axes[0].get_xlabel()


def test_labels_without_room_are_left_out() -> None:
    """Two labels in a frame for one: one is placed inside, the other is not."""
    frame, size = np.array([0.0, 0.0, 60.0, 30.0]), np.array([50.0, 20.0])
    placed = arranged(np.array([[10.0, 10.0], [20.0, 20.0]]), [size, size], frame, Clutter(), 100.0)
    inside = [box for box in placed if box is not None]
    assert len(inside) == 1
    assert (inside[0][:2] >= 0.0).all() and (inside[0][2:] <= frame[2:]).all()


FEW = made_comparison().rows[:6]
CASES = {
    "many rows": made_comparison(),
    "one row": made_comparison(rows=[made_row()]),
    "no rows": made_comparison(rows=[]),
    "all failed": made_comparison(rows=[failed_row(), failed_row("too slow", "600 s")]),
    "done without figures": made_comparison(rows=[made_row(along=None, rest=None)]),
    "no uncertainty": made_comparison(rows=FEW, uncertainty=0.0),
    "uncertainty above all": made_comparison(rows=FEW, uncertainty=20.0),
    "tiny uncertainty": made_comparison(rows=FEW, uncertainty=1e-9),
    "no error at all": made_comparison(
        rows=[made_row(rest=None, along=type(made_row().along)(0.0, 0.0, 0.0, 0.0)), made_row(key="k1")]  # type: ignore[misc]
    ),
    "formula in names": made_comparison(
        title="$\\frac{1$ & <b>", rows=[made_row(backend="$x_", scheme="^$\\", density="\u6c34")]
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_every_comparison_gives_a_chart(case: str, tmp_path: Path) -> None:
    """Both charts are written as pictures with something on them."""
    path = tmp_path / "chart.png"
    pareto_chart(CASES[case], path)
    with Image.open(path) as picture:
        assert picture.format == "PNG" and picture.width > 1000
        assert np.asarray(picture.convert("L")).min() < 100
    overview_chart([CASES[case]], path)
    assert path.stat().st_size > 1000


def test_the_front_is_a_staircase_and_its_marks_are_filled(figure: Any) -> None:
    """The line takes only level and upright pieces, and passes every row of the front, whose marks alone are filled."""
    comparison = made_comparison()
    (line,) = [line for line in figure.axes[0].lines if line.get_gid() == "front"]
    corners = line.get_xydata()
    assert ((np.diff(corners, axis=0) == 0.0).sum(axis=1) == 1).all()
    best = front(comparison.rows)
    for row in best:
        assert np.isclose(corners[:, 0], row.frame_ms).any()
    marks = [line for line in figure.axes[0].lines if line.get_marker() not in ("None", None, "")]
    assert sum(m.get_markerfacecolor() != "white" for m in marks) == len(best)
    assert len(marks) == sum(row.counts for row in comparison.rows)


def test_failed_rows_are_counted_beside_the_chart(figure: Any) -> None:
    """The note says how many rows have no place and why."""
    notes = [t.get_text() for t in figure.axes[0].texts if t.get_gid() == "note"]
    assert notes[0].startswith("not on the chart: 5 rows (1 diverged, 1 inverted")


def test_stepping_is_shown_only_where_it_was_measured(figure: Any) -> None:
    """Without errors of the stepping there is one panel."""
    assert len(pareto_figure(made_comparison(rows=[made_row(scheme_error=None)])).axes) == 1
    assert len(figure.axes) == 2


@pytest.mark.slow
def test_the_overview_has_a_panel_for_each_scene() -> None:
    """Five scenes give five visible panels with their names."""
    names = ["bar", "smile", "lips", "jaw", "sheet"]
    figure = overview_figure([made_comparison(name, k, movement=float(k)) for k, name in enumerate(names)])
    assert [axes.get_title(loc="left") for axes in figure.axes if axes.get_visible()] == names
    assert len(overview_figure([]).axes) == 1
