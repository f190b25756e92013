"""`faceanim claims`: one command for each figure or table of the papers, measured here beside what is printed."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from faceanim.cli.choices import use_threads, whole
from faceanim.ground.errors import FaceanimError, UserError

if TYPE_CHECKING:
    from faceanim.bench.claims.claim import Claim, Finding, Request
    from faceanim.cli.progress import Progress

OVERVIEW = "claims.md"
OPERATIONS_OF = "mixed-fig-8"
"""The claim that --moves is for."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim claims`."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="a claim, or all; lists them if left out (or list)")
    parser.add_argument("--out", metavar="DIR", default="claims", help="folder for the results (default: %(default)s)")
    parser.add_argument("--moves", metavar="LIST", help="mixed-fig-8: operations with commas, or all "
                        "(default: mandible_advance)")  # fmt: skip
    parser.add_argument("--rounds", default="20", metavar="N", help="how often a cost is measured; the least counts "
                        "(default: %(default)s)")  # fmt: skip
    parser.add_argument("--size", default="512", metavar="N", help="zhang-table-1: pixels drawn, 0 = no drawing "
                        "(default: %(default)s)")  # fmt: skip
    parser.add_argument("--threads", metavar="N", help="processor cores to draw with (simulation takes one)")
    parser.add_argument("--quiet", action="store_true", help="no progress, only the tables")


def run(args: argparse.Namespace) -> int:
    """Measure what is asked for; return 1 if one of several could not be measured."""
    if args.name in (None, "list"):
        _list()
        return 0
    from faceanim.bench.claims.claim import chosen

    claims = chosen(args.name)
    if args.moves is not None and args.name not in (OPERATIONS_OF, "all"):
        raise UserError(f"--moves belongs to {OPERATIONS_OF}; leave it out for {args.name}")
    request, folder = _request(args), Path(args.out)
    from faceanim.cli.progress import Progress
    from faceanim.session.recording import make_folder

    make_folder(folder)
    with Progress(quiet=args.quiet) as progress:
        found, failed = _measured(claims, request, folder, progress)
    for claim, finding in found:
        _print(claim, finding)
    if len(claims) > 1:
        _write_overview(found, folder)
    return 1 if failed else 0


def _list() -> None:
    from rich.console import Console
    from rich.table import Table

    from faceanim.bench.claims.claim import CLAIMS

    table = Table(title="Claims of the papers: faceanim claims NAME --out DIR", title_justify="left")
    for column in ("name", "of", "what it shows", "takes"):
        table.add_column(column, no_wrap=column == "name")
    for claim in CLAIMS.values():
        table.add_row(claim.name, f"{claim.title}, {claim.paper}", claim.shows, claim.span)
    _console(Console).print(table)


def _request(args: argparse.Namespace) -> Request:
    """Return what the command line asks for, checked before anything is measured."""
    from faceanim.bench.claims.claim import Request
    from faceanim.cli.drawing import session_drawer

    size = whole(args.size, "--size", 0, 4096)
    rounds = whole(args.rounds, "--rounds", 1, 10_000)
    asked: dict[str, Any] = {}
    if args.moves is not None:
        from faceanim.bench.claims.mixed import checked_moves

        asked["moves"] = checked_moves([part.strip() for part in args.moves.split(",") if part.strip()])
    draw = session_drawer(size) if size else None
    return Request(rounds=rounds, draw_frame=draw, drawing_threads=use_threads(args.threads), **asked)


def _measured(
    claims: tuple[Claim, ...], request: Request, folder: Path, progress: Progress
) -> tuple[list[tuple[Claim, Finding]], bool]:
    """Measure one claim after the other and write each at once; one of several that fails is told and left out."""
    from faceanim.ground.notes import listening

    found, failed = [], False
    for k, claim in enumerate(claims, 1):
        progress.stage(f"{claim.name} ({k} of {len(claims)}, about {claim.span})")
        try:
            with listening(progress.hear):
                finding = claim.measure(request)
            _write(claim, finding, folder)
        except FaceanimError as error:
            if len(claims) == 1:
                raise
            progress.note(f"{claim.name} failed: {error}")
            failed = True
            continue
        found.append((claim, finding))
    return found, failed


def _write(claim: Claim, finding: Finding, folder: Path) -> None:
    from faceanim.bench.claims.claim import as_csv, as_markdown
    from faceanim.session.recording import disk_errors, machine

    computer = machine()
    words = f"{computer['processor']}, {computer['cores']} cores"
    with disk_errors(folder):
        (folder / f"{claim.name}.csv").write_text(as_csv(finding), encoding="utf-8")
        (folder / f"{claim.name}.md").write_text(as_markdown(claim, finding, words), encoding="utf-8")
        finding.draw(folder / f"{claim.name}.png")


def _write_overview(found: list[tuple[Claim, Finding]], folder: Path) -> None:
    from faceanim.bench.claims.claim import overview
    from faceanim.session.recording import disk_errors

    with disk_errors(folder):
        (folder / OVERVIEW).write_text(overview(found), encoding="utf-8")
    print(f"saved {OVERVIEW} and {len(found)} tables with pictures in {folder}")


def _print(claim: Claim, finding: Finding) -> None:
    from rich.console import Console
    from rich.table import Table

    from faceanim.bench.claims.claim import COLUMNS

    table = Table(title=f"{claim.name}: {claim.title} of {claim.paper}, {claim.shows}", title_justify="left")
    for column in COLUMNS:
        table.add_column(column, justify="right" if column in ("ours", "published") else "left")
    for line in finding.lines:
        if not line.detail:
            table.add_row(*line.words)
    console = _console(Console)
    console.print(table)
    console.print(f"{claim.name}: {finding.sentence}", highlight=False, markup=False, soft_wrap=True)


def _console(kind: Any) -> Any:
    console = kind()
    return console if console.is_terminal else kind(width=170)
