"""Table 2 and Fig. 8 of the mixed-element paper on our head: flesh before moved bones, and four models of soft tissue."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from faceanim.backends.mixed_fem.options import MODELS
from faceanim.bench.bone_contact import TABLE_2, Contact, contacts
from faceanim.bench.claims import charts
from faceanim.bench.claims.claim import Criterion, Finding, Line, Request
from faceanim.bench.surgery_charts import LABELS, noisy_share
from faceanim.bench.surgery_models import MOVES, PAPER, Row, reference, run
from faceanim.ground.errors import UserError, unknown_name
from faceanim.ground.notes import tell

UNDEFINED = "no: other heads, and what an error vertex is is not told"
CHOSEN = ("nearest", 1)
"""The reading and sweeps that the backend uses."""
PRINTED_RATIO, PRINTED_SECONDS = 2.0, 1.0
""""The average error ratio stays below 2%" and "less than 1 s", said of Table 2."""


def table_2(request: Request) -> Finding:
    """Move the mandible and the mid-face through flesh by five readings of their distance fields."""
    found = list(contacts())
    lines = []
    for row in found:
        case, detail = f"{row.procedure}, {row.reading} x {row.sweeps}", (row.reading, row.sweeps) == ("nearest", 3)
        seconds, imposed, errors, ratio = TABLE_2[row.procedure]
        for quantity, unit, ours, printed, why in (
            ("computation", "s", row.seconds, seconds, "no: another machine (Opteron, 3.0 GHz), other heads"),
            ("imposed vertices", "-", row.imposed, imposed, "of like number: other heads"),
            ("error vertices", "-", row.errors, errors, UNDEFINED),
            ("error ratio", "%", row.ratio, ratio, UNDEFINED),
        ):
            lines.append(Line(case, quantity, unit, ours, printed, why, detail))
    first, chosen = (_of(found, way) for way in (("linear", 1), CHOSEN))
    criteria = (
        Criterion("error ratio by the paper's reading [%], mean", float(np.mean([r.ratio for r in first])),
                  high=PRINTED_RATIO, printed=True),
        Criterion("error ratio by the reading that the backend uses [%] (\"below 2%\"), mean",
                  float(np.mean([r.ratio for r in chosen])), high=PRINTED_RATIO),
        Criterion("computation, any reading [s] (\"less than 1 s\"), largest", max(r.seconds for r in found),
                  high=PRINTED_SECONDS),
    )  # fmt: skip
    notes = (
        "Which printed procedure is which is not told; they are set beside ours in their order. An error vertex here "
        "is one that lies more than 0.1 mm off the bone after a step. \"linear\" interpolates the distance in "
        "tetrahedra as the paper does; \"nearest\" looks up the nearest triangle. Times are those of all steps.",
    )  # fmt: skip
    return Finding(tuple(lines), criteria, lambda path: charts.contact(found, TABLE_2, path), notes)


def _of(found: Sequence[Contact], way: tuple[str, int]) -> list[Contact]:
    return [row for row in found if (row.reading, row.sweeps) == way]


ORDER = ("linear", "mass_tensor", "nonlinear", "mixed")
"""From the least to the most accurate, as printed (79, 87, 89 and 95 %)."""
MEAN_PRINTED, P95_PRINTED = 0.5, 1.5
"""Mean distance of the mixed model and what 95 % of it stay below [mm]."""


def checked_moves(moves: Sequence[str]) -> tuple[str, ...]:
    """Return the operations asked for ("all" = every one); raise `UserError` for none or an unknown one."""
    if list(moves) == ["all"]:
        return MOVES
    if not moves:
        raise UserError(f"no operation is named; choose of {', '.join(MOVES)}, or all")
    for move in moves:
        if move not in MOVES:
            raise unknown_name("operation", move, [*MOVES, "all"])
    return tuple(dict.fromkeys(moves))


def figure_8(request: Request) -> Finding:
    """Run the four models on the operations asked for against the synthetic truth."""
    moves = checked_moves(request.moves)
    rows: list[Row] = []
    for move in moves:
        known = reference(move)
        for k, model in enumerate(MODELS):
            tell(f"{move}: model {k + 1} of {len(MODELS)}")
            rows += run(move, model, known)
    lines = [line for row in rows if row.noise is None for line in _model_lines(rows, row)]
    notes = (
        "There is no patient: the truth is a finer model with the same law, constants and bone moves, which favours "
        "these models; this says nothing about patients. A model that turns elements inside out has no figures. Only "
        "skin that the truth moves by more than 1 mm counts. In the paper the shares are those of one patient's face.",
    )
    return Finding(tuple(lines), _model_criteria(rows), lambda path: charts.models(rows, ORDER, path), notes)


def _model_lines(rows: Sequence[Row], row: Row) -> list[Line]:
    case, why = f"{row.move}, {LABELS[row.model]}", "no: one patient whose data are not published"
    share = noisy_share(rows, row)
    if row.moved is None:
        return [Line(case, "share within 1.5 mm, with noise", "%", row.failure, PAPER[row.model], why)]
    mixed = row.model == "mixed"
    return [
        Line(case, "share within 1.5 mm, with noise", "%", share, PAPER[row.model], why),
        Line(case, "share within 1.5 mm, without noise", "%", row.moved.within_1_5, None, why),
        Line(case, "mean distance", "mm", row.moved.mean, MEAN_PRINTED if mixed else None, why),
        Line(case, "95 % of the distances are below", "mm", row.moved.p95, P95_PRINTED if mixed else None, why),
        Line(case, "time of the balance", "s", row.seconds, None, "no: not printed"),
    ]


def _model_criteria(rows: Sequence[Row]) -> tuple[Criterion, ...]:
    bare = {(r.move, r.model): r for r in rows if r.noise is None}
    moves = list(dict.fromkeys(r.move for r in rows))
    mean = {key: r.moved.mean for key, r in bare.items() if r.moved is not None}

    def worse(less: str, more: str) -> float:
        """Return the least ratio of mean errors, of the `less` over the `more` accurate model."""
        ratios = [mean[m, less] / mean[m, more] for m in moves if (m, less) in mean and (m, more) in mean]
        return min(ratios, default=float("nan"))

    shares = {key: noisy_share(rows, r) for key, r in bare.items()}
    off = [abs(share - PAPER[model]) for (_, model), share in shares.items() if share is not None]
    failed = [r for r in bare.values() if r.moved is None]
    mixed = [bare[m, "mixed"].moved for m in moves]
    return (
        Criterion("share within 1.5 mm and the printed one differ by [points], largest", max(off, default=float("nan")),
                  high=3.0, printed=True),
        Criterion("models without a result", float(len(failed)), high=0.0, printed=True),
        Criterion("mean distance of NFM-EM [mm], largest", max((m.mean for m in mixed if m), default=float("nan")),
                  high=MEAN_PRINTED, printed=True),
        Criterion("95 % of NFM-EM below [mm], largest", max((m.p95 for m in mixed if m), default=float("nan")),
                  high=P95_PRINTED, printed=True),
        Criterion("mean distance of LFEM over NFEM, least", worse("linear", "nonlinear"), 1.001),
        Criterion("mean distance of NFEM over NFM-EM, least", worse("nonlinear", "mixed"), 1.001),
    )  # fmt: skip
