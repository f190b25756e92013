"""`faceanim muscles`: facial muscle images to muscles, muscles to images, and what is wrong with either."""

from __future__ import annotations

import argparse
import csv
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from faceanim.cli.choices import add_face, face_asked, whole
from faceanim.ground.errors import UserError, unknown_name
from faceanim.ground.files import write_whole

if TYPE_CHECKING:
    import numpy as np

    from faceanim.face.face import Face
    from faceanim.face.muscle_image import Fault, MuscleMap
    from faceanim.face.muscles import AnyMuscle

KINDS = ("auto", "front", "cylinder")
TWINS = 1.5
"""Left and right muscles that mirror each other to this [mm], as well as a picture tells, are written as a pair."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim muscles`."""
    tasks = parser.add_subparsers(dest="task", metavar="TASK", required=True, parser_class=type(parser))
    text = "read a muscle image and write the muscles that it shows"
    task = tasks.add_parser("map", help=text, description=text, allow_abbrev=False)
    task.add_argument("image", metavar="IMAGE", help="a facial muscle image: PNG, JPEG or BMP, 8-bit RGB")
    task.add_argument("--out", metavar="FILE", default="muscles.toml", help="muscles; a .csv and a picture go beside them "
                      "(default: %(default)s)")  # fmt: skip
    task.add_argument(
        "--complete", action="store_true", help="take muscles that the picture lacks from the built-in list"
    )
    task.add_argument("--partial", action="store_true", help="write what can be read although something is wrong")
    task.add_argument("--quiet", action="store_true", help="only the closing line")
    _add_common(task)
    text = "draw the muscle image of a list of muscles"
    task = tasks.add_parser("draw", help=text, description=text, allow_abbrev=False)
    task.add_argument("muscles", metavar="MUSCLES", nargs="?", help="a .toml file (default: the built-in muscles)")
    task.add_argument("--out", metavar="FILE", default="muscles.png", help="picture to write (default: %(default)s)")
    task.add_argument("--size", metavar="N", default="512", help="pixels of a side (default: %(default)s)")
    task.add_argument("--blank", action="store_true", help="the face alone, to draw marks on in a paint program")
    _add_common(task, kinds=KINDS[1:])
    text = "say what is wrong with a muscle image or a list of muscles, and where"
    task = tasks.add_parser("check", help=text, description=text, allow_abbrev=False)
    task.add_argument("image", metavar="IMAGE", help="a facial muscle image, or a .toml file")
    task.add_argument("--marked", metavar="FILE", help="copy of the picture with the faults marked (default: IMAGE with "
                      "_checked added to its name; written only if something is wrong)")  # fmt: skip
    _add_common(task)


def _add_common(task: argparse.ArgumentParser, kinds: tuple[str, ...] = KINDS) -> None:
    task.add_argument("--kind", default=kinds[0], metavar="KIND", help=f"{', '.join(kinds)} (default: %(default)s)")
    task.add_argument("--force", action="store_true", help="replace files that are there already")
    task.set_defaults(kinds=kinds)
    add_face(task)


def run(args: argparse.Namespace) -> int:
    """Do one of the tasks."""
    if args.kind not in args.kinds:
        raise unknown_name("kind", args.kind, args.kinds)
    return {"map": _map, "draw": _draw, "check": _check}[args.task](args)


def _free(path: Path, suffix: str, force: bool, source: str | Path = "") -> Path:
    """Return `path` if it may be written, which `source` may not; raise `UserError` otherwise."""
    if source and path.resolve() == Path(source).resolve():
        raise UserError(f"{path} is the picture that is read; choose another name to write to")
    if path.suffix.lower() != suffix:
        raise UserError(f"{path} does not end in {suffix}, the format that is written")
    if path.is_dir():
        raise UserError(f"{path} is a folder; name a file")
    if path.exists() and not force:
        raise UserError(f"{path} is there already; add --force to replace it or choose another name")
    if not path.parent.is_dir():
        raise UserError(f"folder {path.parent} does not exist; make it first")
    return path


# map


def _map(args: argparse.Namespace) -> int:
    out = _free(Path(args.out), ".toml", args.force)
    beside = out.with_suffix(".csv"), out.with_name(f"{out.stem}_views.png")
    others = [_free(path, path.suffix, args.force, args.image) for path in beside]
    from faceanim.face.muscle_check import picture_faults
    from faceanim.face.muscle_image import map_picture
    from faceanim.face.muscle_places import Places
    from faceanim.face.muscles import muscles_text, one_sided, paired
    from faceanim.face.picture_file import read_picture
    from faceanim.render.sequence import write_png

    picture = read_picture(args.image)
    face = face_asked(args)
    places = Places(face)
    found = map_picture(picture, face, args.kind, places=places)
    faults = picture_faults(found)
    wrong = [fault for fault in faults if fault.severity == "error"]
    if wrong and not args.partial:
        raise UserError(
            f"{args.image}: {_described(wrong[0])}{f' ({len(wrong) - 1} more)' if wrong[1:] else ''}; "
            "`faceanim muscles check` shows all, --partial writes what can be read"
        )
    table = dict(found.table)
    if args.complete:
        table = {**places.known, **table}
    table = paired(table, TWINS)
    rows = _rows(found, face, one_sided(table))
    head = f"Muscles read from a {found.kind} image on the face {face.name} ({face.density}); head frame [mm], forces [mN]."
    write_whole(out, muscles_text(table, _notes(table, rows), head).encode())
    write_whole(others[0], _csv(rows).encode())
    write_png(others[1], _views(face, table))
    if not args.quiet:
        _print_rows(rows)
        _print_faults(faults)
    print(
        f"{args.image} ({found.kind}): {len(found.placed)} muscles, {len(wrong)} faults; "
        f"wrote {out}, {others[0].name}, {others[1].name}"
    )
    return 0


def _views(face: Face, table: dict[str, AnyMuscle]) -> np.ndarray:
    from faceanim.render.muscle_picture import muscle_views

    return muscle_views(face, table)


_COLUMNS = (
    "muscle", "kind", "bone", "insertion_x", "insertion_y", "insertion_z", "origin_x", "origin_y", "origin_z",
    "insertion_to_skin", "insertion_to_bone", "origin_to_skin", "origin_to_bone", "insertion_pixel_x",
    "insertion_pixel_y", "origin_pixel_x", "origin_pixel_y",
)  # fmt: skip
"""Columns of the .csv: lengths in mm; of a ring, insertion and origin are its two axis ends."""


def _rows(found: MuscleMap, face: Face, table: dict[str, AnyMuscle]) -> list[dict[str, Any]]:
    """Return one row for each muscle that was found, as it is written."""
    import numpy as np

    from faceanim.face.muscle_check import distances

    ends = []
    for placed in found.placed:
        row = table.get(placed.name)
        both = (getattr(row, "insertion", placed.insertion), getattr(row, "origin", placed.origin))
        ends.append(np.array(both, dtype=np.float64))
    points = np.concatenate(ends)
    skin, bone = distances(points, face)
    rows = []
    for k, placed in enumerate(found.placed):
        numbers = [*ends[k].ravel(), skin[2 * k], bone[2 * k], skin[2 * k + 1], bone[2 * k + 1], *placed.pixels.ravel()]
        kind = type(table[placed.name]).__name__.removesuffix("Muscle").lower() if placed.bone else "sphincter"
        values = [placed.name, kind, placed.bone or "", *(round(float(v), 2) + 0.0 for v in numbers)]
        rows.append(dict(zip(_COLUMNS, values, strict=True)))
    return rows


def _csv(rows: list[dict[str, Any]]) -> str:
    text = StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _notes(table: dict[str, AnyMuscle], rows: list[dict[str, Any]]) -> dict[str, str]:
    """Return a comment for each muscle: how far its ends are from skin and bone."""
    by_name = {row["muscle"]: row for row in rows}
    notes = {}
    for name in table:
        row = by_name.get(name) or by_name.get(f"{name}_left")
        if row is not None and row["bone"]:
            notes[name] = (
                f"insertion {row['insertion_to_skin']:.1f} mm off the skin, {row['insertion_to_bone']:.1f} mm over bone; "
                f"origin {row['origin_to_bone']:.1f} mm off the bone, {row['origin_to_skin']:.1f} mm under the skin"
            )
    return notes


def _print_rows(rows: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title="Muscles [mm]", title_justify="left", title_style="bold")
    table.add_column("muscle", overflow="fold")
    for column in ("insertion: off skin", "over bone", "origin: under skin", "off bone"):
        table.add_column(column, justify="right")
    table.add_column("bone")
    for row in rows:
        numbers = ("insertion_to_skin", "insertion_to_bone", "origin_to_skin", "origin_to_bone")
        table.add_row(row["muscle"], *(f"{row[name]:.1f}" for name in numbers), row["bone"] or "-")
    Console().print(table)


# draw


def _draw(args: argparse.Namespace) -> int:
    size = whole(args.size, "--size", 64, 4096)
    out = _free(Path(args.out), ".png", args.force)
    if args.blank and args.muscles is not None:
        raise UserError("--blank draws no muscles; leave out the list or --blank")
    from faceanim.face.library import read_muscles
    from faceanim.render.muscle_picture import muscle_image
    from faceanim.render.sequence import write_png

    face = face_asked(args)
    table = {} if args.blank else face.muscle_table if args.muscles is None else read_muscles(args.muscles)
    picture, drawn = muscle_image(face, table, args.kind, size)
    write_png(out, picture)
    for name in drawn.hidden:
        print(f"warning: {name} cannot be seen from the front; it is only in a cylinder image (--kind cylinder)")
    rings = len(drawn.axis) // 2
    print(f"{out}: {args.kind} image, {size} x {size} pixels, {len(drawn.line)} muscles and {rings} rings")
    return 0


# check


def _check(args: argparse.Namespace) -> int:
    path = Path(args.image)
    if path.suffix.lower() == ".toml":
        return _check_list(args)
    marked = Path(args.marked) if args.marked else path.with_name(f"{path.stem}_checked.png")
    if args.marked:
        _free(marked, ".png", args.force, path)
    from faceanim.face.muscle_check import picture_faults
    from faceanim.face.muscle_image import read_picture_marks
    from faceanim.face.picture_file import read_picture

    picture = read_picture(path)
    found = read_picture_marks(picture, face_asked(args), args.kind)
    faults = picture_faults(found)
    _print_faults(faults)
    placed = [fault for fault in faults if fault.pixel is not None]
    if placed:
        _free(marked, ".png", args.force)
        _mark(picture, faults, marked)
    wrong = sum(fault.severity == "error" for fault in faults)
    what = f"{path} ({found.kind}): {len(found.placed)} muscles, {wrong} errors, {len(faults) - wrong} warnings"
    print(f"{what}; marked in {marked}" if placed else what)
    return 1 if wrong else 0


def _check_list(args: argparse.Namespace) -> int:
    from faceanim.face.library import read_muscles
    from faceanim.face.muscle_check import check_table

    table = read_muscles(args.image)
    faults = check_table(table, face_asked(args))
    _print_faults(faults)
    wrong = sum(fault.severity == "error" for fault in faults)
    print(f"{args.image}: {len(table)} muscles, {wrong} errors, {len(faults) - wrong} warnings")
    return 1 if wrong else 0


def _mark(picture: np.ndarray, faults: list[Fault], path: Path) -> None:
    from faceanim.render.muscle_picture import marked_copy
    from faceanim.render.sequence import write_png

    rings = [(k, f.pixel, f.severity) for k, f in enumerate(faults, start=1) if f.pixel is not None]
    write_png(path, marked_copy(picture, rings))


def _described(fault: Fault) -> str:
    where = "" if fault.pixel is None else f" at pixel ({fault.pixel[0]:.0f}, {fault.pixel[1]:.0f})"
    return f"{fault.code}{where}: {fault.message}"


def _print_faults(faults: list[Fault]) -> None:
    for k, fault in enumerate(faults, start=1):
        print(f"{k:3d}. {fault.severity}: {_described(fault)}")
