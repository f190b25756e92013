"""`faceanim framerate`: the paper's Table 1 for every expression, beside the published figures."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from faceanim.cli.choices import add_simulation, number, solver_options, use_threads, whole
from faceanim.ground.errors import UserError

if TYPE_CHECKING:
    from faceanim.bench.framerate import Row
    from faceanim.cli.progress import Progress

NAMES = ("framerate.csv", "framerate.json", "framerate.md", "framerate.png")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim framerate`."""
    parser.add_argument("--expressions", metavar="LIST", help="names with commas (default: all of the library)")
    parser.add_argument("--out", metavar="DIR", default="framerate", help="folder for tables and chart")
    parser.add_argument("--fps", default="30", metavar="N", help="frames per second simulated (default: %(default)s)")
    parser.add_argument(
        "--size", default="512", metavar="N", help="pixels drawn, 0 = no drawing (default: %(default)s)"
    )
    parser.add_argument("--no-accuracy", action="store_true", help="do not measure errors, only times")
    parser.add_argument("--quiet", action="store_true", help="no progress, only the table")
    add_simulation(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, print the table, and save it with its chart."""
    from faceanim.bench import framerate
    from faceanim.cli.progress import Progress
    from faceanim.session.recording import disk_errors, machine, make_folder, write_record

    size = whole(args.size, "--size", 0, 4096)
    folder = Path(args.out)
    make_folder(folder)
    threads = use_threads(args.threads)
    sessions = _sessions(args)
    with Progress(quiet=args.quiet) as progress:
        rows = _measure(sessions, size, threads, progress, accuracy=not args.no_accuracy)
        progress.stage("comparing the work of a part of the mesh with all of it")
        chosen = next((one for one in sessions if one.expression.name == "happiness"), sessions[0])
        shares = framerate.shares(chosen)
    computer = machine()
    _print(rows, shares, computer)
    record = {"machine": computer, "size": size, "rows": rows, "published": framerate.PAPER, "shares": shares}
    with disk_errors(folder):
        (folder / NAMES[0]).write_text(framerate.as_csv(rows), encoding="utf-8")
        (folder / NAMES[2]).write_text(framerate.as_markdown(rows), encoding="utf-8")
        from faceanim.bench.charts import frame_rate_chart

        frame_rate_chart(rows, folder / NAMES[3], f"this machine ({computer['processor']})")
    write_record(folder / NAMES[1], record)
    print(f"saved {', '.join(NAMES)} in {folder}")
    return 0


def _sessions(args: argparse.Namespace) -> list[Any]:
    from faceanim.expression.library import expression_names, load_expression
    from faceanim.face.library import load_face
    from faceanim.session.session import FPS_LIMITS, Session

    fps = number(args.fps, "--fps", *FPS_LIMITS)
    asked = args.expressions.split(",") if args.expressions else [n for n in expression_names() if n != "neutral"]
    expressions = [load_expression(name.strip()) for name in asked if name.strip()]
    if not expressions:
        raise UserError("--expressions names none; leave it out to measure all")
    options = solver_options(args)
    face = load_face(args.face, args.density or "default")
    body = face.body()
    return [Session(face, one, fps=fps, backend=args.backend, options=options, body=body) for one in expressions]


def _measure(sessions: list[Any], size: int, threads: int, progress: Progress, *, accuracy: bool) -> list[Row]:
    """Simulate on one core and draw on `threads`; return one row per expression."""
    from faceanim.bench.framerate import frame_rates
    from faceanim.cli.drawing import session_drawer
    from faceanim.ground.notes import listening

    progress.stage("compiling what is not compiled yet")
    draw = session_drawer(size) if size else None
    with listening(progress.hear):
        return list(frame_rates(sessions, draw, accuracy=accuracy, drawing_threads=threads))


def _print(rows: list[Row], shares: list[Any], computer: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    from faceanim.bench.framerate import COLUMNS, beside_paper, cells

    table = Table(
        title=f"Table 1 on {computer['processor']}, {computer['cores']} cores: one to simulate, all to draw",
        caption="dim: Zhang, Prakash & Sung, Pentium III 730 MHz",
        title_justify="left",
    )
    for column in COLUMNS:
        table.add_column(column, justify="left" if column == COLUMNS[0] else "right")
    for row, paper in beside_paper(rows):
        table.add_row(*cells(row))
        if paper is not None:
            table.add_row(*(("published", *cells(paper)[1:])), style="dim")
    console = Console()
    if not console.is_terminal:
        console = Console(width=170)
    console.print(table)
    for share in shares:
        words = (
            f"{share.what}: {share.vertices} vertices ({share.worked_on} computed), "
            f"{share.iteration_ms:.3f} ms an iteration, {share.share:.3f} of all"
        )
        console.print(words, highlight=False)
