"""Error against cost as inline SVG: every mark names its row when pointed at and leads to it in the table."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from math import ceil, floor, log10
from typing import Protocol

from faceanim.bench.comparison.row_words import FRAMES, number
from faceanim.bench.comparison.rows import Row, worst
from faceanim.bench.marks import colour, mark

WIDTH, HEIGHT = 900.0, 460.0
LEFT, RIGHT, TOP, BOTTOM = 62.0, 14.0, 14.0, 44.0
HEADROOM = 62.0
"""Above the highest mark, for the names of the frame rates."""
SHAPES = {
    "o": "M-6,0a6,6 0 1,0 12,0a6,6 0 1,0 -12,0z",
    "s": "M-5.5,-5.5h11v11h-11z",
    "^": "M0,-7L6.5,5.5H-6.5z",
    "v": "M0,7L6.5,-5.5H-6.5z",
    "D": "M0,-7.5L7.5,0L0,7.5L-7.5,0z",
    "P": "M-2.3,-7h4.6v4.7h4.7v4.6h-4.7v4.7h-4.6v-4.7h-4.7v-4.6h4.7z",
    "X": "M0,-3.2L3.2,-6.5L6.5,-3.2L3.2,0L6.5,3.2L3.2,6.5L0,3.2L-3.2,6.5L-6.5,3.2L-3.2,0L-6.5,-3.2L-3.2,-6.5z",
}
"""Outlines of the marks about the origin [unit of the picture], by Matplotlib's letters."""


class Numbered(Protocol):
    """A row with its number on the page."""

    @property
    def row(self) -> Row: ...
    @property
    def number(self) -> int: ...
    @property
    def best(self) -> bool: ...


class _Axis:
    """A logarithmic axis from `low` to `high`, drawn from `start` to `end`."""

    def __init__(self, values: Sequence[float], start: float, end: float) -> None:
        self.low, self.high = log10(min(values)) - 0.15, log10(max(values)) + 0.15
        self.start, self.end = start, end

    def __call__(self, value: float) -> float:
        share = (log10(value) - self.low) / (self.high - self.low)
        return self.start + share * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Return powers of ten, and twice and five times them on a short axis."""
        factors = (1.0, 2.0, 5.0) if self.high - self.low < 1.6 else (1.0,)
        powers = range(floor(self.low), ceil(self.high) + 1)
        return [f * 10.0**p for p in powers for f in factors if self.low <= log10(f * 10.0**p) <= self.high]


def scatter(entries: Sequence[Numbered], uncertainty: float) -> str:
    """Return the rows that count as inline SVG with a line of text below that tells of the mark pointed at."""
    counted = [entry for entry in entries if entry.row.counts]
    errors = [worst(entry.row) for entry in counted]
    least = min((e for e in errors if e > 0.0), default=1e-3)
    floor_of = [max(e, least) for e in errors]
    shown = [uncertainty] if uncertainty > least / 30.0 else []
    x = _Axis([*(e.row.frame_ms or 1.0 for e in counted), *(1e3 / rate for rate, _ in FRAMES)], LEFT, WIDTH - RIGHT)
    y = _Axis([*floor_of, *shown], HEIGHT - BOTTOM, TOP + HEADROOM)
    parts = [*_ground(x, y, shown), *(_mark(e, x, y, least) for e in sorted(counted, key=lambda e: e.best))]
    name = "Error against cost; every mark leads to its row"
    hint = "Point at a mark to see its row, click to find it in the table."
    box = f'viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="group" aria-label="{name}"'
    return (
        f'<div class="wide"><svg class="scatter" {box}>{"".join(parts)}</svg></div>'
        f'<p class="told" aria-live="polite">{hint}</p>'
    )


def _ground(x: _Axis, y: _Axis, uncertainty: Sequence[float]) -> list[str]:
    out = []
    for value in uncertainty:
        top, bottom = y(value), HEIGHT - BOTTOM
        out.append(f'<rect class="band" x="{LEFT}" y="{top:.1f}" width="{WIDTH - LEFT - RIGHT}" '
                   f'height="{bottom - top:.1f}"/>')  # fmt: skip
    for tick in x.ticks():
        out.append(_line(x(tick), TOP, x(tick), HEIGHT - BOTTOM, "grid"))
        out.append(_text(x(tick), HEIGHT - BOTTOM + 17, f"{tick:g}", "middle"))
    for tick in y.ticks():
        out.append(_line(LEFT, y(tick), WIDTH - RIGHT, y(tick), "grid"))
        out.append(_text(LEFT - 7, y(tick) + 4, f"{tick:g}", "end"))
    for rate, name in FRAMES:
        at = x(1e3 / rate)
        out.append(_line(at, TOP, at, HEIGHT - BOTTOM, "rate"))
        out.append(f'<text class="soft" transform="translate({at - 4:.1f},{TOP + 2}) rotate(-90)" '
                   f'text-anchor="end">{name}</text>')  # fmt: skip
    out.append(_text(0.5 * (LEFT + WIDTH - RIGHT), HEIGHT - 6, "cost per frame [ms]", "middle"))
    out.append(f'<text transform="translate(14,{0.5 * (TOP + HEIGHT - BOTTOM)}) rotate(-90)" '
               f'text-anchor="middle">error, RMS [mm]</text>')  # fmt: skip
    return out


def _line(x0: float, y0: float, x1: float, y1: float, kind: str) -> str:
    return f'<line class="{kind}" x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"/>'


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{text}</text>'


def _mark(entry: Numbered, x: _Axis, y: _Axis, least: float) -> str:
    row = entry.row
    cost = row.frame_ms or 1.0
    told = escape(f"{row.label}: {number(cost)} ms per frame, {number(worst(row))} mm")
    ink = colour(row.backend)
    fill = ink if entry.best else "var(--paper)"
    return (
        f'<a href="#row-{entry.number}" aria-label="{told}" data-told="{told}" data-backend="{escape(row.backend)}" '
        f'data-density="{escape(row.density)}" data-best="{int(entry.best)}">'
        f'<path transform="translate({x(cost):.1f},{y(max(worst(row), least)):.1f})" d="{SHAPES[mark(row.backend)]}" '
        f'fill="{fill}" stroke="{ink}"/><title>{told}</title></a>'
    )
