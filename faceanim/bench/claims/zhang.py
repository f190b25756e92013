"""Table 1 of Zhang, Prakash & Sung on our face: node counts, costs by phase and frame rate of its five expressions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from scipy.stats import spearmanr

from faceanim.backends import backend_class
from faceanim.bench.claims import charts
from faceanim.bench.claims.claim import Criterion, Finding, Line, Request
from faceanim.bench.framerate import FULL, PAPER, PUBLISHED_DYNAMIC, Row, Share, beside_paper, frame_rates, shares
from faceanim.expression.library import load_expression
from faceanim.face.library import load_face
from faceanim.ground.notes import tell
from faceanim.session.session import Session

FPS = 30.0
OTHER_FACE = "as a share only: other face and partition"
OTHER_MACHINE = "no: a Pentium III with 730 MHz"
DRAWN = "no: other machine; theirs has graphics hardware"
WITHIN = "no: moved with the dynamic ones by default"
PARTITION_PRINTED = {"happiness": 20.6, "anger": 24.2, "sadness": 26.7, "disgust": 22.7, "fear": 21.6}
"""T_p [s]."""
APART = {"chebyshev": "accelerated passes apart", "waves": "waves apart, as in the paper"}
"""Options of `mass_spring` that move quasi-static vertices apart from the dynamic ones, in words."""
SETS = ("dynamic", "quasi_static", "static")
SYMBOLS = ("N_d", "N_q", "N_s")


def table_1(request: Request) -> Finding:
    """Run the five expressions by the default backend, adaptively; draw them if the request says how."""
    tell("compiling what is not compiled yet")
    rows = list(frame_rates(_sessions(), request.draw_frame, drawing_threads=request.drawing_threads))
    apart = {}
    for how in APART:
        tell(f"quasi-static vertices by {how}")
        apart[how] = list(frame_rates(_sessions(quasi_static=how), accuracy=False))
    tell("comparing the work of a part of the mesh with all of it")
    return judged(rows, apart, shares(_sessions()[0], rounds=2 * request.rounds))


def _sessions(**options: Any) -> list[Session]:
    """Return the five expressions on the default face by the default backend, adaptively."""
    face = load_face("default", "default")
    body, chosen = face.body(), backend_class("mass_spring").Options(adaptive=True, **options)
    return [
        Session(face, load_expression(row.expression), fps=FPS, backend="mass_spring", options=chosen, body=body)
        for row in PAPER
    ]


def judged(rows: Sequence[Row], apart: Mapping[str, Sequence[Row]], work: Sequence[Share]) -> Finding:
    """Return the finding for measured rows, for those with quasi-static vertices moved `apart` (how -> rows), and for
    what iterations on parts of the mesh cost.
    """
    pairs = [(row, paper) for row, paper in beside_paper(list(rows)) if paper is not None]
    lines = []
    for k, (row, paper) in enumerate(pairs):
        lines += _lines(row, paper)
        for how, others in apart.items():
            what = f"T_q, {APART[how]}"
            lines.append(
                Line(row.expression, what, "ms", others[k].quasi_static_ms, paper.quasi_static_ms, OTHER_MACHINE)
            )
    for share in work:
        what = f"cost of an iteration, {share.vertices} vertices"
        lines.append(Line(share.what, what, "of the full mesh", share.share, None, "no: not printed"))
    return Finding(
        tuple(lines), _criteria(pairs, apart, work), lambda path: charts.expressions(pairs, apart, path), NOTES
    )


NOTES = (
    "N_d + N_q + N_s is every vertex. Our partition is chosen so that it costs at most the tolerance (0.05 mm at rest) "
    "in accuracy; the paper's is by distance from the muscles, and its error is not told. T_d is what one core takes "
    "for a simulated frame. By default quasi-static vertices are integrated in the same sweeps as the dynamic ones, so "
    "that T_d includes them and the frame rate is that of this scheme; T_q alone is measured in runs that relax them "
    "apart, by accelerated passes and by the paper's waves. Dynamics are so much faster here that drawing takes longer "
    "than they do.",
)


def set_share(row: Row, kind: str) -> float:
    """Return how many of all vertices are of a `kind` of `SETS` [%]."""
    return float(100.0 * getattr(row, kind) / sum(getattr(row, one) for one in SETS))


def _lines(row: Row, paper: Row) -> list[Line]:
    lines = [
        Line(row.expression, f"{symbol} ({getattr(row, kind)}; {getattr(paper, kind)} published)", "% of the mesh",
             set_share(row, kind), set_share(paper, kind), OTHER_FACE)
        for kind, symbol in zip(SETS, SYMBOLS)
    ]  # fmt: skip
    once = None if row.partition_ms is None else 1e-3 * row.partition_ms
    lines.append(Line(row.expression, "T_p, once", "s", once, PARTITION_PRINTED[row.expression], OTHER_MACHINE))
    lines.append(Line(row.expression, "T_d", "ms", row.dynamic_ms, paper.dynamic_ms, OTHER_MACHINE))
    lines.append(Line(row.expression, "T_q", "ms", "in T_d", paper.quasi_static_ms, WITHIN))
    lines.append(Line(row.expression, "T_r", "ms", row.drawing_ms, paper.drawing_ms, DRAWN))
    lines.append(Line(row.expression, "frame rate", "1/s", row.fps, paper.fps, DRAWN))
    lines.append(Line(row.expression, "error of the partition, RMS", "mm", row.partition_rms, None, "no: not printed"))
    return lines


def _criteria(
    pairs: Sequence[tuple[Row, Row]], apart: Mapping[str, Sequence[Row]], work: Sequence[Share]
) -> tuple[Criterion, ...]:
    off = max(abs(set_share(row, "dynamic") - set_share(paper, "dynamic")) for row, paper in pairs)
    order = float(spearmanr([row.dynamic for row, _ in pairs], [paper.dynamic for _, paper in pairs]).statistic)
    errors = [row.partition_rms for row, _ in pairs if row.partition_rms is not None]
    known = {share.what: share.share for share in work}
    part = known.get(f"{PUBLISHED_DYNAMIC} dynamic vertices", float("nan"))
    own = next((v for k, v in known.items() if k != FULL and k.endswith("adaptive")), float("nan"))
    return (
        Criterion("N_d as a share of the mesh and the printed one differ by [points], largest", off, high=10.0,
                  printed=True),
        Criterion("expressions in the printed order of N_d, rank correlation", order, low=0.5, printed=True),
        Criterion("frame rate over the printed one, least", min(row.fps / paper.fps for row, paper in pairs), 1.0),
        *_phases(pairs, apart),
        Criterion(f"an iteration with {PUBLISHED_DYNAMIC} dynamic vertices over one of the full mesh", part, high=0.5),
        Criterion("an iteration of happiness, adaptive, over one of the full mesh (\"accelerates\")", own, high=1.0),
        Criterion("error of the partition, RMS of the worst frame [mm], largest", max(errors, default=float("nan")),
                  high=0.05),
    )  # fmt: skip


def _phases(pairs: Sequence[tuple[Row, Row]], apart: Mapping[str, Sequence[Row]]) -> list[Criterion]:
    """Return what the paper says of T_q and T_r: "relatively small compared to that of the dynamic simulation"."""
    out = []
    for how, words in APART.items():
        most = max(row.quasi_static_ms / row.dynamic_ms for row in apart[how])
        out.append(Criterion(f'T_q over T_d ("relatively small"), {words}, largest', most, high=1.0))
    drawn = [row.drawing_ms / row.dynamic_ms for row, _ in pairs if row.drawing_ms is not None]
    if drawn:
        out.append(Criterion('T_r over T_d ("relatively small"), largest', max(drawn), high=1.0))
    return out
