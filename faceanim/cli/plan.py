"""`faceanim plan`: the cheapest way to animate a scene that is accurate and fast enough on this machine."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from faceanim.cli.choices import number
from faceanim.ground.errors import UserError, unknown_name

if TYPE_CHECKING:
    from faceanim.bench.comparison.plan import Plan
    from faceanim.cli.progress import Progress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim plan`."""
    parser.add_argument("scene", nargs="?", metavar="SCENE", help="a scene (`faceanim compare` lists them)")
    parser.add_argument("--tolerance", metavar="MM", default="0.5",
                        help="RMS error over the surface that is allowed (default: %(default)s)")  # fmt: skip
    parser.add_argument(
        "--fps", metavar="N", default="60", help="frames per second that are needed (default: %(default)s)"
    )
    parser.add_argument("--backends", metavar="LIST", default="", help="only these, with commas")
    parser.add_argument("--densities", metavar="LIST", default="", help="only these, with commas")
    parser.add_argument("--against", metavar="WHAT", default="reference",
                        help="reference (default), or own: the converged motion of the same model")  # fmt: skip
    parser.add_argument("--quiet", action="store_true", help="no progress, only the plan")


def run(args: argparse.Namespace) -> int:
    """Measure what is missing, print the plan; status 1 if nothing meets both wishes."""
    from faceanim.bench.comparison.plan import MEASURES, RATES, TOLERANCES
    from faceanim.bench.comparison.scenes import SCENES, scene_named
    from faceanim.cli.compare import words
    from faceanim.cli.progress import Progress

    if args.scene is None:
        raise UserError(f"which scene? one of {', '.join(SCENES)}, or face-NAME for an expression")
    scene = scene_named(args.scene)
    tolerance = number(args.tolerance, "--tolerance", *TOLERANCES)
    fps = number(args.fps, "--fps", *RATES)
    if args.against not in MEASURES:
        raise unknown_name("measure of accuracy", args.against, MEASURES)
    with Progress(quiet=args.quiet) as progress:
        found = plan_shown(
            progress, scene, tolerance, fps, against=args.against, backends=words(args.backends),
            densities=words(args.densities),
        )  # fmt: skip
    print(found.sentence())
    if found.chosen is None:
        return 1
    print(_details(found))
    return 0


def plan_shown(progress: Progress, scene: Any, tolerance: float, fps: float, **choices: Any) -> Plan:
    """Return the plan for a scene, telling what is being measured for it."""
    from faceanim.bench.comparison.memory import plan_for
    from faceanim.ground.notes import listening

    progress.stage(f"measuring this machine on {scene.name} (minutes, once)")
    with listening(progress.hear):
        return plan_for(scene, tolerance, fps, watcher=lambda row: progress.detail(row.label), **choices)


def _details(found: Plan) -> str:
    """Return what was chosen, a line each: backend, options, density, step and partition."""
    assert found.chosen is not None
    row, steps = found.chosen.row, found.chosen.steps_per_frame
    options = {name: value for name, value in row.settings.items() if name != "adaptive"}
    partition = "adaptive: dynamic, quasi-static and static" if row.settings.get("adaptive") else "every one"
    lines = {
        "backend": row.backend,
        "options": ", ".join(f"{name}={value}" for name, value in options.items()) or "its defaults",
        "density": row.density,
        "step": f"1/{found.fps * steps:g} s, {steps} a frame",
        "vertices": partition,
    }
    return "\n".join(f"  {name:9} {words}" for name, words in lines.items())
