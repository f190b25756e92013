"""Table and chart of the four soft-tissue models, with the published figures beside."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from faceanim.backends.mixed_fem.options import MODELS
from faceanim.bench.surgery_models import PAPER, Row
from faceanim.surgery.distance_map import Statistics

COLOURS = {"mixed": "#c2543a", "nonlinear": "#e3a857", "mass_tensor": "#5b7a99", "linear": "#7f9f7f"}
LABELS = {"mixed": "NFM-EM", "nonlinear": "NFEM", "mass_tensor": "MTM", "linear": "LFEM"}


def csv_text(rows: Sequence[Row]) -> str:
    """Return all rows as comma-separated values; empty figures where a model failed."""
    figures = tuple(Statistics.__dataclass_fields__)
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    names = [f"{region}_{name}" for region in ("moved", "face") for name in figures]
    out.writerow(["move", "model", "noise_seed", "fraction", "seconds", *names, "failure"])
    for row in rows:
        values = [
            "" if part is None else f"{getattr(part, name):.6g}" for part in (row.moved, row.face) for name in figures
        ]
        seed = "" if row.noise is None else row.noise
        out.writerow([row.move, row.model, seed, f"{row.fraction:.4g}", f"{row.seconds:.3g}", *values, row.failure])
    return text.getvalue()


def markdown(rows: Sequence[Row], rest: Statistics) -> str:
    """Return the table of the README: per move and model the figures without noise, and the mean share with noise."""
    lines = [
        "| move | model | mean | 95 % | max [mm] | < 1.5 mm | with noise | published | time [s] |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if row.noise is not None:
            continue
        published = f"{PAPER[row.model]:.0f} %" if row.model in PAPER else "-"
        start = f"| {row.move} | {LABELS.get(row.model, row.model)} | "
        if row.moved is None:
            lines.append(start + f"{_ended(row)} | - | - | - | - | {published} | {row.seconds:.1f} |")
            continue
        m = row.moved
        noisy = noisy_share(rows, row)
        seen = "-" if noisy is None else f"{noisy:.1f} %"
        figures = f"{m.mean:.2f} | {m.p95:.2f} | {m.max:.2f} | {m.within_1_5:.1f} % | {seen}"
        lines.append(start + f"{figures} | {published} | {row.seconds:.1f} |")
    lines.append("")
    lines.append(
        f"In the region that the truth moves by more than 1 mm. Before any move the two skins, of different "
        f"triangulations, are {rest.mean:.2f} mm apart in the mean and {rest.p95:.2f} mm at 95 %."
    )
    return "\n".join(lines) + "\n"


def _ended(row: Row) -> str:
    """Return in a few words why a model has no figures."""
    return f"no balance beyond {row.fraction:.0%}" if row.fraction < 1.0 else row.failure


def noisy_share(rows: Sequence[Row], row: Row) -> float | None:
    """Return the share of the moved region within 1.5 mm over all noisy observations of `row`'s case [%]."""
    shares = [
        r.moved.within_1_5
        for r in rows
        if (r.move, r.model) == (row.move, row.model) and r.noise is not None and r.moved is not None
    ]
    return float(np.mean(shares)) if shares else None


def chart(rows: Sequence[Row], path: Path) -> None:
    """Draw mean error and share within 1.5 mm by move and model into the PNG `path`, the published shares as lines."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    bare = [row for row in rows if row.noise is None and row.model in MODELS]
    moves = list(dict.fromkeys(row.move for row in bare))
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    errors, shares = figure.subplots(1, 2)
    for k, model in enumerate(MODELS):
        at = [moves.index(row.move) + 0.2 * (k - 1.5) for row in bare if row.model == model and row.moved]
        found = [row for row in bare if row.model == model and row.moved]
        colour, label = COLOURS[model], LABELS[model]
        errors.bar(at, [row.moved.mean for row in found if row.moved], 0.18, color=colour, label=label)
        shares.bar(at, [noisy_share(rows, row) or 0.0 for row in found], 0.18, color=colour, label=label)
        shares.axhline(PAPER[model], color=colour, linestyle=":", linewidth=1.2)
        for row in bare:
            if row.model == model and row.moved is None:
                place = moves.index(row.move) + 0.2 * (k - 1.5)
                errors.text(place, 0.02, _ended(row), rotation=90, ha="center", va="bottom", fontsize="x-small")
    errors.set_ylabel("mean distance to the truth, moved skin [mm]")
    errors.set_title("without noise")
    shares.set_ylabel("moved skin within 1.5 mm [%]")
    shares.set_title("with noise; dotted: published, one patient")
    shares.set_ylim(60.0, 101.0)
    for axes in (errors, shares):
        axes.set_xticks(range(len(moves)), [m.replace("_", " ") for m in moves], rotation=20, ha="right")
        axes.spines[["top", "right"]].set_visible(False)
    errors.legend(frameon=False, fontsize="small", ncols=2)
    figure.savefig(path, dpi=130)
