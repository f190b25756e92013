"""Charts of a comparison: error against cost with the Pareto front, and the fronts of several scenes side by side."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby, pairwise, zip_longest
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from faceanim.bench.comparison.label_places import Clutter, place_labels
from faceanim.bench.comparison.row_words import FRAMES, backends, candidate, densities, missing, number, plain, settings
from faceanim.bench.comparison.rows import Comparison, Row, front, worst
from faceanim.bench.marks import colour, mark
from faceanim.ground.arrays import Floats

DPI = 150
INK, SOFT, BAND = "#26292e", "#6b7078", "#e4e2da"
SIZES = (7.0, 12.0)
"""Of the marks of the coarsest and of the finest density [point]."""
COST = "cost per frame [ms]"

Judge = Callable[[Row], float]


def pareto_chart(comparison: Comparison, path: Path) -> None:
    """Draw error against cost of all rows of a scene, with their Pareto front, into the PNG `path`.

    A second panel shows the error of the time stepping alone where a row has one.
    """
    with _plain_text():
        pareto_figure(comparison).savefig(path, dpi=DPI, format="png")


def overview_chart(comparisons: Sequence[Comparison], path: Path) -> None:
    """Draw the Pareto fronts of several scenes, one panel each, into the PNG `path`."""
    with _plain_text():
        overview_figure(comparisons).savefig(path, dpi=DPI, format="png")


def pareto_figure(comparison: Comparison) -> Any:
    """Return the figure of `pareto_chart`, laid out."""
    counted = [row for row in comparison.rows if row.counts]
    stepped = [row for row in counted if _scheme_rms(row) > 0.0]
    figure = _figure(13.0 if stepped else 9.0, 6.9)
    grid = figure.subplots(1, 2 if stepped else 1, width_ratios=(1.45, 1.0) if stepped else (1.0,), squeeze=False)[0]
    figure.suptitle(fill(comparison.title, 110), x=0.01, ha="left", fontsize=13, fontweight="bold", color=INK)
    sizes, best = _sizes(comparison.rows), {id(row) for row in front(comparison.rows)}
    panels = [_Panel(grid[0], counted, worst, comparison.uncertainty, sizes, best)]
    _name(grid[0], "error against cost; filled marks: the Pareto front", "error, RMS [mm]", missing(comparison.rows))
    if stepped:
        panels.append(_Panel(grid[1], stepped, _scheme_rms, 0.0, sizes, best))
        note = "against the same model, stepped finely; lines join steps"
        _name(grid[1], "what the time stepping alone costs", "error of the stepping, RMS [mm]", note)
    _legend(figure, comparison.rows, sizes)
    _settle(figure)
    panels[0].step_line()
    panels[0].label([row for row in counted if id(row) in best], _front_names(counted, best))
    if stepped:
        panels[1].join_steps()
        panels[1].label(*_one_each(stepped))
    return figure


def overview_figure(comparisons: Sequence[Comparison]) -> Any:
    """Return the figure of `overview_chart`, laid out."""
    columns = min(3, max(1, len(comparisons)))
    lines = -(-len(comparisons) // columns) or 1
    figure = _figure(4.3 * columns + 0.3, 3.5 * lines + 1.1)
    grid = figure.subplots(lines, columns, squeeze=False, sharex=True).ravel()
    every = [row for comparison in comparisons for row in comparison.rows]
    sizes = _sizes(every)
    span = [row.frame_ms or 1.0 for row in every if row.counts]
    for axes, comparison in zip(grid, comparisons, strict=False):
        counted = [row for row in comparison.rows if row.counts]
        best = {id(row) for row in front(comparison.rows)}
        panel = _Panel(axes, counted, worst, comparison.uncertainty, sizes, best, costs=span, small=True)
        axes.set_title(fill(comparison.scene, 44), loc="left", fontsize=11, fontweight="bold", color=INK)
        if comparison.movement > 0.0:
            _share_axis(axes, comparison.movement)
        panel.step_line()
        axes.tick_params(labelbottom=True)
        axes.set_xlabel(COST, fontsize=9, color=INK)
        axes.set_ylabel("error, RMS [mm]", fontsize=9, color=INK)
    for axes in grid[len(comparisons) :]:
        axes.set_visible(False)
    _legend(figure, every, sizes)
    _settle(figure)
    return figure


class _Panel:
    """One panel: rows by cost and error, log-log, with frame rates, uncertainty and quartiles of the cost."""

    def __init__(
        self,
        axes: Any,
        rows: Sequence[Row],
        judge: Judge,
        uncertainty: float,
        sizes: dict[str, float],
        best: set[int],
        *,
        costs: Sequence[float] = (),
        small: bool = False,
    ) -> None:
        self.axes, self.rows, self.best, self.small = axes, rows, best, small
        positive = [e for e in (judge(row) for row in rows) if e > 0.0]
        low, high = min(positive, default=0.01), max(positive, default=1.0)
        # An uncertainty far below all errors would only squeeze the chart.
        shown = 0.0 < uncertainty and uncertainty > low / 30.0
        bottom = 0.5 * (min(low, uncertainty) if shown else low)
        self.places = np.array([(row.frame_ms or 1.0, max(judge(row), 1.2 * bottom)) for row in rows]).reshape(-1, 2)
        axes.set_xscale("log")
        axes.set_yscale("log")
        costs = [*costs, *self.places[:, 0], *(1e3 / rate for rate, _ in FRAMES)]
        axes.set_xlim(min(costs) / 1.8, max(costs) * 1.8)
        axes.set_ylim(bottom, high * (high / bottom) ** 0.2)  # above: room for the names of the frame rates
        self._ground(uncertainty, shown)
        for row, place in zip(rows, self.places, strict=True):
            self._mark(row, place, sizes[row.density] * (0.7 if small else 1.0))
        if not rows:
            axes.text(0.5, 0.5, "no row was measured to the end", transform=axes.transAxes, ha="center", color=SOFT)

    def _ground(self, uncertainty: float, shown: bool) -> None:
        axes, size = self.axes, 7.5 if self.small else 9
        for rate, name in FRAMES:
            axes.axvline(1e3 / rate, color=SOFT, linewidth=1.0, linestyle=(0, (4, 3)), zorder=0.5)
            text = f" {name}" if not self.small else f" {rate:.0f}/s"
            across = axes.get_xaxis_transform()
            axes.text(1e3 / rate, 0.99, text, transform=across, rotation=90, va="top", ha="right", fontsize=size,
                      color=SOFT, gid="ground")  # fmt: skip
        if shown:
            axes.axhspan(axes.get_ylim()[0], uncertainty, color=BAND, linewidth=0.0, zorder=0.2)
        if uncertainty > 0.0 and not self.small:
            place = "in the band" if shown else "below the chart"
            axes.text(0.99, 0.01, f"{place}: the reference's own uncertainty, {number(uncertainty)} mm",
                      transform=axes.transAxes, va="bottom", ha="right", fontsize=9, color=SOFT, gid="ground")  # fmt: skip
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter("")
            axis.set_tick_params(labelsize=size + 0.5, colors=INK)
        axes.grid(which="major", color="#ececec", linewidth=0.7, zorder=0.1)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)

    def _mark(self, row: Row, place: Floats, size: float) -> None:
        ink, filled = colour(row.backend), id(row) in self.best
        if row.frame_low_ms and row.frame_high_ms and not self.small:
            ends = [min(row.frame_low_ms, place[0]), max(row.frame_high_ms, place[0])]
            self.axes.plot(ends, [place[1]] * 2, color=ink, linewidth=0.9, zorder=2.0, solid_capstyle="butt")
        self.axes.plot(
            *place,
            marker=mark(row.backend),
            markersize=size,
            markerfacecolor=ink if filled else "white",
            markeredgecolor=ink,
            markeredgewidth=1.1,
            linestyle="none",
            zorder=4.0 if filled else 3.0,
        )

    def step_line(self) -> None:
        """Draw the front as a staircase: nothing that was measured lies below and left of it, but for noise."""
        if corners := self._staircase():
            self.axes.plot(*zip(*corners, strict=True), color=INK, linewidth=1.3, zorder=1.8, gid="front")

    def _staircase(self) -> list[tuple[float, float]]:
        kept = sorted(tuple(place) for row, place in zip(self.rows, self.places, strict=True) if id(row) in self.best)
        if not kept:
            return []
        stairs = [corner for a, b in pairwise(kept) for corner in ((b[0], a[1]), b)]
        return [(kept[0][0], self.axes.get_ylim()[1]), kept[0], *stairs, (self.axes.get_xlim()[1], kept[-1][1])]

    def join_steps(self) -> None:
        """Join rows that differ in their step alone."""
        for line in self._lines():
            self.axes.plot(*line.T, color=SOFT, linewidth=0.8, zorder=1.7)

    def _lines(self) -> Iterator[Floats]:
        def key(k: int) -> tuple[str, ...]:
            row = self.rows[k]
            return row.backend, row.scheme, row.density, settings(row), str(row.threads)

        for _, group in groupby(sorted(range(len(self.rows)), key=key), key):
            yield self.places[sorted(group, key=lambda k: self.rows[k].step)]

    def label(self, rows: Sequence[Row], texts: Sequence[str]) -> None:
        """Write `texts` beside `rows`; say so if some find no room."""
        axes = self.axes
        at = {id(row): place for row, place in zip(self.rows, self.places, strict=True)}
        renderer = axes.figure.canvas.get_renderer()
        ground = [text for text in axes.texts if text.get_gid() == "ground"]
        clutter = Clutter([np.array(text.get_window_extent(renderer).extents) for text in ground])
        clutter.marks = axes.transData.transform(self.places) if len(self.places) else clutter.marks
        lines = [self._staircase()] if any(line.get_gid() == "front" for line in axes.lines) else list(self._lines())
        rates = [[(1e3 / rate, y) for y in axes.get_ylim()] for rate, _ in FRAMES]
        for line in [*lines, *rates]:
            for start, end in pairwise(axes.transData.transform(line) if len(line) else []):
                clutter.add_line(start, end)
        places = np.array([at[id(row)] for row in rows]).reshape(-1, 2)
        paper = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 0.6}
        style = {"fontsize": 9, "linespacing": 1.05, "color": INK, "zorder": 2.5, "bbox": paper}
        if left_out := place_labels(axes, places, texts, clutter, **style):
            axes.set_xlabel(f"{axes.get_xlabel()}   ({left_out} labels left out for want of room: see the table)")


def _scheme_rms(row: Row) -> float:
    rms = 0.0 if row.scheme_error is None else row.scheme_error.rms
    return rms if np.isfinite(rms) else 0.0


def _front_names(rows: Sequence[Row], best: set[int]) -> list[str]:
    """Return labels of the rows on the front, with their settings where they would be the same without."""
    chosen = [row for row in rows if id(row) in best]
    names = ["\n".join(candidate(row)) for row in chosen]
    return [
        fill(f"{name}, {settings(row)}", 40, replace_whitespace=False)
        if names.count(name) > 1 and row.settings
        else name
        for row, name in zip(chosen, names, strict=True)
    ]


def _one_each(rows: Sequence[Row]) -> tuple[list[Row], list[str]]:
    """Return one row of each scheme, its most accurate one, and the scheme's name."""
    chosen: dict[tuple[str, str], Row] = {}
    for row in sorted(rows, key=_scheme_rms):
        chosen.setdefault((row.backend, row.scheme), row)
    names = ["\n".join(plain(part) for part in pair if part) for pair in chosen]
    return list(chosen.values()), names


def _sizes(rows: Sequence[Row]) -> dict[str, float]:
    """Return the size of the marks of each density [point]."""
    names = densities(rows)
    steps = np.linspace(*SIZES, len(names)) if len(names) > 1 else [np.mean(SIZES)] * len(names)
    return dict(zip(names, map(float, steps), strict=True))


def _name(axes: Any, title: str, error: str, note: str) -> None:
    axes.set_title(title, loc="left", fontsize=11, color=INK, pad=20 if note else 6)
    if note:
        axes.text(0.0, 1.012, note, transform=axes.transAxes, fontsize=9, va="bottom", color=SOFT, gid="note")
    axes.set_xlabel(COST, fontsize=10, color=INK)
    axes.set_ylabel(error, fontsize=10, color=INK)


def _share_axis(axes: Any, movement: float) -> None:
    """Show beside the errors what share of the movement they are."""
    right = axes.secondary_yaxis("right", functions=(lambda e: 100.0 * e / movement, lambda s: s * movement / 100.0))
    right.yaxis.set_major_formatter("{x:g}")
    right.yaxis.set_minor_formatter("")
    right.tick_params(labelsize=8, colors=SOFT)
    right.set_ylabel("share of the movement [%]", fontsize=8, color=SOFT)
    right.spines["right"].set_color("#cccccc")


def _legend(figure: Any, rows: Sequence[Row], sizes: dict[str, float]) -> None:
    """Explain marks in one line, sizes and fillings in the next."""
    from matplotlib.lines import Line2D

    def entry(name: str, shape: str, ink: str, size: float, filled: bool = True) -> Any:
        face = ink if filled else "white"
        return Line2D(
            [], [], linestyle="none", marker=shape, color=ink, markerfacecolor=face, markersize=size, label=name
        )

    first = [entry(plain(name), mark(name), colour(name), 8.0) for name in backends(rows)]
    second = [entry(f"density {name}", "o", SOFT, size) for name, size in sizes.items()]
    second += [entry("on the front", "o", INK, 7.0), entry("beaten", "o", INK, 7.0, False)]
    second += [Line2D([], [], color=INK, linewidth=1.3, label="Pareto front")]
    blank = Line2D([], [], linestyle="none", label=" ")
    pairs = [handle or blank for pair in zip_longest(first, second) for handle in pair]
    columns = max(len(first), len(second))
    figure.legend(handles=pairs, ncols=columns, loc="outside lower center", frameon=False, fontsize=9.5,
                  handletextpad=0.4, columnspacing=1.4)  # fmt: skip


def _figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _settle(figure: Any) -> None:
    """Lay the figure out for good; names that hold a dollar sign are no formulas."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_parse_math(False)
    with _plain_text():
        figure.draw_without_rendering()
    figure.set_layout_engine("none")


@contextmanager
def _plain_text() -> Iterator[None]:
    """Draw letters that the font lacks as boxes, silently."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield
