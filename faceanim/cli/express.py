"""`faceanim express`: from a named expression to frames, contact sheet, film and run.json."""

from __future__ import annotations

import argparse
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from faceanim.cli.choices import add_simulation, face_asked, number, solver_options, use_threads, whole
from faceanim.ground.errors import RunError, UserError, unknown_name

if TYPE_CHECKING:
    from faceanim.bench.comparison.plan import Plan
    from faceanim.cli.drawing import Picture
    from faceanim.cli.progress import Progress
    from faceanim.expression.expression import Expression
    from faceanim.expression.timeline import Timeline
    from faceanim.session.session import Session

COLOURS = ("skin", "displacement", "sets", "strain")
CHECKS = ("none", "rest", "trajectory")
SIZE_LIMITS = (16, 4096)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim express`."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="an expression (`faceanim info expressions`), "
                        "a formula such as 6+12C, or a .toml file")  # fmt: skip
    parser.add_argument("--out", metavar="DIR", default="frames", help="folder for the results (default: %(default)s)")
    parser.add_argument("--force", action="store_true", help="replace the results of an earlier run in that folder")
    parser.add_argument("--quiet", action="store_true", help="no progress, only the closing line")
    face = parser.add_argument_group("expression")
    face.add_argument("--au", metavar="UNIT", action="append", default=[],
                      help="action unit on top, e.g. 12=0.8, R12=0.5, 5B; may be repeated")  # fmt: skip
    face.add_argument("--activation", metavar="MUSCLE=X", action="append", default=[],
                      help="set one muscle (0 to 1), e.g. zygomaticus_major_left=0.7; may be repeated")  # fmt: skip
    face.add_argument("--jaw", metavar="CONTROL=X", action="append", default=[],
                      help="opening=0..1, lateral=-1..1 (positive: subject's left), protrusion=0..1")  # fmt: skip
    time = parser.add_argument_group("time")
    for phase, text in (("onset", "rise"), ("apex", "hold"), ("offset", "fall")):
        time.add_argument(f"--{phase}", metavar="S", help=f"seconds to {text}")
    time.add_argument("--lag", action="store_true", help="muscles follow with a lag (30 ms rising, 60 ms falling)")
    time.add_argument("--fps", default="30", metavar="N", help="frames per second (default: %(default)s)")
    time.add_argument("--duration", metavar="S", help="seconds to show (default: the whole expression)")
    add_simulation(parser)
    plan = parser.add_argument_group("plan")
    plan.add_argument("--tolerance", metavar="MM", help="RMS error over the face that is allowed: chooses backend, scheme, "
                      "density, step and partition, the cheapest that keep up with --fps (see `faceanim plan`)")  # fmt: skip
    plan.add_argument("--against", metavar="WHAT", default="reference",
                      help="what it counts from: reference (default), or own: the model's converged motion")  # fmt: skip
    _add_picture(parser.add_argument_group("picture"))


def _add_picture(picture: argparse._ArgumentGroup) -> None:
    picture.add_argument("--size", default="512", metavar="N[xM]", help="pixels of one view (default: %(default)s)")
    picture.add_argument("--views", default="front", metavar="LIST",
                         help="front, three_quarter, side, ...; several with commas, side by side")  # fmt: skip
    picture.add_argument("--colour", "--color", default="skin", metavar="WHAT",
                         help=f"one of {', '.join(COLOURS)} (default: %(default)s)")  # fmt: skip
    picture.add_argument("--wireframe", action="store_true", help="draw the edges of the triangles")
    picture.add_argument("--show-skull", action="store_true", help="show skull and jaw through the skin")
    picture.add_argument("--no-video", action="store_true", help="no film, only pictures")
    picture.add_argument("--save-points", action="store_true", help="also save all positions (points.npy)")
    picture.add_argument("--check", default="rest", metavar="HOW",
                         help="accuracy to measure: none, rest (default), or trajectory (slow)")  # fmt: skip


def picture_asked(args: argparse.Namespace) -> Picture:
    """Return what the command line wants drawn; raise `UserError` for what cannot be."""
    from faceanim.cli.drawing import Picture
    from faceanim.render.camera import VIEWS

    parts = args.size.lower().split("x")
    if len(parts) > 2:
        raise UserError(f"--size {args.size!r} is not understood; write 512 or 640x480")
    sides = [whole(part, "--size", *SIZE_LIMITS) for part in parts]
    views = tuple(view.strip().replace("-", "_") for view in args.views.split(",") if view.strip())
    for view in views or ("",):
        if view not in VIEWS:
            raise unknown_name("view", view, VIEWS)
    if len(set(views)) != len(views):
        raise UserError(f"--views {args.views} names a view twice")
    if args.colour not in COLOURS:
        raise unknown_name("colour", args.colour, COLOURS)
    if sides[0] * len(views) > 4 * SIZE_LIMITS[1]:
        raise UserError(f"--size {args.size} with {len(views)} views is wider than {4 * SIZE_LIMITS[1]} pixels")
    return Picture((sides[0], sides[-1]), views, args.colour, args.wireframe, args.show_skull)


def expression_asked(args: argparse.Namespace) -> Expression:
    """Return the expression that the command line describes."""
    from faceanim.expression.expression import parse_setting
    from faceanim.expression.library import expression_names, load_expression
    from faceanim.session.session import adjusted

    own = bool(args.au or args.activation or args.jaw)
    if args.name is None and not own:
        raise UserError(f"which expression? one of {', '.join(expression_names())}, a formula such as 6+12, or --au")
    units = [part for text in args.au for part in text.split(",")]
    activation = dict(parse_setting(text, "activation") for text in args.activation)
    jaw = dict(parse_setting(text, "jaw control") for text in args.jaw)
    return adjusted(load_expression("neutral" if args.name is None else args.name), units, activation, jaw)


def timeline_asked(args: argparse.Namespace, expression: Expression) -> Timeline:
    """Return the course in time that the command line describes."""
    from msgspec.structs import replace

    from faceanim.expression.timeline import LONGEST, Timeline

    line = expression.timeline or Timeline()
    for phase in ("onset", "apex", "offset"):
        text = getattr(args, phase)
        if text is not None:
            line = replace(line, **{phase: number(text, f"--{phase}", 0.0, LONGEST)})
    return replace(line, tau_on=0.03, tau_off=0.06) if args.lag else line


PLANNED = {"scheme": "--scheme", "adaptive": "--adaptive or --full", "option": "--option",
           "partition_tolerance": "--partition-tolerance", "own_muscles": "--muscles"}  # fmt: skip
"""What cannot be said beside --tolerance, which chooses it, or knows the built-in muscles only."""


def plan_asked(args: argparse.Namespace, progress: Progress) -> Plan | None:
    """Return the plan for --tolerance and --fps, None if they leave nothing to plan.

    Raises `UserError` for what contradicts it, `RunError` if nothing meets both.
    """
    if args.tolerance is None:
        return None
    for name, flag in PLANNED.items():
        if getattr(args, name):
            raise UserError(f"--tolerance and {flag} exclude each other; leave one of them out")
    from faceanim.bench.comparison.plan import MEASURES, RATES, TOLERANCES
    from faceanim.bench.comparison.scenes import expression_scene, scene_named
    from faceanim.cli.plan import plan_shown
    from faceanim.expression.library import expression_names

    tolerance = number(args.tolerance, "--tolerance", *TOLERANCES)
    fps = number(args.fps, "--fps", *RATES)
    if args.against not in MEASURES:
        raise unknown_name("measure of accuracy", args.against, MEASURES)
    own = args.au or args.activation or args.jaw or args.name not in expression_names()
    scene = expression_scene(expression_asked(args)) if own else scene_named(f"face-{args.name}")
    found = plan_shown(
        progress, scene, tolerance, fps, against=args.against, backends=tuple(filter(None, [args.backend])),
        densities=tuple(filter(None, [args.density])),
    )  # fmt: skip
    if found.chosen is None:
        raise RunError(found.sentence())
    progress.note(found.sentence())
    return found


def session_asked(args: argparse.Namespace, plan: Plan | None = None) -> Session:
    """Return the session that the command line describes, as a plan chooses; nothing has been simulated yet."""
    from faceanim.session import session as limits

    fps = number(args.fps, "--fps", *limits.FPS_LIMITS)
    duration = None
    if args.duration is not None:
        duration = number(args.duration, "--duration", 0.0, limits.LONGEST, above=True)
    expression = expression_asked(args)
    timeline = timeline_asked(args, expression)
    step = 1.0 / 30.0
    if plan is None or plan.chosen is None:
        options = solver_options(args)
    else:
        from faceanim.bench.comparison.candidates import candidate_of

        row = plan.chosen.row
        args.backend, args.density, step = row.backend, row.density, row.step
        options = candidate_of(row).options()
    return limits.Session(
        face_asked(args),
        expression,
        timeline,
        fps=fps,
        duration=duration,
        backend=args.backend,
        options=options,
        largest_step=step,
    )


def run(args: argparse.Namespace) -> int:
    """Make the results and say in one line what was made, how fast and how accurate."""
    start = perf_counter()
    if args.check not in CHECKS:
        raise unknown_name("check", args.check, CHECKS)
    expression_asked(args)
    from faceanim.cli.production import Production
    from faceanim.cli.progress import Progress
    from faceanim.cli.warmup import drawing_compiled
    from faceanim.ground.folders import cache_notice
    from faceanim.ground.notes import listening
    from faceanim.session.recording import Results

    picture = picture_asked(args)
    results = Results(Path(args.out), overwrite=args.force)
    use_threads(args.threads)
    with Progress(quiet=args.quiet) as progress, listening(progress.hear):
        plan = plan_asked(args, progress)
        progress.stage("loading the face")
        session = session_asked(args, plan)
        for notice in cache_notice():
            progress.note(notice)
        with results, drawing_compiled() as finish:
            production = Production(session, picture, results, progress, start, plan)
            production.simulate()
            progress.stage("preparing to draw")
            finish()
            production.draw(film=not args.no_video)
            if args.check != "none":
                production.measure(trajectory=args.check == "trajectory")
            production.record(keep_points=args.save_points)
            results.commit()
    print(production.closing_line())
    return 0
