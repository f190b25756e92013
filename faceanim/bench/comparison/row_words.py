"""Rows of a comparison in words and short numbers, the same in charts and on the page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from statistics import median

from faceanim.bench.comparison.rows import Row

FRAMES = ((30.0, "30 frames/s"), (60.0, "60 frames/s"))
"""Frame rates to be compared with [1/s], and how they are called."""


def plain(name: str) -> str:
    """Return a name of the code in words."""
    return name.replace("_", " ")


def number(value: float) -> str:
    """Return a number with three digits that count, above a hundred all of them."""
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def step(row: Row) -> str:
    """Return the time step."""
    return f"{1e3 * row.step:.3g} ms"


def settings(row: Row) -> str:
    """Return the options that are not the defaults."""
    return ", ".join(f"{plain(name)} {value}" for name, value in row.settings.items())


def candidate(row: Row) -> tuple[str, str]:
    """Return a row in two short lines: backend and scheme; density and step."""
    return " ".join(plain(part) for part in (row.backend, row.scheme) if part), f"{row.density}, {step(row)}"


def densities(rows: Iterable[Row]) -> list[str]:
    """Return the densities that occur, from few unknowns to many."""
    unknowns: dict[str, list[int]] = {}
    for row in rows:
        unknowns.setdefault(row.density, []).append(row.unknowns)
    # Rows that failed early know no unknowns.
    return sorted(unknowns, key=lambda name: (median([n for n in unknowns[name] if n] or [0]), name))


def backends(rows: Iterable[Row]) -> list[str]:
    """Return the backends that occur, in the order of their first rows."""
    return list(dict.fromkeys(row.backend for row in rows))


def missing(rows: Sequence[Row]) -> str:
    """Return in one line how many rows have no place on a chart and why; "" if all have."""
    out = [row for row in rows if not row.counts]
    if not out:
        return ""
    kinds = Counter("not measured" if row.outcome == "done" else row.outcome for row in out)
    counted = ", ".join(f"{n} {plain(kind)}" for kind, n in kinds.most_common())
    return f"not on the chart: {len(out)} {'row' if len(out) == 1 else 'rows'} ({counted}; reasons in the table)"
