"""`faceanim compare`: every backend, scheme, density and step on one scene, error against cost."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from faceanim.cli.choices import number
from faceanim.ground.errors import UserError

if TYPE_CHECKING:
    from faceanim.bench.comparison.rows import Comparison, Row
    from faceanim.bench.comparison.scenes import Scene
    from faceanim.bench.comparison.sweep import Sweep
    from faceanim.cli.progress import Progress

NAMES = ("comparison.json", "comparison.csv", "comparison.png", "comparison.html")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim compare`."""
    parser.add_argument(
        "scene", nargs="?", metavar="SCENE", help="what to compare on, or all; without it the scenes are listed"
    )
    parser.add_argument("--out", metavar="DIR", help="folder for table, chart and page (default: compare-SCENE)")
    parser.add_argument("--quick", action="store_true", help="a tenth of the candidates, within three minutes")
    parser.add_argument("--backends", metavar="LIST", default="", help="only these, with commas")
    parser.add_argument("--densities", metavar="LIST", default="", help="only these, with commas")
    parser.add_argument("--limit", metavar="S", default="300",
                        help="seconds that the frames of one candidate may take (default: %(default)s)")  # fmt: skip
    parser.add_argument("--again", action="store_true", help="measure anew what is in the folder already")
    parser.add_argument("--quiet", action="store_true", help="no progress, only the front")


def words(text: str) -> tuple[str, ...]:
    """Return the words of a list with commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def run(args: argparse.Namespace) -> int:
    """Measure what is missing, then write table, chart and page, and print the front."""
    from faceanim.bench.comparison.scenes import SCENES, scene_named

    if args.scene is None:
        for one in SCENES.values():
            print(f"{one.name:14}  {one.title}. {one.about}")
        print("face-NAME, face-NAME@0.5: any expression of the library, at an intensity")
        return 0
    limit = number(args.limit, "--limit", 1.0, 86400.0)
    every = args.scene == "all"
    scenes = list(SCENES.values()) if every else [scene_named(args.scene)]
    base = Path(args.out or f"compare-{args.scene}")
    comparisons = [_compared(args, scene, base / scene.name if every else base, limit) for scene in scenes]
    if every:
        _overview(comparisons, base)
    return 0


def _compared(args: argparse.Namespace, scene: Scene, folder: Path, limit: float) -> Comparison:
    """Measure one scene, write its files and print its front."""
    from faceanim.bench.alone import alone
    from faceanim.bench.comparison.candidates import candidates
    from faceanim.bench.comparison.memory import machine_name, remember
    from faceanim.bench.comparison.sweep import Sweep
    from faceanim.cli.progress import Progress
    from faceanim.ground.notes import listening

    chosen = candidates(scene.name, quick=args.quick, backends=words(args.backends), densities=words(args.densities))
    with Progress(quiet=args.quiet) as progress, listening(progress.hear):
        progress.stage(f"what {scene.name} is measured against")
        sweep = Sweep(scene, chosen, folder, limit=limit, again=args.again)
        comparison = sweep.run(machine_name(), _watcher(progress, len(chosen)))
        progress.stage("drawing")
        with alone(folder):
            comparison = presented(sweep, comparison)
        try:
            remember(scene, comparison)
        except UserError as error:
            progress.note(f"not remembered for plans: {error}")
    _print(comparison)
    print(f"saved {', '.join(NAMES)} in {folder}")
    return comparison


def _overview(comparisons: list[Comparison], folder: Path) -> None:
    """Write the fronts of all scenes as one picture and one table."""
    from faceanim.bench.comparison.charts import overview_chart
    from faceanim.bench.comparison.fronts import as_markdown
    from faceanim.ground.files import write_whole

    overview_chart(comparisons, folder / "overview.png")
    write_whole(folder / "fronts.md", as_markdown(comparisons).encode())
    print(f"saved overview.png, fronts.md in {folder}")


def _watcher(progress: Progress, total: int) -> Any:
    """Return what shows each row as it comes."""
    begun = False

    def watch(row: Row) -> None:
        nonlocal begun
        if not begun:
            progress.stage("measuring", total)
            begun = True
        progress.advance()
        progress.detail(f"{row.label}: {_came_out(row)}")

    return watch


def _came_out(row: Row) -> str:
    """Return in a few words what was measured."""
    if not row.counts or row.frame_ms is None:
        return row.outcome
    from faceanim.bench.comparison.rows import worst

    return f"{row.frame_ms:.3g} ms a frame, {worst(row):.3g} mm"


def presented(sweep: Sweep, comparison: Comparison) -> Comparison:
    """Write table, chart, pictures and page; return the comparison whose rows name their pictures."""
    from faceanim.bench.comparison.charts import pareto_chart
    from faceanim.bench.comparison.gallery import draw_all
    from faceanim.bench.comparison.page import page
    from faceanim.bench.comparison.rows import as_csv
    from faceanim.ground.files import write_whole

    folder = sweep.folder
    comparison = draw_all(sweep.scene, comparison, folder)
    sweep.store(comparison)
    write_whole(folder / NAMES[1], as_csv(comparison).encode())
    pareto_chart(comparison, folder / NAMES[2])
    write_whole(folder / NAMES[3], page(comparison, folder / NAMES[2], folder).encode())
    return comparison


def _failures(rows: list[Row]) -> list[str]:
    """Return a line for each way in which candidates of a backend failed, all with the same reason together."""
    alike: dict[tuple[str, str, str], list[str]] = {}
    for row in rows:
        if row.outcome != "done":
            alike.setdefault((row.backend, row.outcome, row.reason), []).append(row.label)
    return [
        f"{labels[0]}{f' and {len(labels) - 1} more of {backend}' if len(labels) > 1 else ''}: {outcome}: {reason}"
        for (backend, outcome, reason), labels in alike.items()
    ]


def _print(comparison: Comparison) -> None:
    from rich.console import Console
    from rich.table import Table

    from faceanim.bench.comparison.rows import front, worst

    table = Table(
        title=f"{comparison.title}: the front, cheapest first", title_justify="left",
        caption=f"against {comparison.reference}; known to {comparison.uncertainty:.2g} mm", caption_justify="left",
    )  # fmt: skip
    for column in ("candidate", "a frame [ms]", "error RMS [mm]", "95 %", "largest", "of the movement"):
        table.add_column(column, justify="left" if column == "candidate" else "right")
    for row in front(comparison.rows):
        errors = max((e for e in (row.rest, row.along) if e is not None), key=lambda e: e.rms)
        table.add_row(
            row.label, f"{row.frame_ms:.3g}", f"{worst(row):.3g}", f"{errors.p95:.3g}", f"{errors.max:.3g}",
            f"{errors.relative:.1%}",
        )  # fmt: skip
    console = Console()
    if not console.is_terminal:
        console = Console(width=170)
    console.print(table)
    for line in _failures(comparison.rows):
        console.print(line, markup=False, highlight=False)
