"""Stability maps: what becomes of a body, cell by cell of a grid of two quantities, under every scheme.

A map is planned (`Plan`), tried cell by cell under a guard, and kept in a file that a later run goes on from.
Outcomes: "converged" it comes to the right answer, one computed independently of the scheme; "bounded but wrong";
"inverted" finite, but turned inside out somewhere; "not finite" NaN, flown away or diverged; "refused" the program
declines with a reason, or gives no answer in time.
"""

from __future__ import annotations

import csv
import io
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from types import FrameType
from typing import Any

import msgspec
import numpy as np

from faceanim.bench.marks import OUTCOME_COLOURS
from faceanim.ground.errors import DivergenceError, FaceanimError, UserError
from faceanim.ground.files import write_whole

OUTCOMES = tuple(OUTCOME_COLOURS)
CONVERGED, WRONG, INVERTED, NOT_FINITE, REFUSED = OUTCOMES
VERSION = 1
"""Of the trials: cells of another version are not mixed with these."""
SAVE_EVERY = 1.0
"""Seconds between two writings of the file."""
LONGEST = 300
"""Letters of a reason that are kept."""


@dataclass(frozen=True)
class Axis:
    """One axis: numbers with a `unit` (`log`: spaced by ratios), or `words`, then `values` are their places."""

    title: str
    unit: str
    values: list[float]
    words: list[str] = field(default_factory=list)
    log: bool = False

    @classmethod
    def of_words(cls, title: str, words: Sequence[str]) -> Axis:
        """Return an axis of named things."""
        return cls(title, "", [float(k) for k in range(len(words))], list(words))

    def name(self, k: int) -> str:
        """Return the k-th place in words."""
        return self.words[k] if self.words else f"{self.values[k]:.6g}"


@dataclass(frozen=True)
class Cell:
    """What became of one trial: `error` relative to what the map says, after so many `steps` and `seconds`."""

    outcome: str
    reason: str = ""
    error: float | None = None
    steps: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Limit:
    """A predicted limit as a line over the map, in the units of its axes (rows of words: one mark per row)."""

    label: str
    x: list[float]
    y: list[float]


@dataclass
class Map:
    """A map of one scene: `cells` by the names of their places, "x|y".

    kind : one of `maps.KINDS`   backend, scheme : "" where an axis lists them
    tolerance : largest error that counts as converged   measure : what the error is relative to, in words
    """

    key: str
    kind: str
    scene: str
    title: str
    backend: str
    scheme: str
    x: Axis
    y: Axis
    tolerance: float
    measure: str
    caption: str = ""
    limits: list[Limit] | None = None
    cells: dict[str, Cell] = field(default_factory=dict)

    def at(self, i: int, j: int) -> Cell | None:
        """Return the cell in column `i` and row `j`, None if it has not been tried."""
        return self.cells.get(self.place(i, j))

    def place(self, i: int, j: int) -> str:
        """Return the name of a cell."""
        return f"{self.x.name(i)}|{self.y.name(j)}"


@dataclass(frozen=True)
class Plan:
    """A map to be filled: `trial(x, y)` gets two numbers or words; `predict` gives the limits to be drawn.

    seconds : a trial that takes longer is stopped   warm : has everything compiled first, which counts in no trial
    """

    map: Map
    trial: Callable[[Any, Any], Cell]
    predict: Callable[[], list[Limit]] | None = None
    seconds: float = 10.0
    warm: Callable[[], None] | None = None


@dataclass
class Atlas:
    """All maps that were made in one folder."""

    version: int = VERSION
    machine: str = ""
    maps: list[Map] = field(default_factory=list)


class TimeIsUp(BaseException):
    """A trial took too long; no solver's `except Exception` swallows it."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `TimeIsUp` in what runs longer, where the system can (the main thread of a Unix program)."""
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        if _compiles(frame):  # what is compiled by half would be broken for all trials to come
            signal.setitimer(signal.ITIMER_REAL, 0.2)
            return
        raise TimeIsUp

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _compiles(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith(("numba.", "llvmlite.")):
            return True
        frame = frame.f_back
    return False


def tried(plan: Plan, i: int, j: int) -> Cell:
    """Return the cell in column `i` and row `j`: whatever goes wrong there is an outcome with a reason."""
    x, y = (axis.words[k] if axis.words else axis.values[k] for axis, k in ((plan.map.x, i), (plan.map.y, j)))
    started = perf_counter()
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"), time_limit(plan.seconds):
            warnings.simplefilter("ignore")
            cell = plan.trial(x, y)
    except TimeIsUp:
        cell = Cell(REFUSED, f"no answer within {plan.seconds:g} s")
    except DivergenceError as error:
        cell = Cell(NOT_FINITE, str(error))
    except FaceanimError as error:
        cell = Cell(REFUSED, str(error))
    except Exception as error:
        cell = Cell(NOT_FINITE, f"broke with {type(error).__name__}: {error}")
    known = cell.error if cell.error is not None and np.isfinite(cell.error) else None
    return replace(cell, reason=cell.reason[:LONGEST], error=known, seconds=perf_counter() - started)


class Store:
    """The file of an atlas: read once, written whole at most every `SAVE_EVERY` seconds and at the end of each map."""

    def __init__(self, path: Path, machine: str = "") -> None:
        self.path = path
        self.atlas = load(path.read_bytes(), str(path)) if path.exists() else Atlas()
        self.atlas.machine = machine or self.atlas.machine
        self._written = perf_counter()

    def map_for(self, planned: Map) -> Map:
        """Keep `planned`, with the cells that an earlier map of that key has, and return it."""
        for k, kept in enumerate(self.atlas.maps):
            if kept.key == planned.key:
                same = (kept.x, kept.y) == (planned.x, planned.y)
                planned.cells, planned.limits = kept.cells, kept.limits if same else None
                self.atlas.maps[k] = planned
                return planned
        self.atlas.maps.append(planned)
        return planned

    def save(self, *, now: bool = False) -> None:
        """Write the file if that is due, or `now`."""
        if now or perf_counter() - self._written > SAVE_EVERY:
            write_whole(self.path, msgspec.json.format(msgspec.json.encode(self.atlas), indent=1))
            self._written = perf_counter()


def missing(plan: Plan, store: Store) -> list[tuple[int, int]]:
    """Return the places (column, row) of the planned map that are not in the store."""
    kept = store.map_for(plan.map)
    places = [(i, j) for j in range(len(plan.map.y.values)) for i in range(len(plan.map.x.values))]
    return [(i, j) for i, j in places if kept.at(i, j) is None]


def fill(plan: Plan, store: Store, hear: Callable[[], None] = lambda: None) -> Map:
    """Try the missing cells of a planned map, keep each as it comes, and return the map; `hear` is called after each."""
    kept, places = store.map_for(plan.map), missing(plan, store)
    try:
        if places and plan.warm is not None:
            plan.warm()
        for i, j in places:
            kept.cells[kept.place(i, j)] = tried(plan, i, j)
            store.save()
            hear()
        if kept.limits is None:
            kept.limits = [] if plan.predict is None else plan.predict()
    finally:
        store.save(now=True)
    return kept


def load(data: bytes, name: str) -> Atlas:
    """Return a saved atlas; raise `UserError` naming the file `name` if that is none or one of another version."""
    way_out = "move it away, or choose another folder, to start anew"
    try:
        atlas = msgspec.json.decode(data, type=Atlas)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{name} is not an atlas that can be read ({error}); {way_out}") from None
    if atlas.version != VERSION:
        raise UserError(
            f"{name} holds maps of version {atlas.version}, this program makes version {VERSION}; {way_out}"
        )
    unknown = {cell.outcome for one in atlas.maps for cell in one.cells.values()} - set(OUTCOMES)
    if unknown:
        raise UserError(f"{name} holds outcomes that are not known ({', '.join(sorted(unknown))}); {way_out}")
    return atlas


COLUMNS = ("scene", "map", "backend", "scheme", "x", "x_value", "y", "y_value", "outcome", "error", "tolerance", "steps",
           "seconds", "reason")  # fmt: skip


def shown(one: Map) -> Iterator[tuple[int, int, Cell]]:
    """Yield column, row and cell of what has been tried of the map's grid."""
    for j in range(len(one.y.values)):
        for i in range(len(one.x.values)):
            cell = one.at(i, j)
            if cell is not None:
                yield i, j, cell


def as_csv(maps: Sequence[Map]) -> str:
    """Return all cells as CSV with a header."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for one in maps:
        for i, j, cell in shown(one):
            error = "" if cell.error is None else f"{cell.error:.6g}"
            writer.writerow((one.scene, one.kind, one.backend, one.scheme, one.x.title, one.x.name(i), one.y.title,
                             one.y.name(j), cell.outcome, error, f"{one.tolerance:g}", cell.steps,
                             f"{cell.seconds:.3g}", cell.reason))  # fmt: skip
    return text.getvalue()


def counts(one: Map) -> dict[str, int]:
    """Return how many cells of the map's grid have each outcome."""
    found = dict.fromkeys(OUTCOMES, 0)
    for _, _, cell in shown(one):
        found[cell.outcome] += 1
    return found
