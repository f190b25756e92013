"""`faceanim warmup`: compile everything that `express` needs, once, into the cache folder."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from time import perf_counter
from typing import Any


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim warmup`."""
    parser.add_argument("--quiet", action="store_true", help="no progress, only the closing line")


def run(args: argparse.Namespace) -> int:
    """Run everything once on the coarse face; machine code does not depend on the density."""
    from faceanim.cli.progress import Progress
    from faceanim.ground.jit import cache_notice

    start = perf_counter()
    with Progress(quiet=args.quiet) as progress:
        jobs = _jobs()
        progress.stage("compiling", len(jobs))
        for text, job in jobs:
            progress.detail(text)
            job()
            progress.advance()
        for notice in cache_notice():
            progress.note(notice)
    print(f"compiled ahead in {perf_counter() - start:.0f} s; from now on `faceanim express` starts at once")
    return 0


def _jobs() -> list[tuple[str, Callable[[], Any]]]:
    """Return what to run, in order, each with a name."""
    from dataclasses import replace
    from functools import partial

    from faceanim.backends import BACKENDS, backend_class
    from faceanim.cli.drawing import Picture
    from faceanim.expression.library import load_expression
    from faceanim.face.library import load_face
    from faceanim.session.session import Session

    face = load_face(density="coarse")
    expression = load_expression("6+12+26")
    jobs: list[tuple[str, Callable[[], Any]]] = []
    for name in BACKENDS:
        options = backend_class(name).Options()
        kinds = [options]
        if hasattr(options, "adaptive"):
            kinds = [replace(options, adaptive=adaptive) for adaptive in (True, False)]
        for kind in kinds:
            session = Session(face, expression, backend=name, options=kind, fps=30.0, duration=0.1)
            jobs.append((f"{name} steps", partial(list, session)))
        jobs.append((f"{name} equilibrium", partial(session.solver.solve_static, session.control(0.1))))
    for colour in ("skin", "displacement"):
        picture = Picture((64, 64), colour=colour)
        jobs.append((f"drawing {colour}", partial(_draw, session, picture)))
    return jobs


def _draw(session: Any, picture: Any) -> None:
    from faceanim.cli.drawing import Drawing

    points = session.body.surface.points
    Drawing(session, picture, [points]).draw(points)
