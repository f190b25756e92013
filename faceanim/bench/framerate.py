"""The paper's Table 1: how many vertices of each kind, what each phase costs, and what it costs in accuracy."""

from __future__ import annotations

import csv
import io
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from statistics import median
from time import perf_counter
from typing import Any

import numba
import numpy as np

from faceanim.bench.accuracy import Accuracy, full_session, measure, with_options
from faceanim.ground.arrays import Floats
from faceanim.ground.notes import tell
from faceanim.session.session import Session

Draw = Callable[[Floats, float], Any]


@dataclass(frozen=True)
class Row:
    """One expression. Counts of vertices, milliseconds per frame, errors in mm; None = not measured.

    dynamic, quasi_static, static : N_d, N_q, N_s   partition_ms : T_p, once per set of muscles
    dynamic_ms, quasi_static_ms, drawing_ms : T_d, T_q, T_r   fps : drawn frames per second
    real_time : simulated seconds per second of one core, without drawing
    partition_max, partition_rms : error against the full run; rest_max, rest_rms : against the true equilibrium
    """

    expression: str
    dynamic: int
    quasi_static: int
    static: int
    partition_ms: float | None
    dynamic_ms: float
    quasi_static_ms: float
    drawing_ms: float | None
    fps: float
    real_time: float | None = None
    partition_max: float | None = None
    partition_rms: float | None = None
    rest_max: float | None = None
    rest_rms: float | None = None


PAPER = (
    Row("happiness", 1048, 2027, 4298, None, 16.7, 7.0, 5.0, 34.8),
    Row("anger", 1882, 2294, 3197, None, 29.4, 8.0, 5.0, 23.6),
    Row("sadness", 2193, 2163, 3017, None, 34.2, 7.5, 5.0, 21.4),
    Row("disgust", 2016, 2118, 3239, None, 32.2, 7.3, 5.0, 22.5),
    Row("fear", 1562, 2208, 3603, None, 25.0, 7.6, 5.0, 26.6),
)
"""Table 1 of Zhang, Prakash & Sung: Pentium III 730 MHz, 7,373 vertices, one step a frame."""


def counts(session: Session) -> tuple[int, int, int]:
    """Return N_d, N_q, N_s of a prepared session; a solver without a partition integrates every vertex."""
    partition = getattr(session.solver, "partition", None)
    if partition is None:
        return len(session.body.surface.points), 0, 0
    return partition.n_dynamic, partition.n_quasi_static, partition.n_static


def partition_ms(session: Session) -> float | None:
    """Return what the partition of a prepared session cost to compute [ms], None if it was not computed now."""
    seconds = getattr(getattr(session.solver, "partition", None), "seconds", 0.0)
    return 1e3 * seconds if seconds > 0.0 else None


@contextmanager
def fresh_partitions() -> Iterator[None]:
    """Keep cached files in a new empty folder for a while, so that partitions are computed and their cost measured."""
    name = "FACEANIM_CACHE"
    before = os.environ.get(name)
    with tempfile.TemporaryDirectory() as folder:
        os.environ[name] = folder
        try:
            yield
        finally:
            os.environ.pop(name)
            if before is not None:
                os.environ[name] = before


def frame_rate(
    session: Session, draw: Draw | None = None, *, accuracy: bool = True, drawing_threads: int | None = None
) -> Row:
    """Return the row of one expression: simulate all frames, then draw them, then measure the errors.

    draw : draws one frame from its positions and time (encoding is not counted); None = simulation only
    drawing_threads : threads for drawing, None = as many as the simulation
    """
    positions = np.empty((session.frame_count, *session.body.surface.points.shape))
    for frame in session.frames(copy=False):
        positions[frame.index] = frame.points
    drawing: list[float] = []
    threads = numba.get_num_threads()
    numba.set_num_threads(drawing_threads or threads)
    for index in range(session.frame_count if draw is not None else 0):
        start = perf_counter()
        draw(positions[index], index / session.fps)  # type: ignore[misc]
        drawing.append(perf_counter() - start)
    numba.set_num_threads(threads)
    return table_row(session, drawing, list(measure(session, positions))[-1] if accuracy else None)


def frame_rates(
    sessions: Sequence[Session],
    draw: Callable[[Session, Floats, float], Any] | None = None,
    *,
    accuracy: bool = True,
    drawing_threads: int | None = None,
) -> Iterator[Row]:
    """Yield the row of each session, simulated on one core and drawn on `drawing_threads`; compile before anything.

    draw : draws a frame of a session from its positions and time; None = simulation only
    Partitions are computed anew, so that their cost is measured.
    """
    threads = numba.get_num_threads()
    first = sessions[0]
    first.solver.step(first.solver.rest(), first.solver.rest(), first.control(0.1), first.dt)
    first.solver.solve_static(first.control(0.1))
    try:
        for session in sessions:
            tell(f"measuring {session.expression.name}")
            numba.set_num_threads(1)
            with fresh_partitions():
                session.warm()
            one = None if draw is None else partial(draw, session)
            yield frame_rate(session, one, accuracy=accuracy, drawing_threads=drawing_threads or threads)
    finally:
        numba.set_num_threads(threads)


def table_row(session: Session, drawing: list[float], accuracy: Accuracy | None) -> Row:
    """Return the row of a session that has run; `drawing` is the time each frame took to draw [s]."""
    frames = max(1, len(session.timings.frame))
    simulated = 1e3 * median(session.timings.frame or [0.0])
    quasi_static = 1e3 * session.timings.phases.get("quasi_static", 0.0) / frames
    drawn = 1e3 * median(drawing) if drawing else None
    total = simulated + (drawn or 0.0)
    partition = accuracy.partition if accuracy else None
    rest = accuracy.rest if accuracy else None
    n_d, n_q, n_s = counts(session)
    return Row(
        expression=session.expression.name,
        dynamic=n_d,
        quasi_static=n_q,
        static=n_s,
        partition_ms=partition_ms(session),
        dynamic_ms=max(0.0, simulated - quasi_static),
        quasi_static_ms=quasi_static,
        drawing_ms=drawn,
        fps=1e3 / total if total > 0.0 else 0.0,
        real_time=1e3 / (simulated * session.fps) if simulated > 0.0 else None,
        partition_max=partition.max if partition else None,
        partition_rms=partition.rms if partition else None,
        rest_max=rest.max if rest else None,
        rest_rms=rest.rms if rest else None,
    )


@dataclass(frozen=True)
class Share:
    """What an iteration costs, overheads of its step included, and the share of one on the full mesh.

    vertices : how many move   worked_on : how many of them are computed, the others being mirror images
    """

    what: str
    vertices: int
    worked_on: int
    iteration_ms: float
    share: float


PUBLISHED_DYNAMIC = 1048
"""Dynamic vertices of happiness in the paper."""


def shares(session: Session, *, rounds: int = 40) -> list[Share]:
    """Return what an iteration costs with every vertex dynamic, with 1,048 vertices, and with the partition of `session`.

    The first two without the help of symmetry. Steps alternate between the solvers in one run, so that all see the same
    machine. Empty for a full session.
    """
    whole_face = full_session(session)
    if whole_face is None:
        return []
    session.warm()
    full = with_options(whole_face, _steady(whole_face.options, symmetric=False), whole_face.dt)
    sessions = {FULL: full}
    fewer = _with_dynamic(session, PUBLISHED_DYNAMIC)
    if fewer is not None:
        sessions[f"{PUBLISHED_DYNAMIC} dynamic vertices"] = fewer
    sessions[f"{session.expression.name}, adaptive"] = with_options(session, _steady(session.options), session.dt)
    spent: dict[str, list[float]] = {name: [] for name in sessions}
    states = {}
    for name, one in sessions.items():
        one.warm()
        states[name] = one.solver.rest()
    for k in range(rounds):
        for name, one in sessions.items():
            control = one.control(min(1.0, (k + 1) / rounds))
            start = perf_counter()
            report = one.solver.step(states[name], states[name], control, one.dt)
            spent[name].append((perf_counter() - start) / max(1, report.iterations))
    times = {name: 1e3 * median(values) for name, values in spent.items()}
    return [
        Share(name, sum(counts(one)[:2]), getattr(one.solver, "worked_on", 0), times[name], times[name] / times[FULL])
        for name, one in sessions.items()
    ]


FULL = "every vertex dynamic"


def _steady(options: Any, **changes: Any) -> Any:
    """Return options with which every step makes all its iterations, and with those `changes` that they know."""
    wanted = {"iteration_tolerance": 1e-12, "sweep_tolerance": 1e-12} | changes
    return replace(options, **{name: value for name, value in wanted.items() if hasattr(options, name)})


def _with_dynamic(session: Session, count: int) -> Session | None:
    """Return a session of which only `count` vertices are dynamic and none quasi-static, None if that cannot be.

    They are the free vertices nearest to the middle of those that `session` integrates.
    """
    partition, use = getattr(session.solver, "partition", None), getattr(session.solver, "use", None)
    free = np.flatnonzero(~session.body.pinned)
    if partition is None or use is None or len(free) < count:
        return None
    points = session.body.surface.points
    middle = points[partition.node_set == 2].mean(axis=0)
    nearest = free[np.argsort(np.linalg.norm(points[free] - middle, axis=1), kind="stable")[:count]]
    node_set = np.zeros_like(partition.node_set)
    node_set[nearest] = 2
    other = with_options(session, _steady(session.options, symmetric=False), session.dt)
    other.warm()
    other.solver.use(replace(partition, node_set=node_set, wave=np.zeros_like(partition.wave)))  # type: ignore[attr-defined]
    return other


def as_csv(rows: list[Any]) -> str:
    """Return the rows (instances of one dataclass) as CSV with a header."""
    text = io.StringIO()
    names = [f.name for f in fields(rows[0])]
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in asdict(row).items()})
    return text.getvalue()


COLUMNS = ("expression", "N_d", "N_q", "N_s", "T_p [ms]", "T_d [ms]", "T_q [ms]", "T_r [ms]", "frames/s",
           "real time", "partition error max / RMS [mm]", "rest error max / RMS [mm]")  # fmt: skip


def cells(row: Row) -> tuple[str, ...]:
    """Return a row as the words of a table with `COLUMNS`."""

    def two(a: float | None, b: float | None) -> str:
        return "-" if a is None or b is None else f"{a:.3f} / {b:.4f}"

    def ms(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}"

    return (
        row.expression, str(row.dynamic), str(row.quasi_static), str(row.static), ms(row.partition_ms),
        ms(row.dynamic_ms), ms(row.quasi_static_ms), ms(row.drawing_ms), f"{row.fps:.1f}",
        "-" if row.real_time is None else f"{row.real_time:.1f} x",
        two(row.partition_max, row.partition_rms), two(row.rest_max, row.rest_rms),
    )  # fmt: skip


def as_markdown(rows: list[Row]) -> str:
    """Return the rows as a Markdown table, each followed by the published one of the same expression."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    for row, paper in beside_paper(rows):
        lines.append("| " + " | ".join(cells(row)) + " |")
        if paper is not None:
            words = cells(paper)
            lines.append("| " + " | ".join((f"*{words[0]}, published*", *words[1:])) + " |")
    return "\n".join(lines) + "\n"


def beside_paper(rows: list[Row]) -> list[tuple[Row, Row | None]]:
    """Return each row with the published row of the same expression, None where there is none."""
    published = {row.expression: row for row in PAPER}
    return [(row, published.get(row.expression)) for row in rows]
