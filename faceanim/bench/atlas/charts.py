"""Pictures of stability maps: a colour and a hatch per outcome, predicted limits as lines over them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from faceanim.bench.atlas.cells import OUTCOMES, Axis, Map, shown
from faceanim.bench.marks import OUTCOME_COLOURS

HATCHES = dict(zip(OUTCOMES, ("", "////", "\\\\\\\\", "", "....")))
LETTERS = dict(zip(OUTCOMES, ("", "w", "i", "n", "r")))
INK = dict(zip(OUTCOMES, ("#55524a", "#5c4300", "#3a1400", "#ffffff", "#3c434b")))
EDGE = {"bounded but wrong": "#c99a2b", "inverted": "#a8441c", "refused": "#8b94a0"}
"""Of the hatches."""
LINES = (("#0b3c5d", "-"), ("#0b3c5d", (0, (4, 2))), ("#1f7a8c", ":"))
FIRST = ("paper", "paper, tangent", "semi_implicit", "explicit, undivided", "explicit", "block_descent",
         "conjugate_gradient", "newton")  # fmt: skip


def edges(axis: Axis) -> list[float]:
    """Return the borders between the cells of an axis, one more than cells, in its drawn scale."""
    v = [math.log10(x) for x in axis.values] if axis.log else list(range(len(axis.values)))
    if len(v) == 1:
        return [v[0] - 0.5, v[0] + 0.5]
    middle = [0.5 * (a + b) for a, b in pairwise(v)]
    return [v[0] - (middle[0] - v[0]), *middle, v[-1] + (v[-1] - middle[-1])]


def place(axis: Axis, value: float) -> float:
    """Return where a value lies along an axis as drawn; between two cells of a linear axis, in proportion."""
    if axis.log:
        return math.log10(value) if value > 0 else -math.inf
    if axis.words or len(axis.values) < 2:
        return value
    v = axis.values
    k = next((k for k in range(1, len(v) - 1) if value < v[k]), len(v) - 1)
    return k - 1 + (value - v[k - 1]) / (v[k] - v[k - 1])


def figure(width: float, height: float) -> Any:
    """Return an empty figure [inch]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made


def draw_map(axes: Any, one: Map, *, letters: bool = True, labels: bool = True) -> None:
    """Draw a map into Matplotlib axes."""
    from matplotlib.patches import Rectangle

    across, up = edges(one.x), edges(one.y)
    for i, j, cell in shown(one):
        corner, width, height = (across[i], up[j]), across[i + 1] - across[i], up[j + 1] - up[j]
        colour = OUTCOME_COLOURS[cell.outcome]
        hatch = "" if letters else HATCHES[cell.outcome]
        axes.add_patch(Rectangle(corner, width, height, facecolor=colour, edgecolor=EDGE.get(cell.outcome, colour),
                                 hatch=hatch, linewidth=0.0))  # fmt: skip
        axes.add_patch(Rectangle(corner, width, height, fill=False, edgecolor="#ffffff", linewidth=0.6))
        if letters and LETTERS[cell.outcome]:
            axes.text(corner[0] + 0.5 * width, corner[1] + 0.5 * height, LETTERS[cell.outcome], ha="center",
                      va="center", fontsize=9, weight="bold", color=INK[cell.outcome])  # fmt: skip
    axes.set_xlim(across[0], across[-1])
    axes.set_ylim(*((up[-1], up[0]) if one.y.words else (up[0], up[-1])))
    _ticks(axes, one, labels)
    for limit, (colour, dash) in zip(one.limits or [], LINES):
        _line(axes, one, limit, colour, dash)
    axes.spines[:].set_color("#9a958a")


def _ticks(axes: Any, one: Map, labels: bool) -> None:
    for axis, there, ticks in ((one.x, axes.xaxis, axes.set_xticks), (one.y, axes.yaxis, axes.set_yticks)):
        where = [place(axis, v) for v in axis.values] if axis.log else list(range(len(axis.values)))
        names = axis.words or [_short(v, axis) for v in axis.values]
        keep = [k for k in range(len(where)) if not axis.log or len(where) <= 9 or _round(axis.values[k])]
        ticks([where[k] for k in keep], [names[k] for k in keep])
        there.set_tick_params(labelsize=8, length=2)
        if labels:
            there.set_label_text(f"{axis.title} [{axis.unit}]" if axis.unit else axis.title)
    if one.x.words:
        axes.tick_params(axis="x", rotation=40)
        for text in axes.get_xticklabels():
            text.set_horizontalalignment("right")


def _round(value: float) -> bool:
    power = math.log10(value)
    return abs(power - round(power)) < 1e-6


def _short(value: float, axis: Axis) -> str:
    if axis.unit == "s" and value < 1.0:
        return f"1/{1.0 / value:.0f}"
    return f"{value:g}"


def _line(axes: Any, one: Map, limit: Any, colour: str, dash: Any) -> None:
    points = [(place(one.x, a), place(one.y, b)) for a, b in zip(limit.x, limit.y)]
    from matplotlib.patheffects import Normal, Stroke

    if one.y.words:
        for k, (a, b) in enumerate(points):
            label = limit.label if k == 0 else None
            axes.plot([a, a], [b - 0.5, b + 0.5], color=colour, linestyle=dash, linewidth=2.2, label=label)
        return
    points = [p for p in points if all(map(math.isfinite, p))]
    style: dict[str, Any] = {"color": colour, "linestyle": dash, "linewidth": 2.2, "label": limit.label}
    style["path_effects"] = [Stroke(linewidth=4.6, foreground="#ffffff"), Normal()]
    axes.plot(*zip(*points), **style) if points else None


def _legend(made: Any, *, letters: bool, where: str = "lower", size: float = 9.0, columns: int = 3) -> None:
    from matplotlib.patches import Patch

    handles = [
        Patch(facecolor=OUTCOME_COLOURS[o], edgecolor=EDGE.get(o, "#9a958a"), hatch="" if letters else HATCHES[o],
              label=f"{LETTERS[o]}  {o}".strip() if letters else o)
        for o in OUTCOMES
    ]  # fmt: skip
    made.legend(handles=handles, loc=f"outside {where} center", ncols=columns, frameon=False, fontsize=size)


def map_chart(one: Map, path: Path) -> None:
    """Draw one map into the PNG `path`."""
    wide = max(6.0, 0.42 * len(one.x.values) + (3.6 if one.y.words else 1.8))
    made = figure(wide, max(3.4, 0.32 * len(one.y.values) + (2.9 if one.x.words else 2.3)))
    axes = made.subplots()
    draw_map(axes, one)
    made.suptitle(f"{one.scene}: {one.title}" if one.backend == "" else f"{one.scene}: {_plain(one)}", fontsize=11)
    if one.limits:
        axes.legend(fontsize=7.5, loc="best", framealpha=0.9)
    _legend(made, letters=True)
    made.savefig(path, dpi=120)


def _plain(one: Map) -> str:
    return f"{one.backend}, {one.scheme}" if one.scheme else one.backend


def overview(maps: Sequence[Map], path: Path) -> bool:
    """Draw the maps over time step and stiffness side by side, those of mass_spring first; False if there are none."""
    chosen = _of_overview(maps)
    if not chosen:
        return False
    columns = min(4, len(chosen))
    rows = -(-len(chosen) // columns)
    made = figure(3.05 * columns + 0.4, 2.75 * rows + 1.0)
    grid = made.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for k, axes in enumerate(grid.ravel()):
        if k >= len(chosen):
            axes.set_visible(False)
            continue
        draw_map(axes, chosen[k], letters=False, labels=False)
        axes.set_title(_words(chosen[k]), fontsize=12)
        if chosen[k].limits:
            axes.legend(*_first(axes), fontsize=9, loc="upper right", framealpha=0.95, handlelength=1.6)
        axes.tick_params(labelsize=10)
    made.supxlabel("time step [s]", fontsize=12)
    made.supylabel("stiffness, times that of skin", fontsize=12)
    _legend(made, letters=False, where="upper", size=12.0, columns=len(OUTCOMES))
    made.savefig(path, dpi=130)
    return True


def _of_overview(maps: Sequence[Map]) -> list[Map]:
    grids = [one for one in maps if one.kind == "time"]
    skin = [one for one in grids if one.backend == "mass_spring"]
    scene = next((s for s in ("sheet", "face", "bar") if any(one.scene == s for one in skin or grids)), "")
    order = {name: k for k, name in enumerate(FIRST)}
    return sorted((one for one in skin or grids if one.scene == scene), key=lambda one: order.get(one.scheme, 99))[:8]


def _first(axes: Any) -> tuple[list[Any], list[str]]:
    """Return handles and labels of the lines that are drawn, each once."""
    found: dict[str, Any] = {}
    for handle, label in zip(*axes.get_legend_handles_labels()):
        found.setdefault(label, handle)
    return list(found.values()), [label.partition(":")[0] for label in found]


def _words(one: Map) -> str:
    return (one.scheme or one.backend).replace("_", " ")
