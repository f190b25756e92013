"""Pictures of the claims: axes with units, and lines that differ by colour, mark and stroke, to be read in grey too."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from faceanim.bench import marks
from faceanim.ground.arrays import Floats

if TYPE_CHECKING:
    from faceanim.bench.bone_contact import Contact
    from faceanim.bench.claims.choi_ko import Cost, Example
    from faceanim.bench.framerate import Row
    from faceanim.bench.gravity_bar import Swing
    from faceanim.bench.muscle_blocks import Column
    from faceanim.bench.surgery_models import Row as ModelRow

PUBLISHED = "#8a8a8a"
"""Of everything that the papers print."""
BAR_STYLES: dict[str, dict[str, Any]] = {
    "linear": {"color": "#c77d4f", "linestyle": "--", "marker": "^", "label": "linear modes"},
    "warped": {"color": marks.colour("modal_warping"), "linestyle": "-", "marker": "s", "label": "warped modes"},
    "consistent": {"color": "#5fb3bf", "linestyle": "-.", "marker": "o", "label": "consistent (ours)"},
    "rotation_strain": {"color": "#0b3c49", "linestyle": ":", "marker": "D", "label": "rotation-strain (ours)"},
    "nonlinear": {
        "color": marks.colour("finite_elements"), "linestyle": (0, (6, 1)), "marker": marks.mark("finite_elements"),
        "label": "nonlinear finite elements",
    },
}  # fmt: skip


@contextmanager
def _figure(path: Path, panels: int, size: tuple[float, float], **options: Any) -> Iterator[list[Any]]:
    """Yield `panels` axes side by side, then write them into the PNG `path`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    all_axes = list(figure.subplots(1, panels, squeeze=False, **options)[0])
    for axes in all_axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=11)
        axes.xaxis.label.set_size(12)
        axes.yaxis.label.set_size(12)
        axes.title.set_size(13)
    yield all_axes
    figure.savefig(path, dpi=120)


def _legend(axes: Any, **options: Any) -> None:
    axes.legend(**({"frameon": False, "fontsize": 11} | options))


def bars(rest: Floats, shapes: Mapping[float, Mapping[str, Floats]], path: Path) -> None:
    """Draw the outlines of the bars' middle planes, one panel per gravity: `shapes` gravity -> model -> nodes (n, 3)."""
    middle = np.abs(rest[:, 2] - 0.1) < 1e-9
    rim = [
        np.flatnonzero(middle & (np.abs(rest[:, 1]) < 1e-9)),
        np.flatnonzero(middle & (np.abs(rest[:, 0] - 1.0) < 1e-9)),
        np.flatnonzero(middle & (np.abs(rest[:, 1] - 0.2) < 1e-9))[::-1],
    ]
    outline = np.concatenate([rim[0][np.argsort(rest[rim[0], 0])], rim[1][np.argsort(rest[rim[1], 1])],
                              rim[2][np.argsort(-rest[rim[2], 0])]])  # fmt: skip
    with _figure(path, len(shapes), (10.5, 5.2), sharex=True, sharey=True) as panels:
        for axes, (g, models) in zip(panels, shapes.items(), strict=True):
            axes.fill(*rest[outline, :2].T, color="#e8e8e8", label="at rest")
            for name, x in models.items():
                axes.plot(*x[outline, :2].T, markevery=5, markersize=6, linewidth=1.8, **BAR_STYLES[name])
            axes.set(title=f"g = {g:g} m/s$^2$", xlabel="x [m]", aspect="equal")
        panels[0].set_ylabel("y [m]")
        _legend(panels[0], loc="lower left")


def gravity(
    gravities: Sequence[float], errors: Mapping[str, list[float]], volumes: Mapping[str, list[float]], path: Path
) -> None:
    """Draw error and relative change of volume against gravity, by model."""
    with _figure(path, 2, (12.0, 5.4)) as (left, right):
        for axes, curves in ((left, errors), (right, volumes)):
            for name, values in curves.items():
                axes.plot(gravities, values, markersize=7, linewidth=1.8, **BAR_STYLES[name])
            axes.set_xlabel("gravity [m/s$^2$]")
            axes.set_xticks(gravities)
        left.set_ylabel("relative L2 error of the displacements [-]")
        left.set_title("(a) error towards nonlinear finite elements")
        right.set_ylabel("change of volume, V / V$_0$ - 1 [-]")
        right.set_title("(b) change of volume")
        right.set_yscale("symlog", linthresh=0.1, linscale=1.5)
        right.axhline(0.0, color="#bbbbbb", linewidth=0.8, zorder=0)
        right.set_yticks([-0.1, -0.05, 0.0, 0.05, 0.1, 0.3, 1.0, 2.0], ["-0.1", "-0.05", "0", "0.05", "0.1", "0.3", "1",
                                                                       "2"])  # fmt: skip
        handles, labels = right.get_legend_handles_labels()
        right.figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=11)


def swings(found: Sequence[Swing], path: Path) -> None:
    """Draw the error over space and time against the pulse, and how far the nodes are after the largest one."""
    from faceanim.bench.gravity_bar import STEP

    with _figure(path, 2, (12.0, 4.8)) as (left, right):
        for name in found[0].error:
            at = [s.g for s in found]
            left.plot(at, [s.error[name] for s in found], markersize=7, linewidth=1.8, **BAR_STYLES[name])
        left.set_xlabel("gravity during 0.1 s [m/s$^2$]")
        left.set_xticks([s.g for s in found])
        left.set_ylabel("relative L2 error over space and 4 s [-]")
        left.set_ylim(bottom=0.0)
        left.set_title("(a) error towards nonlinear finite elements")
        _legend(left, loc="upper left")
        last = max(found, key=lambda s: s.g)
        for k, (name, far) in enumerate(last.mean.items()):
            style = BAR_STYLES[name] | {"markevery": (7 * k, 25), "markersize": 5, "linewidth": 1.5}
            right.plot(STEP * np.arange(1, len(far) + 1), far, **style)
        right.set_xlabel("time [s]")
        right.set_ylabel("mean displacement of the nodes [m]")
        right.set_title(f"(b) after the pulse of {last.g:g} m/s$^2$")
        right.set_ylim(top=1.35 * max(float(far.max()) for far in last.mean.values()))
        _legend(right, loc="upper left", ncols=2)


def neglected(tracks: Mapping[str, Floats], printed: float, path: Path) -> None:
    """Draw |R^T M - M R^T| over the mass against time, by mesh, and the printed bound of the coarsest."""
    shades = (marks.colour("modal_warping"), "#c77d4f", "#30343f")
    with _figure(path, 1, (8.5, 4.8)) as (axes,):
        for k, (name, track) in enumerate(tracks.items()):
            axes.plot(
                np.arange(1, len(track) + 1) / 30.0, track, label=f"{name} nodes, largest {track.max():.3f} %",
                color=shades[k % 3], linestyle=("-", "--", "-.")[k % 3], marker="s^X"[k % 3], markevery=(5 * k, 20),
                markersize=6, linewidth=1.6,
            )  # fmt: skip
        axes.axhline(printed, color=PUBLISHED, linestyle=":", linewidth=2.0, label=f"printed: within {printed} %")
        axes.set(xlabel="time [s]", ylabel="|R$^T$M - MR$^T$| [% of the mass]", ylim=(0.0, 1.5 * printed))
        _legend(axes, loc="upper right", ncols=2)


def model_costs(examples: Sequence[Example], costs: Mapping[str, Cost], path: Path) -> None:
    """Draw precomputation and frame against the number of nodes, ours filled and joined, published hollow."""
    names = [one.name for one in examples]
    ours, theirs = marks.colour("modal_warping"), PUBLISHED
    ticks = [f"{one.name}\n{one.nodes} nodes\n{one.modes} modes" for one in examples]
    with _figure(path, 2, (14.0, 5.4)) as (left, right):
        for axes, series in (
            (left, (("finite_elements", "finite elements", "s", "-"), ("modal", "modal analysis", "o", "--"))),
            (right, (("ode", "dynamics", "s", "-"), ("constraints", "constraints", "o", "--"),
                     ("display", "warping the vertices", "^", ":"))),
        ):  # fmt: skip
            for field, label, mark, line in series:
                values = [1e3 * getattr(costs[name], field) for name in names]
                axes.plot(ticks, values, color=ours, marker=mark, linestyle=line, markersize=8, label=f"{label}, here")
                if field == "display":
                    continue
                printed = [1e3 * getattr(one, field) for one in examples]
                style = {"color": theirs, "marker": mark, "markersize": 9, "markerfacecolor": "none"}
                axes.plot(ticks, printed, linestyle=line, label=f"{label}, published", **style)
            axes.set_yscale("log")
            low, high = axes.get_ylim()
            axes.set_ylim(low, high * (high / low) ** 0.35)
            _legend(axes, loc="upper left", ncols=2, fontsize=10)
        left.set_ylabel("precomputation [ms]")
        left.set_title("once (published: Pentium 4, 3.2 GHz)")
        right.set_ylabel("time per frame [ms]")
        right.set_title("per frame (printed to whole milliseconds)")


BLOCK_STYLES: dict[str, tuple[str, dict[str, Any]]] = {
    "paper FEM": ("finite elements, published",
                  {"color": PUBLISHED, "marker": "X", "markerfacecolor": "none", "linestyle": "none"}),
    "bricks 8^3": ("finite elements, ours", {"color": marks.colour("finite_elements"), "marker": ".", "linestyle": "-"}),
    "paper WRM": ("weighted residuals, published",
                  {"color": PUBLISHED, "marker": "^", "markerfacecolor": "none", "linestyle": "none"}),
    "collocation": ("collocation, ours", {"color": "#b5651d", "marker": "v", "linestyle": "--"}),
    "nitsche": ("energy-weighted, ours", {"color": marks.colour("weighted_residual"), "marker": "D", "linestyle": "-."}),
}  # fmt: skip


def blocks(found: Mapping[str, Mapping[str, Column]], printed: Mapping[str, tuple[int, int]], path: Path) -> None:
    """Draw each column's distance from the truth point by point, one panel per case, and the numbers of unknowns."""
    with _figure(path, len(found) + 1, (17.0, 5.2)) as panels:
        for number, (axes, (case, table)) in enumerate(zip(panels, found.items()), 1):
            exact, at = table["truth"].values, np.arange(1, 26)
            for name, (label, style) in BLOCK_STYLES.items():
                axes.plot(at, 100.0 * (table[name].values / exact - 1.0), label=label, markersize=6, **style)
            axes.axhline(0.0, color="#bbbbbb", linewidth=0.8, zorder=0)
            axes.set(title=f"Table {number}: {case}", xlabel="point of the table", xticks=[1, 5, 10, 15, 20, 25])
        panels[0].set_ylabel("displacement, distance from the truth [%]")
        _unknowns(panels[-1], found, printed)
        handles, labels = panels[0].get_legend_handles_labels()
        panels[0].figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=11)


def _unknowns(axes: Any, found: Mapping[str, Mapping[str, Column]], printed: Mapping[str, tuple[int, int]]) -> None:
    cases = list(found)
    columns = (
        ([printed[c][0] for c in cases], "FEM, published", "#c9c9c9", "//"),
        ([found[c]["bricks 8^3"].unknowns for c in cases], "FEM, ours", marks.colour("finite_elements"), ""),
        ([printed[c][1] for c in cases], "WRM, published", "#e6e6e6", ".."),
        ([found[c]["collocation"].unknowns for c in cases], "collocation", "#b5651d", ""),
        ([found[c]["nitsche"].unknowns for c in cases], "energy", marks.colour("weighted_residual"), "\\\\"),
    )
    for k, (values, label, colour, hatch) in enumerate(columns):
        at = np.arange(len(cases)) + 0.17 * (k - 2)
        axes.bar(at, values, 0.16, color=colour, hatch=hatch, edgecolor="#555555", linewidth=0.5, label=label)
        for x, value in zip(at, values):
            axes.text(x, 1.05 * value, str(value), rotation=90, ha="center", va="bottom", fontsize=9)
    axes.set_yscale("log")
    axes.set_ylim(50.0, 30000.0)
    axes.set_xticks(range(len(cases)), [f"case {k}" for k in range(1, len(cases) + 1)])
    axes.set(title="Table 4: unknowns", ylabel="number of unknowns")
    _legend(axes, loc="upper center", ncols=2, fontsize=9.5)


def expressions(pairs: Sequence[tuple[Row, Row]], apart: Mapping[str, Sequence[Row]], path: Path) -> None:
    """Draw shares of the mesh, costs by phase and frame rate of each expression, ours beside the published ones.

    apart : how quasi-static vertices are relaxed -> rows in the order of `pairs`
    """
    names, at = [row.expression for row, _ in pairs], np.arange(len(pairs))
    ours = marks.colour("mass_spring")
    with _figure(path, 3, (16.0, 5.4)) as (sets, costs, rates):
        _sets(sets, pairs, ours)
        _phases(costs, pairs, apart, ours)
        rates.bar(at - 0.2, [row.fps for row, _ in pairs], 0.38, color=ours, label="here")
        rates.bar(at + 0.2, [paper.fps for _, paper in pairs], 0.38, color="#d5d5d5", edgecolor="#555555", hatch="//",
                  label="published (Pentium III, 730 MHz)")  # fmt: skip
        rates.set(ylabel="drawn frames per second [1/s]", title="frame rate")
        rates.set_ylim(top=1.3 * max(max(row.fps, paper.fps) for row, paper in pairs))
        _legend(rates, loc="upper left")
        for axes in (sets, costs, rates):
            axes.set_xticks(at, names)
            axes.tick_params(axis="x", rotation=25)


def _phases(axes: Any, pairs: Sequence[tuple[Row, Row]], apart: Mapping[str, Sequence[Row]], ours: str) -> None:
    """Mark what each phase costs, ours filled, left, and published hollow, right of each expression."""
    columns: list[tuple[Sequence[float | None], str, str, str, str]] = [
        ([row.dynamic_ms for row, _ in pairs], "T$_d$ with V$_q$, here", "s", ours, ours),
        *(
            ([row.quasi_static_ms for row in rows], f"T$_q$ apart ({how}), here", mark, ours, ours)
            for mark, (how, rows) in zip("ov", apart.items())
        ),
        ([row.drawing_ms for row, _ in pairs], "T$_r$, here", "^", ours, ours),
        ([paper.dynamic_ms for _, paper in pairs], "T$_d$, published", "s", PUBLISHED, "none"),
        ([paper.quasi_static_ms for _, paper in pairs], "T$_q$, published", "o", PUBLISHED, "none"),
        ([paper.drawing_ms for _, paper in pairs], "T$_r$, published", "^", PUBLISHED, "none"),
    ]
    for times, label, mark, colour, fill in columns:
        at = np.arange(len(pairs)) + (0.12 if fill == "none" else -0.12)
        known = [np.nan if t is None else t for t in times]
        axes.plot(at, known, linestyle="none", marker=mark, markersize=9, color=colour, markerfacecolor=fill,
                  label=label)  # fmt: skip
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** 0.45)
    axes.set(ylabel="time per frame [ms]", title="costs by phase")
    _legend(axes, ncols=2, loc="upper center", fontsize=9.5)


def _sets(axes: Any, pairs: Sequence[tuple[Row, Row]], ours: str) -> None:
    """Stack the shares of the three node sets, ours left, published right of each expression."""
    kinds = (("dynamic", "N$_d$", "", 0.95), ("quasi_static", "N$_q$", "//", 0.5), ("static", "N$_s$", "..", 0.12))
    for k, (colour, who) in enumerate(((ours, "here"), ("#6f6f6f", "published"))):
        floor = np.zeros(len(pairs))
        for kind, label, hatch, strength in kinds:
            whole = [sum(getattr(pair[k], one[0]) for one in kinds) for pair in pairs]
            share = np.array([100.0 * getattr(pair[k], kind) / w for pair, w in zip(pairs, whole)])
            axes.bar(np.arange(len(pairs)) + 0.2 * (2 * k - 1), share, 0.37, bottom=floor, label=f"{label}, {who}",
                     facecolor=(colour, strength), hatch=hatch, edgecolor="#333333", linewidth=0.5)  # fmt: skip
            floor += share
    axes.set(ylabel="share of the mesh [%]", title="dynamic, quasi-static, static vertices", ylim=(0.0, 135.0),
             yticks=[0, 20, 40, 60, 80, 100])  # fmt: skip
    _legend(axes, ncols=2, loc="upper center", fontsize=9.5)


def contact(found: Sequence[Contact], printed: Mapping[str, tuple[float, int, int, float]], path: Path) -> None:
    """Draw error ratio and computation time by reading of the distance field, and what Table 2 prints."""
    procedures = list(dict.fromkeys(row.procedure for row in found))
    ways = list(dict.fromkeys((row.reading, row.sweeps) for row in found))
    shades = (marks.colour("mixed_fem"), "#c9a3d1")
    with _figure(path, 2, (13.0, 5.0)) as (ratios, times):
        for k, name in enumerate(procedures):
            rows = {(row.reading, row.sweeps): row for row in found if row.procedure == name}
            at = np.arange(len(ways)) + 0.2 * (2 * k - 1)
            style = {"color": shades[k], "hatch": ("", "//")[k], "edgecolor": "#333333", "linewidth": 0.5}
            lines = max(line[3] for line in printed.values())
            for axes, field, form, least in (
                (ratios, "ratio", "{:.1f}", 1.1 * lines),
                (times, "seconds", "{:.3f}", 0.0),
            ):
                values = [getattr(rows[way], field) for way in ways]
                axes.bar(at, values, 0.37, label=f"{name}, here", **style)
                for x, value in zip(at, values):
                    axes.text(x, max(1.04 * value, least), form.format(value), ha="center", va="bottom", fontsize=9)
            for axes, which in ((ratios, 3), (times, 0)):
                axes.axhline(printed[name][which], color="#444444", linestyle=(":", "--")[k], linewidth=1.5,
                             label=f"published ({k + 1}): {printed[name][which]:g}")  # fmt: skip
        labels = [f"{reading}\n{sweeps} look{'s' if sweeps > 1 else ''}" for reading, sweeps in ways]
        for axes in (ratios, times):
            axes.set_xticks(range(len(ways)), labels)
            axes.set_xlabel("how the distance field is read, looks per step (linear: the paper's)")
        top = max(row.ratio for row in found)
        ratios.set(ylabel="error vertices [% of the imposed]", title="error ratio", ylim=(0.0, 1.25 * max(top, 2.0)))
        times.set(ylabel="computation, all steps [s]", title="computation time")
        times.set_yscale("log")
        times.set_ylim(0.5 * min(row.seconds for row in found), 10.0)
        for axes in (ratios, times):
            _legend(axes, ncols=2, loc="upper right")


MODEL_STYLES = {"linear": ("#dddddd", "//"), "mass_tensor": ("#b9c0c9", ".."), "nonlinear": ("#8f8fa8", "\\\\"),
                "mixed": (marks.colour("mixed_fem"), "")}  # fmt: skip


def models(rows: Sequence[ModelRow], order: Sequence[str], path: Path) -> None:
    """Draw mean error and share within 1.5 mm of four models by operation, the printed shares as ticks."""
    from faceanim.bench.surgery_charts import LABELS, noisy_share
    from faceanim.bench.surgery_models import PAPER

    bare = {(row.move, row.model): row for row in rows if row.noise is None}
    moves = list(dict.fromkeys(row.move for row in rows))
    with _figure(path, 2, (max(11.0, 3.2 * len(moves)), 5.2)) as (errors, shares):
        for k, model in enumerate(order):
            colour, hatch = MODEL_STYLES[model]
            style = {"color": colour, "hatch": hatch, "edgecolor": "#333333", "linewidth": 0.5}
            at = {move: j + 0.2 * (k - 1.5) for j, move in enumerate(moves)}
            known = {m: bare[m, model] for m in moves if (m, model) in bare}
            means = [row.moved.mean if row.moved else 0.0 for row in known.values()]
            seen = [noisy_share(rows, row) or 0.0 for row in known.values()]
            errors.bar([at[m] for m in known], means, 0.18, label=LABELS[model], **style)
            shares.bar([at[m] for m in known], seen, 0.18, **style)
            ends = [x - 0.085 for x in at.values()], [x + 0.085 for x in at.values()]
            shares.hlines([PAPER[model]] * len(moves), *ends, color="#ffffff", linewidth=6.0)
            shares.hlines([PAPER[model]] * len(moves), *ends, color="#000000", linewidth=3.0,
                          label="published, one patient" if not k else None)  # fmt: skip
            for move, row in known.items():
                if row.moved is None:
                    errors.text(at[move], 0.01, f"{LABELS[model]}: {row.failure}", rotation=90, ha="center",
                                va="bottom", fontsize=9)  # fmt: skip
        top = max((row.moved.mean for row in bare.values() if row.moved), default=1.0)
        errors.set(ylabel="mean distance to the truth [mm]", title="without noise, skin that moves",
                   ylim=(0.0, 1.3 * top))  # fmt: skip
        shares.set(ylabel="skin within 1.5 mm of the truth [%]", title="with noise, skin that moves (axis from 70 %)",
                   ylim=(70.0, 107.0), yticks=[70, 80, 90, 100])  # fmt: skip
        for axes in (errors, shares):
            axes.set_xticks(range(len(moves)), [m.replace("_", " ") for m in moves])
        _legend(errors, ncols=4, loc="upper center")
        _legend(shares, loc="upper left")
