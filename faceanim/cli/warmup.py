"""`faceanim warmup`: compile everything that `express` needs, once, into the cache folder."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from time import perf_counter
from typing import Any

from faceanim.ground.errors import unknown_name

PARTS = ("simulation", "drawing")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim warmup`."""
    parser.add_argument("--quiet", action="store_true", help="no progress, only the closing line")
    parser.add_argument("--backend", default="mass_spring", help="which one, or all (default: %(default)s)")
    parser.add_argument("--only", metavar="PART", help=f"one of {', '.join(PARTS)} (default: both, side by side)")


def run(args: argparse.Namespace) -> int:
    """Run everything once on the coarse face; machine code does not depend on the density."""
    from faceanim.cli.progress import Progress
    from faceanim.ground.folders import cache_notice

    if args.only is not None and args.only not in PARTS:
        raise unknown_name("part", args.only, PARTS)
    from faceanim.backends import BACKENDS

    if args.backend not in (*BACKENDS, "all"):
        raise unknown_name("backend", args.backend, [*BACKENDS, "all"])
    backends = list(BACKENDS) if args.backend == "all" else [args.backend]
    start = perf_counter()
    with Progress(quiet=args.quiet) as progress, drawing_compiled(wait=args.only is None) as finish:
        jobs = [] if args.only == "drawing" else _simulation(backends)
        progress.stage("compiling", len(jobs) + 1)
        for text, job in jobs:
            progress.detail(text)
            job()
            progress.advance()
        if args.only != "simulation":
            progress.detail("drawing")
            finish()
            _draw()
            _mark().touch()
            progress.advance()
        for notice in cache_notice():
            progress.note(notice)
    print(f"compiled ahead in {perf_counter() - start:.0f} s; from now on `faceanim express` starts at once")
    return 0


def _mark() -> Path:
    """Return the file that says that drawing has been compiled by these sources and versions."""
    import numba

    import faceanim.ground.jit  # noqa: F401 (sets the cache folder)

    return Path(str(vars(numba.config)["CACHE_DIR"])) / "drawing.compiled"


@contextmanager
def drawing_compiled(*, wait: bool = True) -> Iterator[Callable[[], Any]]:
    """Compile what drawing needs in a process beside this one, unless that has been done before.

    Gives a function that waits for it. Should that process fail, this one compiles for itself, only later.
    """
    if not wait or _mark().exists():
        yield lambda: None
        return
    command = [sys.executable, "-m", "faceanim.cli.main", "warmup", "--only", "drawing", "--quiet"]
    helper = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield helper.wait
    finally:
        helper.terminate()
        with suppress(OSError):
            helper.wait()


def _simulation(backends: Sequence[str]) -> list[tuple[str, Callable[[], Any]]]:
    """Return what to run for the solvers, in order, each with a name."""
    from dataclasses import replace
    from functools import partial

    from faceanim.backends import backend_class
    from faceanim.expression.library import load_expression
    from faceanim.face.library import load_face
    from faceanim.session.session import Session

    face = load_face(density="coarse")
    expression = load_expression("6+12+26")
    jobs: list[tuple[str, Callable[[], Any]]] = []
    for name in backends:
        options = backend_class(name).Options()
        kinds = [options]
        if hasattr(options, "adaptive"):
            kinds = [replace(options, adaptive=adaptive) for adaptive in (True, False)]
        for kind in kinds:
            session = Session(face, expression, backend=name, options=kind, fps=30.0, duration=0.1)
            jobs.append((f"{name} steps", partial(list, session)))
        jobs.append((f"{name} equilibrium", partial(session.solver.solve_static, session.control(0.1))))
    return jobs


def _draw() -> None:
    from faceanim.cli.drawing import draw_once
    from faceanim.face.library import load_face

    draw_once(load_face(density="coarse"))
