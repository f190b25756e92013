"""`faceanim surgery`: from a plan of bone cuts and moves to the skin after the operation."""

from __future__ import annotations

import argparse
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from faceanim.cli.choices import solver_options, use_threads, whole
from faceanim.ground.errors import RunError, UserError

if TYPE_CHECKING:
    from faceanim.cli.progress import Progress
    from faceanim.face.face import Face
    from faceanim.ground.arrays import Floats
    from faceanim.session.recording import Results
    from faceanim.surgery.plan import Plan
    from faceanim.surgery.predict import Prediction

BACKEND = "mixed_fem"
USUAL = {"mixed_fem": ("tissue=craniofacial",)}
"""Options of a backend that hold unless others are asked for."""
QUICK = ("model=linear", "tissue=craniofacial")
SIZE_LIMITS = (64, 2048)
MOST_STEPS = 1000
FILES = (
    "before.png", "after.png", "map.png", "bones.png", "statistics.csv", "statistics.json", "skin_before.ply",
    "skin_after.ply", "bones_after.ply", "flesh.vtu",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim surgery`."""
    parser.add_argument("plan", metavar="PLAN", help="a built-in plan (`faceanim info surgery`) or a .toml file")
    parser.add_argument("--out", metavar="DIR", default="surgery", help="folder for the results (default: %(default)s)")
    parser.add_argument("--force", action="store_true", help="replace the results of an earlier run in that folder")
    parser.add_argument("--quiet", action="store_true", help="no progress, only the closing line")
    parser.add_argument("--preview", action="store_true", help="a quick look: linear flesh, all bones at once")
    parser.add_argument("--size", default="512", metavar="N", help="pixels of one view (default: %(default)s)")
    group = parser.add_argument_group("simulation")
    group.add_argument("--face", help="name of the face (default: the plan's, else default)")
    group.add_argument("--density", help="coarse, default or fine (default: the plan's, else default)")
    group.add_argument("--backend", help=f"how flesh answers (`faceanim info backends`; default: {BACKEND})")
    group.add_argument("--option", metavar="NAME=VALUE", action="append", default=[],
                       help="an option of the backend, e.g. law=linear; may be repeated")  # fmt: skip
    group.add_argument("--steps", metavar="N", help="load steps over which bones move (default: one each 3 mm)")
    group.add_argument("--threads", metavar="N", help="processor cores to use")
    parser.set_defaults(scheme=None, partition_tolerance=None, adaptive=None)


def run(args: argparse.Namespace) -> int:
    """Make the results and say in one line what moved; 1 if the flesh could not follow the bones to the end."""
    start = perf_counter()
    size = whole(args.size, "--size", *SIZE_LIMITS)
    steps = None if args.steps is None else whole(args.steps, "--steps", 1, MOST_STEPS)
    if args.preview and (args.backend or args.option or args.steps):
        raise UserError("--preview is the linear model in one step; leave out --backend, --option and --steps")
    args.backend = args.backend or BACKEND
    args.option = list(QUICK) if args.preview else _options(args.backend, args.option)
    from faceanim.surgery.plan import load_plan

    plan = load_plan(args.plan)
    options = solver_options(args)
    use_threads(args.threads)
    from faceanim.cli.progress import Progress
    from faceanim.ground.folders import cache_notice
    from faceanim.ground.notes import listening

    results = _results(Path(args.out), overwrite=args.force)
    with Progress(quiet=args.quiet) as progress, listening(progress.hear):
        progress.stage("loading the face")
        face = _face_asked(args, plan)
        for notice in cache_notice():
            progress.note(notice)
        with results:
            found = _predicted(args, face, plan, options, 1 if args.preview else steps, progress)
            record = _written(found, results, progress, size, start)
            results.commit()
    if found.failure is not None:
        raise RunError(f"{found.failure}; the last balance on the way is in {results.folder}")
    print(_closing_line(found, record, results.folder) + ("; a quick look, not a prediction" if args.preview else ""))
    return 0


def _options(backend: str, asked: list[str]) -> list[str]:
    """Return the options that are asked for, after the usual ones of the backend that they do not replace."""
    named = {option.split("=")[0].strip() for option in asked}
    return [option for option in USUAL.get(backend, ()) if option.split("=")[0] not in named] + asked


def _results(folder: Path, *, overwrite: bool) -> Results:
    from faceanim.session.recording import Results

    class SurgeryResults(Results):
        KINDS = (*FILES, Results.LAST)  # type: ignore[assignment]

    return SurgeryResults(folder, overwrite=overwrite)


def _face_asked(args: argparse.Namespace, plan: Plan) -> Face:
    from faceanim.face.library import load_face

    face: Face = load_face(args.face or plan.face or "default", args.density or plan.density or "default")
    return face


def _predicted(
    args: argparse.Namespace, face: Face, plan: Plan, options: Any, steps: int | None, progress: Progress
) -> Prediction:
    """Cut, then move the bones step by step, telling how far they are."""
    from faceanim.surgery.operation import operate
    from faceanim.surgery.predict import predict

    progress.stage("cutting the bones")
    operation = operate(face, plan)
    progress.stage("preparing the flesh (the first run compiles, about a minute)")

    def heard(done: int, total: int) -> None:
        progress.detail(f"{done / total:.0%} of the way") if done else progress.stage("moving the bones")

    found = predict(face, operation, backend=args.backend, options=options, steps=steps, heard=heard)
    for notice in getattr(found.solver, "notices", ()):
        progress.note(f"{found.backend}: {notice}")
    return found


def _written(found: Prediction, results: Results, progress: Progress, size: int, start: float) -> dict[str, Any]:
    """Write all results into the hidden part of the folder; return the record."""
    import numpy as np

    from faceanim.geometry.surface import TriMesh
    from faceanim.session.recording import disk_errors, machine, plain, write_record
    from faceanim.surgery import distance_map

    face = found.operation.face
    progress.stage("measuring")
    after = TriMesh(found.points, face.mesh.triangles)
    distance = distance_map.compare(after, face.mesh)
    way = np.linalg.norm(found.points - face.mesh.points, axis=1)
    rows = distance_map.table(distance, after, distance_map.face_regions(face), way > distance_map.MOVED)
    with disk_errors(results.part("statistics.csv")):
        results.part("statistics.csv").write_text(distance_map.csv_text(rows), encoding="utf-8")
    write_record(
        results.part("statistics.json"), {"unit": "mm", "sign": "positive = in front of the old skin", "regions": rows}
    )
    _draw(found, results, progress, size, distance)
    progress.stage("writing meshes")
    files = [*(name for name in FILES if name != "flesh.vtu"), *_write_meshes(found, results, distance)]
    record = _record(found, rows, float(way.max()))
    record |= {"machine": machine(), "files": [*files, "run.json"]}
    record["seconds"]["whole"] = perf_counter() - start
    write_record(results.part("run.json"), record)
    return dict(plain(record))


def _draw(found: Prediction, results: Results, progress: Progress, size: int, distance: Floats) -> None:
    from faceanim.render.sequence import write_png
    from faceanim.surgery import pictures

    progress.stage("drawing")
    operation, poses = found.operation, found.poses
    note = "" if found.failure is None else f" ({found.fraction:.0%} of the way)"
    same: dict[str, Any] = {"size": size, "openness": pictures.skin_openness(operation)}
    shown = pictures.skin_pictures(operation, found.points, poses, titles=("before", f"after{note}"), **same)
    for name, picture in zip(("before.png", "after.png"), shown, strict=True):
        write_png(results.part(name), picture)
    title = pictures.LABEL + note
    write_png(
        results.part("map.png"), pictures.map_picture(operation, found.points, poses, distance, title=title, **same)
    )
    write_png(results.part("bones.png"), pictures.bones_picture(operation, poses, size=max(64, round(0.82 * size))))


def _write_meshes(found: Prediction, results: Results, distance: Floats) -> list[str]:
    """Write the meshes; return the names of those that not every backend has."""
    import numpy as np

    from faceanim.geometry.meshio_bridge import write_volume
    from faceanim.geometry.surface import TriMesh
    from faceanim.session.recording import disk_errors
    from faceanim.surgery import files, pictures

    face, nodes = found.operation.face, found.nodes
    colours = pictures.movement_scale(distance).colours(distance)
    after = TriMesh(found.points, face.mesh.triangles)
    way = np.linalg.norm(found.points - face.mesh.points, axis=1)
    for name, data in (
        ("skin_before.ply", files.ply(face.mesh, region=face.region)),
        ("skin_after.ply", files.ply(after, colours, distance=distance, displacement=way)),
        ("bones_after.ply", files.bones_ply(found.operation, found.poses)),
    ):
        with disk_errors(results.part(name)):
            results.part(name).write_bytes(data)
    if nodes is None:
        return []
    solid = found.body.solid
    assert solid is not None
    held = solid.bone_weight.argmax(axis=1).astype(np.int32)
    points = {"displacement": nodes - solid.mesh.points, "bone": np.where(solid.held, held, -1).astype(np.int32)}
    cells = {"material": solid.region, **files.strains(solid, nodes)}
    moved = type(solid.mesh)(nodes, solid.mesh.tets)
    write_volume(results.part("flesh.vtu"), moved, points, cells)
    return ["flesh.vtu"]


def _record(found: Prediction, rows: Any, farthest: float) -> dict[str, Any]:
    from faceanim.surgery.cut import centroid, volume
    from faceanim.surgery.operation import bite

    operation, solid = found.operation, found.body.solid
    return {
        "plan": operation.plan,
        "face": {
            "name": operation.face.name,
            "density": operation.face.density,
            "vertices": len(found.points),
            "elements": None if solid is None else len(solid.mesh.tets),
        },
        "backend": {"name": found.backend, "options": found.options, "notices": list(getattr(found.solver, "notices", ()))},
        "converged": found.failure is None,
        "fraction": found.fraction,
        "failure": found.failure,
        "load_steps": [
            {name: getattr(report, name) for name in ("iterations", "load_steps", "residual", "least_ratio", "definite")
             if hasattr(report, name)}
            for report in found.reports
        ],
        "bones": {
            name: {"volume_mm3": volume(mesh), "centre_mm": centroid(mesh), "pose": pose}
            for name, mesh, pose in zip(operation.names, operation.bones, found.poses, strict=True)
        },
        "bite_mm": {"before": bite(operation, operation.poses(0.0)), "after": bite(operation, found.poses)},
        "bone_travel_mm": operation.travel,
        "skin_travel_mm": farthest,
        "movement_mm": rows,
        "contact": _contact(found),
        "seconds": dict(found.seconds),
    }  # fmt: skip


def _contact(found: Prediction) -> dict[str, Any] | None:
    """Return how flesh and bones touch at the end, None for a backend or an option without such contact."""
    report = getattr(found.solver, "contact_report", lambda state: None)(found.state)
    return None if report is None else dict(report._asdict())


def _closing_line(found: Prediction, record: dict[str, Any], folder: Path) -> str:
    plan, mean = found.operation.plan, record["movement_mm"]["face"]["mean"]
    return (
        f"{plan.title}: bone moved up to {found.operation.travel:.1f} mm, skin {record['skin_travel_mm']:.1f} mm "
        f"({mean:.1f} mm on average over the face); {found.backend} took {found.seconds['solve']:.1f} s in "
        f"{found.steps} steps; results in {folder}"
    )
