"""Rows of the comparison of backends: what was run, what it cost, how far it was off; as JSON lines, CSV and a front."""

from __future__ import annotations

import csv
import io
from dataclasses import astuple, dataclass, field, replace
from math import floor, inf, isfinite, log
from typing import Any

import msgspec

from faceanim.ground.errors import UserError

OUTCOMES = ("done", "diverged", "inverted", "too slow", "refused", "failed")
"""done : measured to the end   diverged : not finite or flown away   inverted : finite, but skin is turned inside out at
the end   too slow : stopped at the time limit   refused : the backend does not model this scene   failed : anything else"""


@dataclass(frozen=True)
class Errors:
    """Distance from a reference [mm] over the probes that it moves; `relative` [-]: RMS over the RMS of the movement."""

    rms: float
    p95: float
    max: float
    relative: float


@dataclass(frozen=True)
class Row:
    """One candidate in one scene.

    key : names scene, candidate and their versions; the same for a repetition   label : the candidate in words
    scheme : the backend's scheme or variant in one word, "" if it has only one   density : of the body
    settings : options that are not the backend's defaults   step [s], steps_per_frame, fps : how it was stepped
    outcome : one of `OUTCOMES`, with its `reason` unless done
    unknowns : free coordinates   threads : that the simulation used
    frame_ms, frame_low_ms, frame_high_ms : median and quartiles of the cost per frame, warm, over `frames` frames
    setup_s : making the solver and what it prepares, warm   compile_s : compiling, apart   memory_mb : of the solver
    rest : the last frame, held, against the reference equilibrium   along : all frames against the reference motion
    scheme_error : all frames against the same model stepped by its own yardstick, None where it has none
    regions : of a face -> RMS error, the larger of `rest` and `along`, RMS movement of the reference at rest [mm], and
    its share of the probes
    inverted : triangles of the surface turned over in the last frame, None = not measured
    picture : file beside the table that shows the last frame in false colour of its error
    machine : processor, number of cores
    """

    scene: str
    key: str
    label: str
    backend: str
    scheme: str
    density: str
    settings: dict[str, Any]
    step: float
    steps_per_frame: int
    fps: float
    outcome: str
    reason: str = ""
    unknowns: int = 0
    threads: int = 1
    frames: int = 0
    frame_ms: float | None = None
    frame_low_ms: float | None = None
    frame_high_ms: float | None = None
    setup_s: float | None = None
    compile_s: float | None = None
    memory_mb: float | None = None
    rest: Errors | None = None
    along: Errors | None = None
    scheme_error: Errors | None = None
    regions: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    inverted: int | None = None
    picture: str | None = None
    machine: str = ""

    @property
    def counts(self) -> bool:
        """Whether it may stand on a front: measured to the end, with a cost and finite errors."""
        if self.outcome != "done" or self.frame_ms is None or self.along is None:
            return False
        return 0.0 < self.frame_ms < inf and isfinite(self.along.rms) and (self.rest is None or isfinite(self.rest.rms))


@dataclass(frozen=True)
class Comparison:
    """All rows of one scene and what they were measured against.

    reference : in words   uncertainty : RMS error of the reference itself, estimated from two levels [mm]
    movement : RMS movement of the probes in the last frame of the reference [mm]
    """

    scene: str
    title: str
    reference: str
    uncertainty: float
    movement: float
    machine: str
    rows: list[Row] = field(default_factory=list)


def worst(row: Row) -> float:
    """Return the error that a row is judged by [mm]: the larger RMS of the last frame and of the motion."""
    return max(e.rms for e in (row.rest, row.along) if e is not None)


CLOSE = 1.2
"""Costs within this factor count as equal: a machine's noise."""
ALIKE = 1.02
"""Errors are graded in bands of this factor: a gain of less is none."""


def grade(row: Row) -> float:
    """Return the band of a row's error, a whole number, the lower the better; -inf without error."""
    error = worst(row)
    return floor(log(error) / log(ALIKE)) if error > 0.0 else -inf


def front(rows: list[Row]) -> list[Row]:
    """Return the Pareto front, cheapest first, with costs within `CLOSE` and errors of one `grade` taken as equal.

    From the most accurate grade on, each next one has to be cheaper by more than `CLOSE` than all that were kept. Hence
    no row of the front is beaten by any other, any two differ in cost by more than `CLOSE`, and every row that was
    left out has one on the front that is at least as accurate at no more than `CLOSE` of its cost. (To drop whatever
    *any* row beats within `CLOSE` would not do: in a chain of rows, each a little dearer and better than the last,
    nothing would remain but the dearest.) If costs are off by a factor of up to d, who stands on the front may only
    change through pairs whose costs differ by CLOSE / d^2 to CLOSE d^2, and the front itself moves by CLOSE d^2 at most.
    The kernel of the relation "beats within `CLOSE`", a coverage in the sense of Papadimitriou & Yannakakis 2000.
    """
    kept: list[Row] = []
    for row in sorted(
        (row for row in rows if row.counts), key=lambda r: (grade(r), r.frame_ms, worst(r), r.label, r.key)
    ):
        if all((other.frame_ms or 0.0) > CLOSE * (row.frame_ms or 0.0) for other in kept):
            kept.append(row)
    return kept[::-1]


def excess(row: Row, rows: list[Row]) -> float:
    """Return by what factor a row that counts is dearer than the cheapest of `rows` that is at least as accurate [-].

    1 on the exact front; unlike membership of a front it changes by little if costs do.
    """
    cost = row.frame_ms or 0.0
    cheapest = min((r.frame_ms or 0.0 for r in rows if r.counts and worst(r) <= worst(row)), default=cost)
    return cost / cheapest if cheapest > 0.0 else 1.0


def as_json(comparison: Comparison) -> bytes:
    """Return the comparison as JSON, as `load` reads it; errors that are not finite are left out.

    JSON has no such numbers: they would be written as nothing, and the file could not be read again.
    """
    rows = [
        replace(row, rest=_finite(row.rest), along=_finite(row.along), scheme_error=_finite(row.scheme_error))
        for row in comparison.rows
    ]
    return msgspec.json.format(msgspec.json.encode(replace(comparison, rows=rows)), indent=1)


def _finite(errors: Errors | None) -> Errors | None:
    return errors if errors is not None and all(isfinite(value) for value in astuple(errors)) else None


def load(data: bytes, name: str) -> Comparison:
    """Return a saved comparison; raise `UserError` naming the file `name` if that is none."""
    try:
        return msgspec.json.decode(data, type=Comparison)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{name} is not a comparison that can be read ({error}); move it away to start anew") from None


COLUMNS = (
    "scene", "label", "backend", "scheme", "density", "settings", "step_ms", "steps_per_frame", "fps", "outcome",
    "reason", "on_front", "unknowns", "threads", "frames", "frame_ms", "frame_low_ms", "frame_high_ms", "setup_s",
    "compile_s", "memory_mb", "rest_rms_mm", "rest_p95_mm", "rest_max_mm", "rest_relative", "along_rms_mm",
    "along_p95_mm", "along_max_mm", "along_relative", "scheme_rms_mm", "scheme_relative", "inverted", "picture", "key",
)  # fmt: skip


def record(row: Row, on_front: bool) -> dict[str, Any]:
    """Return a row as one flat record with `COLUMNS`."""
    out: dict[str, Any] = {name: getattr(row, name) for name in COLUMNS if hasattr(row, name)}
    out["settings"] = " ".join(f"{k}={v}" for k, v in row.settings.items())
    out |= {"step_ms": 1e3 * row.step, "on_front": on_front}
    for name, errors in (("rest", row.rest), ("along", row.along), ("scheme", row.scheme_error)):
        for short, what in (("rms_mm", "rms"), ("p95_mm", "p95"), ("max_mm", "max"), ("relative", "relative")):
            if f"{name}_{short}" in COLUMNS:
                out[f"{name}_{short}"] = None if errors is None else getattr(errors, what)
    return {name: out[name] for name in COLUMNS}


def as_csv(comparison: Comparison) -> str:
    """Return all rows as CSV with a header; those on the front are marked."""
    best = {id(row) for row in front(comparison.rows)}
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for row in comparison.rows:
        flat = record(row, id(row) in best)
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in flat.items()})
    return text.getvalue()
