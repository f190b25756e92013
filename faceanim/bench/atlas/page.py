"""All stability maps as one page: every cell tells its reason when pointed at. Nothing is fetched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

from faceanim.bench.atlas.cells import OUTCOMES, Map, counts, shown
from faceanim.bench.atlas.charts import INK, LETTERS, edges, place
from faceanim.bench.marks import OUTCOME_COLOURS

WIDTH, ROW = 34, 26
"""Of a cell [px]."""
STYLE = """body{font:15px/1.45 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem;color:#22262b}
h2{margin-top:2.2rem}figure{display:inline-block;margin:0 2rem 1.6rem 0;vertical-align:top}figcaption{font-weight:600}
p{max-width:46rem}small{color:#5d646d}svg text{font:11px system-ui,sans-serif;fill:#22262b}
.key span{display:inline-block;padding:.1rem .6rem;margin-right:.4rem}rect:hover{stroke:#22262b;stroke-width:2}"""


def page(maps: Sequence[Map], machine: str) -> str:
    """Return the page."""
    key = "".join(
        f'<span style="background:{OUTCOME_COLOURS[o]};color:{INK[o]}">{LETTERS[o]} {o}</span>' for o in OUTCOMES
    )
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>Stability maps</title>",
        f"<style>{STYLE}</style><h1>Stability maps</h1><p class=key>{key}</p>",
        f"<p>Point at a cell for its reason. Lines are predicted limits. <small>{escape(machine)}</small></p>",
    ]
    for heading in dict.fromkeys((one.scene, one.kind) for one in maps):
        group = [one for one in maps if (one.scene, one.kind) == heading]
        parts.append(f"<h2>{escape(heading[0])}: {escape(heading[1])}</h2><p>{escape(group[0].caption)}</p>")
        parts.extend(_figure(one) for one in group)
    return "\n".join(parts) + "\n"


def _figure(one: Map) -> str:
    tally = ", ".join(f"{n} {o}" for o, n in counts(one).items() if n)
    note = f"converged within {one.tolerance:g} ({one.measure}); {tally}"
    return (
        f"<figure><figcaption>{escape(one.title)}</figcaption>{_drawing(one)}<br><small>{escape(note)}</small></figure>"
    )


def _drawing(one: Map) -> str:
    """Return a map as SVG."""
    nx, ny = len(one.x.values), len(one.y.values)
    left = 8 + 7 * max(len(one.y.name(j)) for j in range(ny))
    bottom = 14 + (5 * max(len(one.x.name(i)) for i in range(nx)) if nx > 4 or one.x.words else 14)
    width, height = left + nx * WIDTH + 60, ny * ROW + bottom + 24
    out = [f'<svg width="{width}" height="{height}" role="img" aria-label="{escape(one.title)}">']
    for i, j, cell in shown(one):
        a, b = left + i * WIDTH, _row(one, j) * ROW
        says = f"{one.x.title} {one.x.name(i)}, {one.y.title} {one.y.name(j)}: {cell.outcome}. {cell.reason}"
        error = "" if cell.error is None else f" (error {cell.error:.3g})"
        out.append(
            f'<rect x="{a}" y="{b}" width="{WIDTH - 1}" height="{ROW - 1}" fill="{OUTCOME_COLOURS[cell.outcome]}">'
            f"<title>{escape(says + error)}</title></rect>"
            f'<text x="{a + WIDTH / 2}" y="{b + ROW / 2 + 4}" text-anchor="middle" pointer-events="none" '
            f'style="fill:{INK[cell.outcome]}">{LETTERS[cell.outcome]}</text>'
        )
    out.extend(f'<text x="{left - 6}" y="{_row(one, j) * ROW + ROW / 2 + 4}" text-anchor="end">{escape(one.y.name(j))}'
               "</text>" for j in range(ny))  # fmt: skip
    for i in range(nx):
        x, y = left + i * WIDTH + WIDTH / 2, ny * ROW + 14
        out.append(f'<text x="{x}" y="{y}" transform="rotate(35 {x} {y})">{escape(one.x.name(i))}</text>')
    out.append(f'<text x="{left}" y="{height - 4}">{escape(_axis_words(one))}</text>')
    out.extend(_lines(one, left))
    return "".join(out) + "</svg>"


def _row(one: Map, j: int) -> int:
    """Return which row from the top shows row `j`: numbers grow upwards, lists are read downwards."""
    return j if one.y.words else len(one.y.values) - 1 - j


def _axis_words(one: Map) -> str:
    x, y = (f"{a.title} [{a.unit}]" if a.unit else a.title for a in (one.x, one.y))
    return f"right: {x}; {'down' if one.y.words else 'up'}: {y}"


def _lines(one: Map, left: float) -> list[str]:
    """Return the limits as lines over the cells."""
    across, up = edges(one.x), edges(one.y)
    nx, ny = len(one.x.values), len(one.y.values)
    out: list[str] = []
    for limit in one.limits or []:
        points = []
        for a, b in zip(limit.x, limit.y):
            u, v = place(one.x, a), place(one.y, b)
            if math.isfinite(u) and math.isfinite(v):
                points.append(
                    (left + nx * WIDTH * (u - across[0]) / (across[-1] - across[0]),
                     ny * ROW * abs((0.0 if one.y.words else 1.0) - (v - up[0]) / (up[-1] - up[0])))
                )  # fmt: skip
        inside = [(x, y) for x, y in points if left <= x <= left + nx * WIDTH and 0 <= y <= ny * ROW]
        title = f"<title>{escape(limit.label)}</title>"
        if one.y.words:
            out.extend(f'<path d="M{x:.1f} {y - ROW / 2:.1f}v{ROW}" stroke="#0b3c5d" stroke-width="3">{title}</path>'
                       for x, y in inside)  # fmt: skip
        elif inside:
            path = " ".join(f"{x:.1f},{y:.1f}" for x, y in inside)
            out.append(f'<polyline points="{path}" fill="none" stroke="#0b3c5d" stroke-width="2">{title}</polyline>')
    return out
