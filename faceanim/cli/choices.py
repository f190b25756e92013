"""Options that several commands share, and how their words become values; every complaint names option and limits."""

from __future__ import annotations

import argparse
import math
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from faceanim.ground.errors import UserError, unknown_name

if TYPE_CHECKING:
    from faceanim.face.face import Face


def add_face(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Declare whose head it is."""
    parser.add_argument("--face", default="default", help="name of the face (default: %(default)s)")
    parser.add_argument("--density", help="coarse, default or fine")


def face_asked(args: argparse.Namespace) -> Face:
    """Return the face that the command line names, with muscles of one's own if it gives a list of them."""
    from faceanim.face.library import load_face, read_muscles

    face: Face = load_face(args.face, args.density or "default")
    source = getattr(args, "own_muscles", None)
    return face if source is None else face.with_muscles(read_muscles(source), str(source))


def add_simulation(parser: argparse.ArgumentParser) -> None:
    """Declare who is simulated and how."""
    group = parser.add_argument_group("simulation")
    add_face(group)
    group.add_argument("--muscles", dest="own_muscles", metavar="FILE",
                       help="muscles of one's own, as `faceanim muscles map` writes them")  # fmt: skip
    group.add_argument("--backend", help="how flesh answers (`faceanim info backends`; default: mass_spring)")
    group.add_argument(
        "--scheme",
        help="time stepping of mass_spring: conjugate_gradient, block_descent, newton, explicit, semi_implicit or paper",
    )
    which = group.add_mutually_exclusive_group()
    which.add_argument("--adaptive", dest="adaptive", action="store_true", default=None,
                       help="dynamic, quasi-static and static vertices (default)")  # fmt: skip
    which.add_argument("--full", dest="adaptive", action="store_false", help="every vertex dynamic")
    group.add_argument("--partition-tolerance", metavar="MM",
                       help="what the adaptive partition may cost in accuracy [mm]")  # fmt: skip
    group.add_argument("--threads", metavar="N", help="processor cores to use (default: one to simulate, all to draw)")
    group.add_argument("--option", metavar="NAME=VALUE", action="append", default=[],
                       help="any other option of the backend (`faceanim info backends`)")  # fmt: skip


def number(text: str | float, option: str, low: float, high: float, *, above: bool = False) -> float:
    """Return `text` as a number in [low, high] (in (low, high] with `above`); raise `UserError` naming `option`."""
    limits = f"{'more than ' if above else ''}{low:g} to {high:g}"
    try:
        value = float(text)
    except ValueError:
        raise UserError(f"{option} {text!r} is not a number; give {limits}") from None
    if math.isnan(value) or not low <= value <= high or (above and value == low):
        raise UserError(f"{option} {text} is outside its limits; give {limits}")
    return value


def whole(text: str, option: str, low: int, high: int) -> int:
    """Return `text` as a whole number in [low, high]; raise `UserError` naming `option`."""
    value = number(text, option, low, high)
    if value != int(value):
        raise UserError(f"{option} {text} is not a whole number; give {low} to {high}")
    return int(value)


def use_threads(text: str | None) -> int:
    """Set how many threads compiled loops may use, if asked for, and return the number in use."""
    import numba

    if text is not None:
        most: Any = vars(numba.config)["NUMBA_NUM_THREADS"]
        numba.set_num_threads(whole(text, "--threads", 1, int(most)))
    return int(numba.get_num_threads())


def solver_options(args: argparse.Namespace) -> Any:
    """Return the backend's Options as the command line asks for; adaptive unless it says --full.

    Settles `args.backend` where it is left open.
    Raises `UserError` for an option or a value that this backend does not know.
    """
    from faceanim.backends import backend_class

    args.backend = args.backend or "mass_spring"
    cls = backend_class(args.backend).Options
    known = {f.name: f for f in fields(cls)}
    wanted: dict[str, Any] = {}
    if args.scheme is not None:
        wanted["scheme"] = args.scheme
    if args.partition_tolerance is not None:
        wanted["tolerance"] = number(args.partition_tolerance, "--partition-tolerance", 0.0, 10.0, above=True)
    if args.adaptive is not None or "adaptive" in known:
        wanted["adaptive"] = args.adaptive is not False
    for setting in args.option:
        name, equals, text = (part.strip() for part in setting.partition("="))
        if not (name and equals and text):
            raise UserError(f"--option {setting!r} is not understood; write name=value")
        wanted[name] = text
    for name, value in wanted.items():
        if name not in known:
            raise unknown_name(f"option of backend {args.backend}", name, known)
        if isinstance(value, str):
            wanted[name] = _typed(value, getattr(cls(), name), name, flag="bool" in str(known[name].type))
    return cls(**wanted)


def _typed(text: str, default: Any, name: str, *, flag: bool) -> Any:
    """Return `text` as what the `default` of an option is; `flag`: it is true or false, by default perhaps neither."""
    if flag:
        if text.lower() not in ("true", "false", "yes", "no", "1", "0"):
            raise UserError(f"--option {name}={text}: true or false is needed")
        return text.lower() in ("true", "yes", "1")
    if isinstance(default, int):
        return whole(text, f"--option {name}", -(10**9), 10**9)
    if isinstance(default, float):
        return number(text, f"--option {name}", -1e12, 1e12)
    if isinstance(default, tuple):
        return tuple(whole(part, f"--option {name}", -(10**9), 10**9) for part in text.split(","))
    return _numbers(text, name) if default is None else text


def _numbers(text: str, name: str) -> Any:
    """Return a number, a list of numbers (1,2,3) or a table of them (0,0,0;1,1,1)."""
    rows = [[number(part, f"--option {name}", -1e12, 1e12) for part in row.split(",")] for row in text.split(";")]
    if len(rows) > 1:
        return rows
    return rows[0] if len(rows[0]) > 1 else rows[0][0]
