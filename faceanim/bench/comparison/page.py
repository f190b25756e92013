"""A comparison as one page that needs nothing else: chart, table to sort and filter, pictures."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from math import isfinite
from pathlib import Path
from typing import Any

from faceanim.bench.comparison.page_style import SCRIPT, STYLE
from faceanim.bench.comparison.row_words import backends, densities, missing, number, plain, settings
from faceanim.bench.comparison.rows import CLOSE, Comparison, Errors, Row, excess, front, worst
from faceanim.bench.comparison.scatter import scatter
from faceanim.bench.marks import colour
from faceanim.ground.errors import UserError

PICTURE_WIDTH = 520
"""To which pictures are made smaller [pixel]."""
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


def page(comparison: Comparison, chart: Path, pictures: Path) -> str:
    """Return the comparison as one HTML page that loads nothing: no files, no scripts, no fonts from elsewhere.

    chart : the PNG of `comparison_charts.pareto_chart`   pictures : the folder that `Row.picture` starts from
    Pictures that are missing, cannot be read or lie outside that folder are left out.
    Raises `UserError` if the chart cannot be read.
    """
    try:
        drawn = "data:image/png;base64," + b64encode(chart.read_bytes()).decode()
    except OSError as error:
        raise UserError(f"chart {chart} cannot be read ({error.strerror}); draw it before the page") from None
    rows = comparison.rows
    entries = _entries(rows)
    parts = [
        f"<h1>{escape(comparison.title)}</h1>",
        _about(comparison),
        _figure(drawn, rows),
        _scatter(entries, comparison.uncertainty),
        _filters(rows),
        _table(entries),
        _gallery(entries, pictures),
    ]
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(comparison.title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(part for part in parts if part)
        + f"\n</main>\n<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


@dataclass(frozen=True)
class Entry:
    """A row with its number on the page, whether it stands on the front, and how much dearer than that it is."""

    row: Row
    number: int
    best: bool
    excess: float | None


def _entries(rows: Sequence[Row]) -> list[Entry]:
    """Return the rows in the order of the page: by cost, failures last."""
    best = {id(row) for row in front(list(rows))}
    order = sorted(rows, key=lambda row: (not row.counts, row.frame_ms if row.counts else 0.0))
    return [
        Entry(row, k, id(row) in best, excess(row, list(rows)) if row.counts else None)
        for k, row in enumerate(order, start=1)
    ]


def _about(comparison: Comparison) -> str:
    rows = comparison.rows
    counted = sum(row.counts for row in rows)
    facts = (
        ("scene", comparison.scene),
        ("reference", comparison.reference),
        ("uncertainty of the reference", f"{number(comparison.uncertainty)} mm RMS, from two levels of it"),
        ("movement", f"{number(comparison.movement)} mm RMS in the last frame"),
        ("measured on", comparison.machine),
        ("rows", f"{counted} measured, {len(rows) - counted} not"),
    )
    listed = "".join(f"<div><dt>{name}</dt><dd>{escape(value)}</dd></div>" for name, value in facts if value)
    return f'<dl class="facts">{listed}</dl>'


def _figure(drawn: str, rows: Sequence[Row]) -> str:
    caption = (
        f"Error (the larger RMS of last frame and motion) against the median cost of a frame, with its quartiles. "
        f"Front: from the most accurate row on, each next one costs less by a factor of more than {CLOSE:g}."
    )
    if out := missing(rows):
        caption += f" {out.capitalize()}."
    return (
        f'<figure class="chart"><div class="wide"><img src="{drawn}" alt="Chart: error against cost per frame"></div>'
        + (f"<figcaption>{escape(caption)}</figcaption></figure>")
    )


def _scatter(entries: Sequence[Entry], uncertainty: float) -> str:
    if not any(entry.row.counts for entry in entries):
        return ""
    return f'<h2 class="screen">Row by row</h2>{scatter(entries, uncertainty)}'


def _filters(rows: Sequence[Row]) -> str:
    groups = (("backend", backends(rows)), ("density", densities(rows)))
    out = ['<form class="filters" aria-label="Rows to show">']
    for kind, names in groups:
        boxes = "".join(
            f'<label><input type="checkbox" checked data-filter="{kind}" value="{escape(name)}"> '
            f"{escape(plain(name))}</label>"
            for name in names
        )
        out.append(f"<fieldset><legend>{kind}</legend>{boxes}</fieldset>")
    out.append('<fieldset><legend>front</legend><label><input type="checkbox" data-front> only the front</label>')
    return "".join(out) + '</fieldset><p role="status" class="shown"></p></form>'


@dataclass(frozen=True)
class Cell:
    """What stands in a cell: the text and, for a number, the value that it is sorted by."""

    text: str
    value: float | None = None
    numeric: bool = True


def _measured(value: float | None, factor: float = 1.0) -> Cell:
    """Return a number as a cell; nothing if it was not measured."""
    if value is None or not isfinite(value):
        return Cell("–")
    return Cell(number(factor * value), factor * value)


def _rms(errors: Errors | None) -> Cell:
    return _measured(None if errors is None else errors.rms)


NAMED = ("backend", "scheme", "density", "step [ms]", "settings")
MEASURED = (
    "cost [ms/frame]", "error [mm]", "times the front", "quartiles [ms]", "rest [mm]", "motion [mm]", "motion 95 % [mm]",
    "motion max [mm]", "motion / movement [%]", "stepping [mm]", "inverted", "unknowns", "steps per frame", "threads",
    "set up [s]", "compiling [s]", "memory [MB]",
)  # fmt: skip


HEADS = ("candidate", *MEASURED, *NAMED)


def _named_cells(row: Row) -> list[Cell]:
    words = (plain(row.backend), plain(row.scheme), row.density)
    named = [Cell(text, numeric=False) for text in words]
    return [*named, _measured(row.step, 1e3), Cell(settings(row), numeric=False)]


def _measured_cells(entry: Entry) -> list[Cell]:
    row, along = entry.row, entry.row.along
    low, high = row.frame_low_ms, row.frame_high_ms
    spread = "–" if low is None or high is None else f"{number(low)} – {number(high)}"
    return [
        _measured(row.frame_ms),
        _measured(worst(row) if row.counts else None),
        _measured(entry.excess),
        Cell(spread, low),
        _rms(row.rest),
        _rms(along),
        _measured(along.p95 if along else None),
        _measured(along.max if along else None),
        _measured(along.relative if along else None, 100.0),
        _rms(row.scheme_error),
        _measured(row.inverted),
        Cell(str(row.unknowns), row.unknowns),
        Cell(str(row.steps_per_frame), row.steps_per_frame),
        Cell(str(row.threads), row.threads),
        _measured(row.setup_s),
        _measured(row.compile_s),
        _measured(row.memory_mb),
    ]


def _table(entries: Sequence[Entry]) -> str:
    heads = "".join(
        f'<th scope="col"{_order(name)}><button type="button">{escape(name)}</button></th>' for name in HEADS
    )
    body = "\n".join(_line(entry) for entry in entries)
    return (
        "<h2>Table</h2><p>Click on a heading to sort; rows on the front are marked ●, rows that were not measured to "
        'the end come last.</p><div class="scroll" tabindex="0" role="region" aria-label="All rows">'
        f"<table><thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
    )


def _order(name: str) -> str:
    return ' aria-sort="ascending"' if name == MEASURED[0] else ' aria-sort="none"'


def _line(entry: Entry) -> str:
    row = entry.row
    kind = "front" if entry.best else "beaten" if row.counts else "failed"
    swatch = f'<span class="swatch" style="background:{colour(row.backend)}"></span>'
    flag = '<span class="flag" title="on the front">● </span>' if entry.best else ""
    first = f'<th scope="row" data-sort="{escape(row.label)}">{swatch}{flag}{escape(row.label)}</th>'
    if row.counts:
        cells = "".join(_cell(cell) for cell in _measured_cells(entry))
    else:
        cells = f'<td class="reason" colspan="{len(MEASURED)}"><div>{_why(row)}</div></td>'
    cells = first + cells + "".join(_cell(cell) for cell in _named_cells(row))
    return f'<tr id="row-{entry.number}" class="{kind}" tabindex="-1" {_keys(entry)}>{cells}</tr>'


def _keys(entry: Entry) -> str:
    """Return the attributes that filters go by."""
    row = entry.row
    return f'data-backend="{escape(row.backend)}" data-density="{escape(row.density)}" data-best="{int(entry.best)}"'


def _cell(cell: Cell) -> str:
    if not cell.numeric:
        return f'<td data-sort="{escape(cell.text)}">{escape(cell.text)}</td>'
    value = "" if cell.value is None else f' data-value="{cell.value:.9g}"'
    return f'<td class="number"{value}>{escape(cell.text)}</td>'


def _why(row: Row) -> str:
    """Return outcome and reason of a row that does not count, with what was measured all the same."""
    outcome = "not measured" if row.outcome == "done" else row.outcome
    known = [f"{number(row.frame_ms)} ms per frame"] if row.frame_ms is not None else []
    known += [f"{number(row.along.rms)} mm off"] if row.along is not None else []
    seen = f" ({', '.join(known)})" if known else ""
    return f"<strong>{escape(outcome)}</strong>{escape(seen)}: {escape(row.reason or 'no reason given')}"


def _gallery(entries: Sequence[Entry], pictures: Path) -> str:
    out = []
    for entry in entries:
        drawn = _embedded(pictures, entry.row.picture)
        if drawn is None:
            continue
        row = entry.row
        text = f"{number(row.frame_ms)} ms, {number(worst(row))} mm" if row.counts and row.frame_ms else row.outcome
        flag = '<span class="flag">● </span>' if entry.best else ""
        out.append(
            f'<figure {_keys(entry)}><a href="#row-{entry.number}"><img src="{drawn}" '
            f'alt="last frame, {escape(row.label)}"></a>'
            f"<figcaption>{flag}{escape(row.label)}<br><b>{escape(text)}</b></figcaption></figure>"
        )
    if not out:
        return ""
    intro = "<p>In colours of the distance from the reference, all on one scale; cost per frame and error below.</p>"
    return f'<h2>Last frames</h2>{intro}<div class="gallery">{"".join(out)}</div>'


def _embedded(folder: Path, name: str | None) -> str | None:
    """Return a picture as a data address, made smaller; None if it is none or lies outside the folder."""
    if not name:
        return None
    from PIL import Image

    try:
        path = (folder / name).resolve()
        if not path.is_relative_to(folder.resolve()):
            return None
        with Image.open(path) as opened:
            image: Any = opened.convert("RGB")
    except (OSError, ValueError, Image.DecompressionBombError):
        return None
    image.thumbnail((PICTURE_WIDTH, 2 * PICTURE_WIDTH))
    data = BytesIO()
    image.save(data, "JPEG", quality=82)
    return "data:image/jpeg;base64," + b64encode(data.getvalue()).decode()
