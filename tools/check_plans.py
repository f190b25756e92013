"""Check what plans promise on expressions that no plan is made from; write `docs/plans.md`.

    python tools/check_plans.py [--out FILE]

For each scene of `make_references.UNSEEN` plans are forecast from the measured face scenes, for several wishes; what they
choose is then run, and its error and its cost are compared with the promise. Some ten minutes once everything is measured.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from make_references import UNSEEN

from faceanim.bench.alone import alone
from faceanim.bench.comparison.candidates import candidate_of
from faceanim.bench.comparison.memory import machine_name, plan_for
from faceanim.bench.comparison.plan import cost
from faceanim.bench.comparison.rows import Row, worst
from faceanim.bench.comparison.scenes import scene_named
from faceanim.bench.comparison.sweep import Sweep
from faceanim.cli.progress import Progress
from faceanim.ground.folders import user_cache
from faceanim.ground.notes import listening

WISHES = ((0.5, 60.0), (1.0, 60.0), (1.5, 60.0), (2.0, 60.0))
"""Tolerance [mm] and frames per second."""
HEAD = (
    "| scene | wish | plan | promised | came out | held |\n"
    "|---|---|---|---|---|---|\n"
)  # fmt: skip
TABLE = Path(__file__).resolve().parent.parent / "docs" / "plans.md"


def came_out(name: str, row: Row) -> Row:
    """Return the row of the candidate of `row` in another scene, measured now or before."""
    scene = scene_named(name)
    folder = user_cache() / "checked_plans" / name
    return Sweep(scene, [candidate_of(row)], folder, limit=120.0).run(machine_name(), lambda row: None).rows[0]


def checked(progress: Progress) -> tuple[str, int, int]:
    """Return a Markdown table of all plans, how many held, and how many there were."""
    text, held, made = HEAD, 0, 0
    for name in UNSEEN:
        scene = scene_named(name)
        for tolerance, fps in WISHES:
            progress.stage(f"{name}, {tolerance:g} mm at {fps:g} frames/s")
            plan = plan_for(scene, tolerance, fps, watcher=lambda row: progress.detail(row.label), unseen=True)
            wish = f"{tolerance:g} mm, {fps:g} frames/s"
            if plan.chosen is None:
                text += f"| {name} | {wish} | none: {plan.sentence().partition(': ')[2]} | - | - | - |\n"
                continue
            row = came_out(name, plan.chosen.row)
            good = row.counts and worst(row) <= tolerance and cost(row, fps)[0] <= 1e3 / fps
            made, held = made + 1, held + good
            one = plan.chosen
            got = f"{worst(row):.2f} mm, {cost(row, fps)[0]:.1f} ms" if row.counts else row.outcome
            text += (
                f"| {name} | {wish} | {one.row.label} | {one.error:.2f} mm, {one.frame_ms:.1f} ms | {got} | "
                f"{'yes' if good else 'no'} |\n"
            )
    return text, held, made


def main() -> None:
    """Check all, write the table and print how many promises held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=TABLE)
    out = parser.parse_args().out
    with Progress() as progress, listening(progress.hear), alone(user_cache() / "checked_plans"):
        text, held, made = checked(progress)
    words = f"{held} of {made} promises held on {len(UNSEEN)} expressions that no plan was made from."
    out.write_text(f"{text}\n{words}\n", encoding="utf-8")
    print(words)


if __name__ == "__main__":
    main()
