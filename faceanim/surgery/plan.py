"""A plan of an operation: which bone is cut where, and where the pieces go. Files are untrusted."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from faceanim.face.library import asset_folder
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import AssetError, UserError, unknown_name

BONES = ("cranium", "jaw")
LARGEST_FILE = 2**18
"""Plans of more bytes are not read."""
MOST_PIECES = 12
FARTHEST = 60.0
"""No piece may be carried farther [mm]: no operation does."""
LARGEST_TURN = 45.0
REACH = 1000.0
"""Places lie within this of the origin of the head frame [mm]."""
MIRROR = np.array([-1.0, 1.0, 1.0])

_Row = Annotated[list[float], msgspec.Meta(min_length=3, max_length=3)]
_Name = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
Place = str | list[float]
"""A point (3,) in the head frame [mm], or the name of a landmark."""


class Plane(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A cut along a plane; the piece lies on the side to which `normal` points.

    point : a place on the plane, a landmark or "incisor_upper", ... ;  offset : (3,) [mm] added to it
    mirrored : the plane's mirror image (x -> -x) cuts as well
    """

    point: Place
    normal: _Row
    offset: _Row | None = None
    mirrored: bool = False


class Box(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A cut along the six sides of an upright box; the piece lies inside.   min, max : (3,) [mm]"""

    min: _Row
    max: _Row


class Move(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One movement: `translation` (3,) [mm], or `degrees` about `axis` (3,), right-handed, through `about`.

    about : "centroid" (of the piece where it then is), a landmark or a place in the uncut head
    """

    translation: _Row | None = None
    axis: _Row | None = None
    degrees: Annotated[float, msgspec.Meta(ge=-LARGEST_TURN, le=LARGEST_TURN)] | None = None
    about: Place = "centroid"


class Piece(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A piece of bone: what lies within all of `planes` and `boxes`, carried by the moves in their order.

    keep : "all" that is cut out, or only the "largest" part that hangs together
    mirrored : the same on the other side too, as a second piece;  the two are called NAME_left and NAME_right
    overlap : how deep the piece may go into other bone, which the surgeon takes away there [mm]
    """

    name: _Name
    bone: _Name
    planes: Annotated[list[Plane], msgspec.Meta(max_length=16)] = []
    boxes: Annotated[list[Box], msgspec.Meta(max_length=4)] = []
    move: Annotated[list[Move], msgspec.Meta(max_length=8)] = []
    keep: str = "all"
    mirrored: bool = False
    overlap: Annotated[float, msgspec.Meta(ge=0.0, le=20.0)] = 1.0


class Plan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An operation: title, where it comes from, whose head (None = what the command line says), and the pieces."""

    title: Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
    piece: Annotated[list[Piece], msgspec.Meta(min_length=1, max_length=MOST_PIECES)]
    source: Annotated[str, msgspec.Meta(max_length=2000)] = ""
    face: _Name | None = None
    density: _Name | None = None
    name: str = ""


def plan_names() -> tuple[str, ...]:
    """Return the names of the built-in plans, sorted."""
    return tuple(sorted(path.stem for path in (asset_folder() / "surgery").glob("*.toml")))


def load_plan(name: str) -> Plan:
    """Return the plan called `name`: a built-in one, or a path ending in .toml.

    Raises `UserError` for an unknown name, suggesting the nearest, and `AssetError` for a broken file.
    """
    if name.lower().endswith(".toml"):
        return read_plan(Path(name))
    if name not in plan_names():
        raise unknown_name("surgery plan (or a path ending in .toml)", name, plan_names())
    return read_plan(asset_folder() / "surgery" / f"{name}.toml")


def read_plan(path: Path) -> Plan:
    """Return the plan in the TOML file `path`; raise `AssetError` naming the file and what is wrong with it."""
    try:
        if path.is_dir():
            raise AssetError(f"plan {path} is a folder; name a .toml file")
        with path.open("rb") as file:
            data = file.read(LARGEST_FILE + 1)
    except OSError as error:
        raise AssetError(f"plan {path} cannot be read ({error.strerror or error})") from None
    if len(data) > LARGEST_FILE:
        raise AssetError(f"plan {path} is larger than {LARGEST_FILE >> 10} kB; a plan has a few kB")
    return parse_plan(data, str(path), path.stem)


def parse_plan(data: bytes | str, source: str, name: str = "plan") -> Plan:
    """Return the plan that TOML text describes; raise `AssetError` naming `source` and the fault."""
    try:
        plan = msgspec.toml.decode(data, type=Plan)
    except UnicodeDecodeError:
        raise AssetError(f"plan {source} is not a text file in UTF-8") from None
    except (msgspec.DecodeError, RecursionError) as error:
        raise AssetError(f"plan {source}: {_explained(str(error))}") from None
    plan = msgspec.structs.replace(plan, name=name)
    try:
        _reject_unsound(plan)
    except AssetError:
        raise
    except UserError as error:
        raise AssetError(f"plan {source}: {error}") from None
    return plan


_FIELDS: dict[str, type] = {"piece[...].planes": Plane, "piece[...].boxes": Box, "piece[...].move": Move}


def _explained(text: str) -> str:
    """Return msgspec's words about an unknown field with the known ones added."""
    if "unknown field" not in text:
        return text or "is nested too deeply"
    kind: Any = Piece if "$.piece" in text else Plan
    for place, inner in _FIELDS.items():
        if place in text:
            kind = inner
    return f"{text}; known: {', '.join(f for f in kind.__struct_fields__ if (kind, f) != (Plan, 'name'))}"


def _reject_unsound(plan: Plan) -> None:
    """Raise `UserError` for what the types do not exclude; landmarks are looked up when the bone is cut."""
    seen: set[str] = set()
    for piece in plan.piece:
        what = f"piece {piece.name!r}"
        if not piece.name.replace("_", "").replace("-", "").isalnum():
            raise UserError(f"{what}: a name is made of letters, digits, - and _")
        if piece.bone not in BONES:
            raise UserError(f"{what}: {unknown_name('bone', piece.bone, BONES)}")
        for name in piece_names(piece):
            if name in seen or name in BONES:
                raise UserError(f"{what}: the name {name!r} is taken; each piece needs its own")
            seen.add(name)
        if not piece.planes and not piece.boxes:
            raise UserError(f"{what}: planes or boxes are needed to cut it out of the {piece.bone}")
        if piece.keep not in ("all", "largest"):
            raise UserError(f"{what}: {unknown_name('keep', piece.keep, ('all', 'largest'))}")
        for k, plane in enumerate(piece.planes):
            _numbers(f"{what}, plane {k + 1}: normal", plane.normal, nonzero=True)
            _numbers(f"{what}, plane {k + 1}: offset", plane.offset or [0.0])
            _place(f"{what}, plane {k + 1}: point", plane.point)
        for k, box in enumerate(piece.boxes):
            low, high = (_numbers(f"{what}, box {k + 1}: {side}", getattr(box, side)) for side in ("min", "max"))
            if not (low < high).all():
                raise UserError(f"{what}, box {k + 1}: min {box.min} must lie below max {box.max} in x, y and z")
        for k, move in enumerate(piece.move):
            _reject_unsound_move(f"{what}, move {k + 1}", move)


def _reject_unsound_move(what: str, move: Move) -> None:
    turns = move.axis is not None or move.degrees is not None
    if (move.translation is not None) == turns:
        raise UserError(f"{what}: give either translation = [x, y, z] or axis and degrees; moves follow one another")
    if move.translation is not None:
        _numbers(f"{what}: translation", move.translation)
        if move.about != "centroid":
            raise UserError(f"{what}: `about` belongs to a rotation, not to a translation")
        return
    if move.axis is None or move.degrees is None:
        raise UserError(f"{what}: a rotation needs both axis = [x, y, z] and degrees")
    if not math.isfinite(move.degrees):
        raise UserError(f"{what}: degrees = {move.degrees} must be finite")
    _numbers(f"{what}: axis", move.axis, nonzero=True)
    _place(f"{what}: about", move.about)


def _numbers(what: str, row: list[float], *, nonzero: bool = False) -> Floats:
    values = np.asarray(row, dtype=np.float64)
    if not (np.isfinite(values).all() and np.abs(values).max() <= REACH):
        raise UserError(f"{what} = {row} must be three finite numbers within {REACH:g}")
    if nonzero and not np.linalg.norm(values) > 1e-6:
        raise UserError(f"{what} = {row} has no direction")
    return values


def _place(what: str, place: Place) -> None:
    if isinstance(place, str):
        return
    if len(place) != 3:
        raise UserError(f"{what} = {place} must be [x, y, z] in mm or the name of a landmark")
    _numbers(what, place)


def piece_names(piece: Piece) -> tuple[str, ...]:
    """Return the names of the pieces that are cut: one, or one for each side."""
    return (f"{piece.name}_left", f"{piece.name}_right") if piece.mirrored else (piece.name,)


def planes_of(piece: Piece, where: Callable[[Place], Floats]) -> list[tuple[str, Floats, Floats]]:
    """Return every plane that cuts a piece as (words that name it, point (3,), unit normal (3,) into the piece).

    where : gives the point that a place names
    """
    out = []
    for k, plane in enumerate(piece.planes):
        point = where(plane.point) + np.asarray(plane.offset or (0.0, 0.0, 0.0))
        normal = np.asarray(plane.normal, dtype=np.float64) / np.linalg.norm(plane.normal)
        out.append((f"plane {k + 1}", point, normal))
        if plane.mirrored:
            out.append((f"plane {k + 1}, mirrored,", MIRROR * point, MIRROR * normal))
    for k, box in enumerate(piece.boxes):
        for axis in range(3):
            for sign, corner in ((1.0, box.min), (-1.0, box.max)):
                side = f"box {k + 1}, {'min' if sign > 0 else 'max'} {'xyz'[axis]},"
                out.append((side, np.asarray(corner, dtype=np.float64), sign * np.eye(3)[axis]))
    return out
