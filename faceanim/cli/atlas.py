"""`faceanim atlas`: stability maps of every scheme, cell by cell, with the limits that theory predicts."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from faceanim.ground.errors import UserError

if TYPE_CHECKING:
    from faceanim.bench.atlas.cells import Map, Plan, Store
    from faceanim.cli.progress import Progress

NAMES = ("atlas.json", "atlas.csv", "atlas.png", "atlas.html")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim atlas`."""
    parser.add_argument("scene", metavar="SCENE", help="sheet (skin on bone), bar, block, face, or all (all but face)")
    parser.add_argument("--out", metavar="DIR", default="atlas",
                        help="folder for maps; what is there already is not tried again (default: %(default)s)")  # fmt: skip
    parser.add_argument(
        "--maps", metavar="LIST", help="names with commas, such as time,starts (default: all of the scene)"
    )
    parser.add_argument("--backends", metavar="LIST", help="names with commas (default: all)")
    effort = parser.add_mutually_exclusive_group()
    effort.add_argument("--quick", action="store_true", help="coarser grids: a minute or two")
    effort.add_argument(
        "--full", action="store_true", help="finer grids, a million idle steps, lips pressed on teeth: hours"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress, only the summary")


def run(args: argparse.Namespace) -> int:
    """Try what is missing, draw everything, and print how many cells ended how."""
    from faceanim.bench.alone import alone
    from faceanim.bench.atlas.cells import Store
    from faceanim.bench.atlas.maps import FULL, QUICK, SCENES, USUAL
    from faceanim.bench.atlas.plans import plans
    from faceanim.cli.progress import Progress
    from faceanim.session.recording import machine, make_folder

    effort = QUICK if args.quick else FULL if args.full else USUAL
    names = [scene for scene in SCENES if scene != "face"] if args.scene == "all" else [args.scene]
    maps, backends = _listed(args.maps, "--maps"), _listed(args.backends, "--backends")
    planned = _planned(names, lambda name: plans(name, effort, maps=maps, backends=backends))
    folder = Path(args.out)
    make_folder(folder)
    computer = machine()
    with alone(folder), Progress(quiet=args.quiet) as progress:
        store = Store(folder / NAMES[0], f"{computer['processor']}, {computer['cores']} cores")
        filled = _fill(planned, store, progress)
        progress.stage("drawing")
        _draw(folder, store)
    _print(filled)
    print(f"saved {', '.join(NAMES)} and one picture per map in {folder}")
    return 0


def _listed(text: str | None, option: str) -> list[str] | None:
    if text is None:
        return None
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise UserError(f"{option} names none; leave it out for all")
    return names


def _planned(names: list[str], make: Callable[[str], list[Plan]]) -> list[Plan]:
    """Return the plans of all scenes; a scene of several may have nothing to try, all of them may not."""
    found: list[Plan] = []
    failure: UserError | None = None
    for name in names:
        try:
            found += make(name)
        except UserError as error:
            if len(names) == 1:
                raise
            failure = error
    if not found and failure is not None:
        raise failure
    return found


def _fill(planned: list[Plan], store: Store, progress: Progress) -> list[Map]:
    from faceanim.bench.atlas.cells import fill, missing

    total = sum(len(missing(plan, store)) for plan in planned)
    progress.stage("trying", total)
    maps = []
    for plan in planned:
        if missing(plan, store):
            progress.detail(f"{plan.map.scene}, {plan.map.kind}: {plan.map.title}")
        maps.append(fill(plan, store, progress.advance))
    return maps


def _draw(folder: Path, store: Store) -> None:
    """Draw all maps of the folder, those of earlier runs too."""
    from faceanim.bench.atlas.cells import as_csv
    from faceanim.bench.atlas.charts import map_chart, overview
    from faceanim.bench.atlas.page import page
    from faceanim.ground.files import write_whole
    from faceanim.session.recording import disk_errors

    maps = [one for one in store.atlas.maps if one.cells]
    with disk_errors(folder):
        write_whole(folder / NAMES[1], as_csv(maps).encode())
        write_whole(folder / NAMES[3], page(maps, store.atlas.machine).encode())
        for one in maps:
            map_chart(one, folder / f"{_file_name(one)}.png")
        if not overview(maps, folder / NAMES[2]):
            map_chart(maps[0], folder / NAMES[2])


def _file_name(one: Map) -> str:
    return "_".join(one.key.replace("/", " ").replace(",", "").split())


def _print(maps: list[Map]) -> None:
    from rich.console import Console
    from rich.table import Table

    from faceanim.bench.atlas.cells import OUTCOMES, counts

    table = Table(title="Cells by outcome", title_justify="left")
    for name in ("scene", "map", "scheme"):
        table.add_column(name)
    for name in OUTCOMES:
        table.add_column(name, justify="right")
    for one in maps:
        table.add_row(one.scene, one.kind, one.title, *(str(n or "") for n in counts(one).values()))
    console = Console()
    if not console.is_terminal:
        console = Console(width=150)
    console.print(table)
