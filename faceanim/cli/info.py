"""`faceanim info`: what there is to ask for."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields

from faceanim.ground.errors import unknown_name

TOPICS = ("faces", "muscles", "expressions", "action-units", "surgery", "backends")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim info`."""
    parser.add_argument("topic", nargs="?", metavar="TOPIC", help=f"one of {', '.join(TOPICS)}; all if left out")


def run(args: argparse.Namespace) -> int:
    """Print what there is, as tables."""
    if args.topic is not None and args.topic not in TOPICS:
        raise unknown_name("topic", args.topic, TOPICS)
    from rich.console import Console

    console = Console()
    for topic in (args.topic,) if args.topic else TOPICS:
        columns, rows = _TABLES[topic]()
        console.print(_table(topic, columns, rows))
    return 0


def _table(title: str, columns: tuple[str, ...], rows: list[tuple[str, ...]]) -> object:
    from rich.table import Table

    table = Table(title=title.replace("-", " ").capitalize(), title_justify="left", title_style="bold")
    for column in columns:
        table.add_column(column, justify="right" if column in _NUMBERS else "left")
    for row in rows:
        table.add_row(*row)
    return table


_NUMBERS = ("vertices", "triangles", "number", "force [mN]", "fibres")


Listing = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Column names, and rows of words."""


def _faces() -> Listing:
    from faceanim.face.library import DENSITIES, faces, load_face

    rows: list[tuple[str, ...]] = []
    for name in faces():
        for density in DENSITIES:
            mesh = load_face(name, density).mesh
            rows.append((name, density, str(len(mesh.points)), str(len(mesh.triangles))))
    return ("face", "density", "vertices", "triangles"), rows


def _muscles() -> Listing:
    from faceanim.expression.action_units import load_action_units
    from faceanim.face.library import load_face

    muscles = load_face().muscles
    users: dict[str, list[str]] = {}
    for number, unit in load_action_units().items():
        for base in unit.muscles:
            users.setdefault(base, []).append(str(number))
    rows: list[tuple[str, ...]] = []
    for k, name in enumerate(muscles.names):
        base = name.removesuffix("_left").removesuffix("_right")
        units = users.get(name, users.get(base, []))
        fibres = int((muscles.muscle == k).sum())
        rows.append((name, f"{muscles.max_force[k]:.0f}", str(fibres), ", ".join(units) or "-"))
    return ("muscle", "force [mN]", "fibres", "action units"), rows


def _expressions() -> Listing:
    from faceanim.expression.library import expression_names, load_expression

    rows: list[tuple[str, ...]] = []
    for name in expression_names():
        expression = load_expression(name)
        rows.append((name, expression.formula or "-", expression.source))
    return ("expression", "action units", "source"), rows


def _action_units() -> Listing:
    from faceanim.expression.action_units import load_action_units

    rows: list[tuple[str, ...]] = []
    for number, unit in load_action_units().items():
        acts = [f"{name} {gain:g}" for name, gain in unit.muscles.items()]
        acts += [f"jaw {c} {getattr(unit.jaw, c):g}" for c in unit.jaw.LIMITS if getattr(unit.jaw, c)]
        sides = {"pair": "both, L, R", "none": "-", "one": "L, R"}[unit.sides]
        rows.append((str(number), unit.name, ", ".join(acts), sides))
    return ("number", "name", "muscles and jaw at full intensity", "sides"), rows


def _surgery() -> Listing:
    from faceanim.surgery.plan import load_plan, plan_names

    plans = [(name, load_plan(name)) for name in plan_names()]
    return ("plan", "operation", "source"), [(name, plan.title, plan.source) for name, plan in plans]


def _backends() -> Listing:
    from faceanim.backends import BACKENDS, backend_class

    rows: list[tuple[str, ...]] = []
    for name in BACKENDS:
        solver = backend_class(name)
        text = (solver.__doc__ or "").strip().split("\n")[0]
        options = solver.Options()
        rows.append((name, text, ", ".join(f"{f.name}={getattr(options, f.name)}" for f in fields(options))))
    return ("backend", "what it is", "options and their defaults"), rows


_TABLES: dict[str, Callable[[], Listing]] = {
    "faces": _faces,
    "muscles": _muscles,
    "expressions": _expressions,
    "action-units": _action_units,
    "surgery": _surgery,
    "backends": _backends,
}
