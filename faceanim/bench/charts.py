"""Figures made from saved tables: axes with units, one colour per kind everywhere."""

from __future__ import annotations

from pathlib import Path

from faceanim.bench.framerate import PAPER, Row

COLOURS = {"dynamic": "#c2543a", "quasi_static": "#e3a857", "drawing": "#5b7a99", "published": "#9a9a9a"}


def frame_rate_chart(rows: list[Row], path: Path, machine: str) -> None:
    """Draw milliseconds per frame by phase, and frames per second beside the published ones, into the PNG `path`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    phases, rates = figure.subplots(1, 2)
    names = [row.expression for row in rows]
    floor = [0.0] * len(rows)
    for kind, label in (("dynamic", "dynamic"), ("quasi_static", "quasi-static"), ("drawing", "drawing")):
        spent = [getattr(row, f"{kind}_ms") or 0.0 for row in rows]
        phases.bar(names, spent, bottom=floor, color=COLOURS[kind], label=label, width=0.65)
        floor = [a + b for a, b in zip(floor, spent)]
    phases.set_ylabel("time per frame [ms]")
    phases.set_title("where the time goes")
    phases.set_ylim(top=1.3 * max(floor))
    phases.legend(frameon=False, fontsize="small", ncols=3, loc="upper left")
    published = {row.expression: row.fps for row in PAPER}
    place = range(len(rows))
    rates.bar([k - 0.2 for k in place], [row.fps for row in rows], 0.4, color=COLOURS["dynamic"], label=machine)
    rates.bar(
        [k + 0.2 for k in place if names[k] in published],
        [published[name] for name in names if name in published],
        0.4,
        color=COLOURS["published"],
        label="Zhang, Prakash & Sung (Pentium III 730 MHz)",
    )
    rates.set_xticks(list(place), names)
    rates.set_ylabel("drawn frames per second [1/s]")
    rates.set_title("frame rate")
    rates.set_ylim(top=1.3 * max([row.fps for row in rows] + [published.get(name, 0.0) for name in names]))
    rates.legend(frameon=False, fontsize="small", loc="upper left")
    for axes in (phases, rates):
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(axis="x", rotation=35)
    figure.savefig(path, dpi=130)
