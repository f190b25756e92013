"""What the papers claim, each measured here by one function that ends in a table, a picture and a verdict.

A claim's function takes a `Request` and returns a `Finding`: lines of a table (ours beside the printed number), criteria
with limits, and how to draw the picture. The verdict follows from the criteria alone.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from faceanim.ground.errors import unknown_name

VERDICTS = ("reproduced", "reproduced in kind", "not reproduced")


@dataclass(frozen=True)
class Line:
    """One quantity beside the printed one.

    case : what it is measured on   ours, published : numbers, words, or None = none there is
    compare : "yes", or why the two cannot be compared   detail : left out of the printed table, kept in the CSV
    """

    case: str
    quantity: str
    unit: str
    ours: float | int | str | None
    published: float | int | str | None
    compare: str = "yes"
    detail: bool = False

    @property
    def words(self) -> tuple[str, ...]:
        """The line as the words of a table with `COLUMNS`."""
        return self.case, self.quantity, self.unit, written(self.ours), written(self.published), self.compare


COLUMNS = ("case", "quantity", "unit", "ours", "published", "can be compared")


@dataclass(frozen=True)
class Criterion:
    """One thing that the paper says, as limits on a measured value: low <= value <= high.

    printed : whether the limits surround a printed number (then it decides between "reproduced" and "in kind"), or only
    what the paper says in words (then it must hold for either)
    """

    statement: str
    value: float
    low: float = float("-inf")
    high: float = float("inf")
    printed: bool = False

    @property
    def met(self) -> bool:
        """Whether the value lies within the limits; never for one that is not a number."""
        return bool(self.low <= self.value <= self.high)

    @property
    def wanted(self) -> str:
        """The limits in words."""
        if self.low == float("-inf"):
            return f"at most {written(self.high)}"
        return f"at least {written(self.low)}" if self.high == float("inf") else (
            f"{written(self.low)} to {written(self.high)}"
        )  # fmt: skip


@dataclass(frozen=True)
class Finding:
    """What a claim's function found; `draw` makes the picture, `notes` say what else a reader must know."""

    lines: tuple[Line, ...]
    criteria: tuple[Criterion, ...]
    draw: Callable[[Path], None]
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """One of `VERDICTS`: reproduced if all criteria are met and one of them is about a printed number, in kind if
        all those about what is said in words are met, else not.
        """
        if not all(c.met for c in self.criteria if not c.printed):
            return VERDICTS[2]
        printed = [c.met for c in self.criteria if c.printed]
        if printed and all(printed):
            return VERDICTS[0]
        return VERDICTS[1] if len(printed) < len(self.criteria) else VERDICTS[2]

    @property
    def sentence(self) -> str:
        """The verdict with its reason."""
        missed = [c for c in self.criteria if not c.met]
        told = f"{len(self.criteria) - len(missed)} of {len(self.criteria)} criteria met"
        if missed:
            told += "; not met: " + "; ".join(f"{c.statement} ({written(c.value)}, {c.wanted})" for c in missed)
        elif self.verdict == VERDICTS[1]:
            told += "; the paper prints no number that could be compared"
        return f"{self.verdict}: {told}."


@dataclass(frozen=True)
class Request:
    """What may be chosen.

    moves : operations of mixed-fig-8   rounds : how often a cost is measured; the least counts
    draw_frame : draws a session's points at a time in a picture of usual size, None = drawing is not measured
    drawing_threads : with so many threads
    """

    moves: tuple[str, ...] = ("mandible_advance",)
    rounds: int = 20
    draw_frame: Callable[[Any, Any, float], Any] | None = None
    drawing_threads: int = 1


@dataclass(frozen=True)
class Claim:
    """A figure or table of a paper: `function` ("module:name") measures it."""

    name: str
    title: str
    paper: str
    shows: str
    function: str
    span: str = field(default="seconds")

    def measure(self, request: Request | None = None) -> Finding:
        """Return what is found; it takes about `span`."""
        module, name = self.function.split(":")
        found: Finding = getattr(import_module(f"faceanim.bench.claims.{module}"), name)(request or Request())
        return found


ZHANG = "Zhang, Prakash & Sung"
YOU = "You, Zhang & Comninos"
CHOI_KO = "Choi & Ko"
MIXED = "the mixed-element paper"

CLAIMS = {
    claim.name: claim
    for claim in (
        Claim("zhang-table-1", "Table 1", ZHANG, "node counts, costs by phase and frame rate of five expressions",
              "zhang:table_1", "a minute"),
        Claim("you-tables-1-4", "Tables 1 to 4", YOU, "three blocks: distance from the truth, and numbers of unknowns",
              "you:tables"),
        Claim("choi-ko-fig-4", "Fig. 4", CHOI_KO, "a bar under growing gravity: linear, warped and nonlinear shapes",
              "choi_ko:figure_4"),
        Claim("choi-ko-fig-5", "Fig. 5", CHOI_KO, "error and change of volume of that bar against gravity",
              "choi_ko:figure_5"),
        Claim("choi-ko-fig-6", "Fig. 6", CHOI_KO, "error of the bar that swings after a pulse of gravity",
              "choi_ko:figure_6"),
        Claim("choi-ko-fig-11", "Fig. 11", CHOI_KO, "the term that Eq. 13 neglects, on three meshes",
              "choi_ko:figure_11"),
        Claim("choi-ko-table-1", "Table I", CHOI_KO, "cost of precomputation and of a frame by size of the model",
              "choi_ko:table_1"),
        Claim("mixed-table-2", "Table 2", MIXED, "taking flesh out of moved bones: time and error vertices",
              "mixed:table_2"),
        Claim("mixed-fig-8", "Fig. 8", MIXED, "four models of soft tissue: skin within 1.5 mm of the truth",
              "mixed:figure_8", "half a minute a move, and minutes for each truth the first time"),
    )
}  # fmt: skip
"""Name -> claim."""


def chosen(name: str | None) -> tuple[Claim, ...]:
    """Return the claims called `name` ("all" = every one); raise `UserError` for an unknown name."""
    if name == "all":
        return tuple(CLAIMS.values())
    if name not in CLAIMS:
        raise unknown_name("claim", str(name), [*CLAIMS, "all", "list"])
    return (CLAIMS[name],)


def written(value: float | int | str | None) -> str:
    """Return a value as a table shows it: four figures, "-" for none."""
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def as_csv(finding: Finding) -> str:
    """Return all lines as CSV with a header, details too."""
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(COLUMNS)
    for line in finding.lines:
        values = [f"{v:.6g}" if isinstance(v, float) else "" if v is None else v for v in (line.ours, line.published)]
        out.writerow([line.case, line.quantity, line.unit, *values, line.compare])
    return text.getvalue()


def as_markdown(claim: Claim, finding: Finding, machine: str) -> str:
    """Return the verdict, the table and the criteria; `machine` says where it was measured."""
    parts = [f"# {claim.title} of {claim.paper}", f"What it shows: {claim.shows}.", f"**{_capital(finding.sentence)}**"]
    parts.append(f"![{claim.shows}]({claim.name}.png)")
    parts.append(_table(COLUMNS, [line.words for line in finding.lines if not line.detail]))
    rows = [
        (c.statement, written(c.value), c.wanted, "a printed number" if c.printed else "what is said in words",
         "yes" if c.met else "no")
        for c in finding.criteria
    ]  # fmt: skip
    parts.append(_table(("criterion", "measured", "wanted", "taken from", "met"), rows))
    parts += [*finding.notes, f"Measured on {machine}."]
    return "\n\n".join(parts) + "\n"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return "\n".join(lines + ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows])


def overview(found: Sequence[tuple[Claim, Finding]]) -> str:
    """Return a Markdown table of claims, their verdicts and where the details are."""
    rows = [
        (f"[{c.name}]({c.name}.md)", f"{c.paper}, {c.title}", c.shows, f.verdict,
         f"{sum(x.met for x in f.criteria)} of {len(f.criteria)}")
        for c, f in found
    ]  # fmt: skip
    return _table(("claim", "paper", "what it shows", "verdict", "criteria met"), rows) + "\n"
