"""The fronts of several scenes in one table."""

from __future__ import annotations

from collections.abc import Sequence

from faceanim.bench.comparison.rows import Comparison, front, worst

HEAD = (
    "| scene | on the front, cheapest first | a frame [ms] | error RMS [mm] | of the movement | reference known to [mm] |\n"
    "|---|---|---|---|---|---|\n"
)


def as_markdown(comparisons: Sequence[Comparison]) -> str:
    """Return the rows of every front, with what failed counted beneath each scene."""
    lines = []
    for one in comparisons:
        for k, row in enumerate(front(one.rows)):
            scene, known = (one.scene, f"{one.uncertainty:.2g}") if k == 0 else ("", "")
            share = worst(row) / one.movement if one.movement > 0.0 else 0.0
            lines.append(f"| {scene} | {row.label} | {row.frame_ms:.3g} | {worst(row):.3g} | {share:.1%} | {known} |\n")
        failed = sum(row.outcome != "done" for row in one.rows)
        lines.append(f"| | *{len(one.rows)} candidates, {failed} of them failed or declined* | | | | |\n")
    return HEAD + "".join(lines)
