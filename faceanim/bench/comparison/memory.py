"""What has been measured on this machine, remembered for planning: one table per scene in the user's cache."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from faceanim.bench.alone import alone
from faceanim.bench.comparison.candidates import Candidate, candidates
from faceanim.bench.comparison.plan import Plan, Regions, left_out, options_forecast, options_of_scene, planned
from faceanim.bench.comparison.reference import reference, rms
from faceanim.bench.comparison.rows import Comparison, Row, as_json
from faceanim.bench.comparison.scenes import SCENES, Scene
from faceanim.bench.comparison.sweep import TABLE, Sweep, Watcher, current
from faceanim.ground.errors import UserError
from faceanim.ground.files import write_whole
from faceanim.ground.folders import user_cache, writable_folder
from faceanim.session.recording import machine

HOPELESS = 4.0
"""A candidate that takes longer than a frame by this factor in one scene is not tried in the next."""
LIMIT = 60.0
"""What the frames of one candidate may take when it is measured for a plan [s]."""
TRAINING = tuple(name for name in SCENES if name.startswith("face-"))
"""The scenes from which other expressions are forecast."""


def machine_name() -> str:
    """Return processor and cores, as rows name them."""
    computer = machine()
    return f"{computer['processor']}, {computer['cores']} cores"


def memory_of(scene: Scene) -> Path:
    """Return the folder in which the rows of a scene on this machine are remembered."""
    mark = hashlib.sha256(machine_name().encode()).hexdigest()[:8]
    return writable_folder(user_cache() / "measured" / mark / scene.name, "measured rows")


def remembered(scene: Scene) -> list[Row]:
    """Return the rows of a scene that still hold; a damaged memory is as good as none."""
    try:
        rows = Sweep(scene, [], memory_of(scene)).known().values()
    except UserError:
        return []
    return [row for row in rows if current(row, scene)]


def remember(scene: Scene, comparison: Comparison) -> None:
    """Add the rows of a comparison to what is remembered; newer ones replace older ones of the same key."""
    folder = memory_of(scene)
    with alone(folder):
        kept = {row.key: row for row in remembered(scene)} | {row.key: row for row in comparison.rows}
        write_whole(folder / TABLE, as_json(replace(comparison, rows=list(kept.values()))))


def measured(scene: Scene, wanted: Sequence[Candidate], watcher: Watcher, limit: float) -> list[Row]:
    """Return everything known of a scene after measuring those of `wanted` that are not; damaged tables are made anew."""
    folder = memory_of(scene)
    sweep = Sweep(scene, list(wanted), folder, limit=limit)
    try:
        sweep.known()
    except UserError:
        (folder / TABLE).replace(folder / f"{TABLE}.damaged")
    fresh = sweep.run(machine_name(), watcher).rows
    known = {row.key: row for row in remembered(scene)}
    return list((known | {row.key: row for row in fresh}).values())


def plan_for(
    scene: Scene,
    tolerance: float,
    fps: float,
    *,
    against: str = "reference",
    backends: tuple[str, ...] = (),
    densities: tuple[str, ...] = (),
    watcher: Watcher = lambda row: None,
    unseen: bool = False,
) -> Plan:
    """Return the plan for a scene, after measuring what is missing for it (minutes, once on a machine).

    A built-in scene is measured itself. Another expression is forecast from those in `TRAINING`, unless it has been
    compared on this machine. backends, densities : only these (empty = all)   unseen : forecast even if it has
    Raises `UserError` for limits, or if no candidate is left.
    """
    wanted = candidates(scene.name, quick=True, backends=backends, densities=densities)
    if scene.name in SCENES and not unseen:
        rows = measured(scene, wanted, watcher, limit=LIMIT)
    else:
        rows = [] if unseen else remembered(scene)
    if rows:
        options = options_of_scene(_chosen(rows, backends, densities), fps, against)
        return planned(scene.name, options, tolerance, fps, against=against, uncertainty=reference(scene).uncertainty)
    known = _chosen(_training(wanted, fps, watcher), backends, densities)
    return planned(
        scene.name, options_forecast(known, movement_of(scene), fps, against), tolerance, fps, against=against,
        uncertainty=max(reference(SCENES[name]).uncertainty for name in TRAINING), measured=False,
        trials=left_out(known, tolerance, fps, against),
    )  # fmt: skip


def _training(wanted: Sequence[Candidate], fps: float, watcher: Watcher) -> list[Row]:
    """Return the rows of all candidates that have been measured in every scene of `TRAINING`, measuring what is missing.

    Who is hopelessly slow in one scene is not tried in the next.
    """
    rows: list[Row] = []
    for name in TRAINING:
        rows += measured(SCENES[name], wanted, watcher, limit=LIMIT)
        slow = {row.label for row in rows if row.frame_ms is None or row.frame_ms > HOPELESS * 1e3 / fps}
        wanted = [one for one in wanted if one.label not in slow]
    count = Counter(row.label for row in rows)
    return [row for row in rows if count[row.label] == len(TRAINING)]


def _chosen(rows: Sequence[Row], backends: tuple[str, ...], densities: tuple[str, ...]) -> list[Row]:
    return [
        row for row in rows if (not backends or row.backend in backends) and (not densities or row.density in densities)
    ]


@lru_cache(maxsize=8)
def movement_of(scene: Scene) -> Regions:
    """Return how far each region of a face moves [mm] by a quick look: the balance of `mass_spring` on the coarse mesh."""
    from faceanim.backends import make_solver
    from faceanim.bench.comparison.reference import Probe

    stage = scene.stage("coarse")
    solver = make_solver("mass_spring", stage.body)
    moved = Probe(scene, "coarse", solver)(solver.solve_static(stage.ask(scene.held_share)))
    return {name: (rms(moved[mask]), float(mask.mean())) for name, mask in scene.regions.items()}
