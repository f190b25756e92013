"""One candidate in one scene, measured in a process of its own, which reads a job from its input."""

from __future__ import annotations

import ctypes
import gc
import math
import sys
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import quantiles
from time import perf_counter
from typing import Any

import msgspec
import numpy as np

from faceanim.backends import make_solver
from faceanim.backends.solver import Solver, State
from faceanim.bench.comparison.candidates import Candidate
from faceanim.bench.comparison.reference import Probe, Reference, reference, rms
from faceanim.bench.comparison.rows import Errors, Row
from faceanim.bench.comparison.scenes import FPS, Scene, Stage, scene_named
from faceanim.bench.comparison.sources import physics_key
from faceanim.bench.framerate import fresh_partitions
from faceanim.bench.metrics import SkinCheck
from faceanim.ground.arrays import Floats
from faceanim.ground.cache import content_key, load_arrays, save_arrays
from faceanim.ground.errors import DivergenceError, FaceanimError, UserError

FARTHEST = 1000.0
"""A vertex that moved so far [mm] has flown away."""
YARDSTICK = {"mass_spring": ({"scheme": "newton", "integrator": "bdf2"}, 8)}
"""Backends with a time stepping of their own that is solved to the end: its options and steps per frame."""


class Job(msgspec.Struct, frozen=True):
    """What the process is told. limit : [s] for the frames   result : file for the last frame, "" = none"""

    scene: str
    candidate: Candidate
    row: Row
    limit: float
    result: str


@dataclass
class Run:
    """What one run gave: probes (frames, m, 3), seconds per frame, and the solver in its last state."""

    motion: Floats
    seconds: list[float]
    start: Floats
    last: Floats
    inverted: int


class TooSlow(Exception):
    """The time limit was reached after so many frames."""


def errors(found: Floats, wanted: Floats) -> Errors:
    """Return how far displacements (..., m, 3) are from those wanted."""
    distance = np.sqrt(((found - wanted) ** 2).sum(axis=-1))
    root, movement = rms(found - wanted), rms(wanted)
    return Errors(root, float(np.quantile(distance, 0.95)), float(distance.max()), root / movement if movement else 0.0)


def prepared(stage: Stage, candidate: Candidate) -> Any:
    """Return a solver that has prepared itself for the whole load."""
    solver: Any = make_solver(candidate.backend, stage.body, candidate.options())
    prepare = getattr(solver, "prepare", None)
    if prepare is not None:
        prepare(stage.ask(1.0))
    return solver


def run(scene: Scene, candidate: Candidate, solver: Solver, limit: float = np.inf) -> Run:
    """Return a run of `scene` from its beginning; raise `DivergenceError`, or `TooSlow` beyond `limit` [s]."""
    stage = scene.stage(candidate.density)
    probe = Probe(scene, candidate.density, solver)
    candidate = replace(candidate, steps_per_frame=stable_steps(candidate, solver))
    state = solver.solve_static(stage.ask(scene.held_share)) if scene.release else solver.rest()
    start = probe(state)
    motion, seconds = np.empty((scene.frames, *start.shape)), []
    began = perf_counter()
    for frame in range(scene.frames):
        controls = _controls(scene, stage, candidate, frame)
        tick = perf_counter()
        for control in controls:
            solver.step(state, state, control, candidate.step)
        solver.surface(state, probe.points)
        seconds.append(perf_counter() - tick)
        motion[frame] = probe(state)
        _reject_divergence(probe.points - stage.body.surface.points, frame)
        if perf_counter() - began > limit:
            raise TooSlow(f"{frame + 1} of {scene.frames} frames took {perf_counter() - began:.0f} s")
    inverted = SkinCheck(stage.body).at(probe.points, stage.ask(scene.share(scene.duration))).inverted_triangles
    return Run(motion, seconds, start, probe.points.copy(), inverted)


def stable_steps(candidate: Candidate, solver: Solver) -> int:
    """Return the steps per frame that are taken: those asked for, or more if the solver's largest step is shorter."""
    return max(candidate.steps_per_frame, math.ceil(1.0 / FPS / solver.dt_max - 1e-9))


def _controls(scene: Scene, stage: Stage, candidate: Candidate, frame: int) -> list[Any]:
    return [stage.ask(scene.share(frame / FPS + k * candidate.step)) for k in range(1, candidate.steps_per_frame + 1)]


def _reject_divergence(offset: Floats, frame: int) -> None:
    farthest = float(np.abs(offset).max())
    if not farthest < FARTHEST:
        raise DivergenceError(f"frame {frame + 1} of the run is {farthest:.3g} mm away")


def measure(scene: Scene, candidate: Candidate, row: Row, limit: float, result: str = "") -> Row:
    """Return `row` filled in with what a run of `candidate` costs and how far it is off; failures are outcomes.

    result : npz file for the surface (n, 3) of the last frame [mm], "" = none
    """
    try:
        row, found = _timed(scene, candidate, row, limit)
    except TooSlow as slow:
        return replace(row, outcome="too slow", reason=f"time limit of {limit:.0f} s: {slow}")
    except DivergenceError as error:
        return replace(row, outcome="diverged", reason=str(error))
    except UserError as error:
        return replace(row, outcome="refused", reason=str(error))
    except (FaceanimError, MemoryError, ArithmeticError, np.linalg.LinAlgError) as error:
        return replace(row, outcome="failed", reason=f"{type(error).__name__}: {error}")
    if result:
        np.savez(result, points=found.last.astype(np.float32))
    return judged(scene, candidate, row, found, reference(scene))


def judged(scene: Scene, candidate: Candidate, row: Row, found: Run, against: Reference) -> Row:
    """Return `row` with the errors of a run; the held balance of a release is its beginning."""
    held = found.start if scene.release else found.motion[-1]
    own = yardstick(scene, candidate)
    outcome, reason = "done", ""
    if found.inverted > MOST_INVERTED * len(scene.stage(candidate.density).body.surface.triangles):
        outcome, reason = "inverted", f"{found.inverted} triangles of the surface are turned inside out"
    return replace(
        row,
        outcome=outcome,
        reason=reason,
        rest=errors(held, against.balance),
        along=errors(found.motion, against.motion),
        scheme_error=None if own is None else errors(found.motion, own),
        regions=_by_region(scene, held, found, against),
        inverted=found.inverted,
    )


def _by_region(scene: Scene, held: Floats, found: Run, against: Reference) -> dict[str, tuple[float, float, float]]:
    """Return error and movement [mm] of each region of a face, and its share of the probes."""
    out = {}
    for name, mask in scene.regions.items():
        error = max(rms((held - against.balance)[mask]), rms((found.motion - against.motion)[:, mask]))
        out[name] = (error, rms(against.balance[mask]), float(mask.mean()))
    return out


MOST_INVERTED = 0.01
"""A surface with a larger share of its triangles turned over counts as a failure."""


def _timed(scene: Scene, candidate: Candidate, row: Row, limit: float) -> tuple[Row, Run]:
    """Return `row` with its costs, and the run: first a rehearsal of two steps that compiles, then everything anew."""
    import numba

    stage = scene.stage(candidate.density)
    if not candidate.backend == "mass_spring":
        assert stage.body.solid is not None
    began = perf_counter()
    solver = prepared(stage, candidate)
    _rehearse(solver, stage, candidate)
    first = perf_counter() - began
    del solver
    base = _settled_memory()
    began = perf_counter()
    with fresh_partitions():
        solver = prepared(stage, candidate)
    setup = perf_counter() - began
    again = perf_counter()
    _rehearse(solver, stage, candidate)
    again = perf_counter() - again
    found = run(scene, candidate, solver, limit)
    low, middle, high = quantiles(found.seconds, n=4, method="inclusive")
    return replace(
        row,
        unknowns=int(getattr(solver, "unknowns", 0)) or _unknowns(solver.rest()),
        threads=numba.get_num_threads(),
        frames=len(found.seconds),
        frame_ms=1e3 * middle,
        frame_low_ms=1e3 * low,
        frame_high_ms=1e3 * high,
        setup_s=setup,
        compile_s=max(0.0, first - setup - again),
        memory_mb=max(0.0, _peak_memory() - base),
    ), found


def _rehearse(solver: Solver, stage: Stage, candidate: Candidate) -> None:
    state: State = solver.rest()
    for _ in range(2):
        solver.step(state, state, stage.ask(0.01), candidate.step)
    solver.surface(state, np.empty_like(stage.body.surface.points))


def _unknowns(state: State) -> int:
    return int(np.size(state.q))


def _status(field: str) -> float | None:
    with suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith(field):
                return float(line.split()[1]) / 1024.0
    return None


def _settled_memory() -> float:
    """Give back what is free, begin a new peak where the system can, and return what is in use now [MB]."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return _status("VmRSS") or _peak_memory()


def _peak_memory() -> float:
    """Return the largest memory in use since `_settled_memory` [MB]; elsewhere than on Linux, since the beginning."""
    peak = _status("VmHWM")
    if peak is None:
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    return peak


def yardstick(scene: Scene, candidate: Candidate) -> Floats | None:
    """Return the motion of the probes by the same model, stepped as well as its backend can, None if it has no such way."""
    if candidate.backend not in YARDSTICK:
        return None
    settings, steps = YARDSTICK[candidate.backend]
    best = Candidate(candidate.backend, "yardstick", settings, candidate.density, steps)
    key = content_key(
        "yardstick-1", scene.name, scene.duration, candidate.density, candidate.backend, physics_key(candidate.backend)
    )
    kept = load_arrays("yardsticks", key)
    if kept is None:
        kept = {"motion": run(scene, best, prepared(scene.stage(best.density), best)).motion}
        save_arrays("yardsticks", key, **kept)
    return kept["motion"]


def main() -> None:
    """Read a job from standard input and write its row to standard output."""
    from faceanim.session.recording import machine

    job = msgspec.json.decode(sys.stdin.buffer.read(), type=Job)
    computer = machine()
    row = replace(job.row, machine=f"{computer['processor']}, {computer['cores']} cores")
    out = sys.stdout.buffer
    row = measure(scene_named(job.scene), job.candidate, row, job.limit, job.result)
    out.write(msgspec.json.encode(row))
    out.flush()


if __name__ == "__main__":
    main()
