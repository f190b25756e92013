"""How accurate a run was, measured against better runs of the same expression."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np

from faceanim.bench.metrics import FieldError, field_error, worst
from faceanim.ground.arrays import Floats
from faceanim.session.session import Session

FINE_STEPS = 4
"""How many steps the converged trajectory takes for one of the run."""


@dataclass(frozen=True)
class Accuracy:
    """Measured errors [mm] over all vertices.

    partition : against the same run with every vertex dynamic, worst frame (None for a full run)
    rest : the held apex against the converged equilibrium, found from rest
    trajectory : against the converged trajectory (Newton, `FINE_STEPS` times the steps), worst frame
    trajectory_share : the same as a share: root of the squared errors over the squared displacements, whole run [-]
    largest_movement : of the apex [mm], to compare with
    """

    partition: FieldError | None
    rest: FieldError | None
    trajectory: FieldError | None
    trajectory_share: float | None
    largest_movement: float


def apex_frame(session: Session) -> int:
    """Return the last frame of the held apex (the last frame of all if the run ends before)."""
    return min(session.frame_count - 1, int(session.timeline.apex_end * session.fps + 1e-9))


def measure(session: Session, positions: Floats, *, trajectory: bool = False) -> Iterator[Accuracy]:
    """Yield the accuracy of a run known so far, better informed each time; the last one holds all that was asked for.

    positions : (frame, n, 3) of the whole run [mm]
    trajectory : also follow the converged trajectory, which takes some hundred times as long as the run
    """
    frame = apex_frame(session)
    apex = np.asarray(positions[frame])
    size = float(np.linalg.norm(apex - session.body.surface.points, axis=1).max())
    result = Accuracy(None, None, None, None, size)
    full = full_session(session)
    if full is not None:
        result = replace(result, partition=_against(full, positions))
        yield result
    reference = session if full is None else full
    state = reference.solver.solve_static(session.control(session.timeline.at(frame / session.fps)))
    points = np.empty_like(apex)
    reference.solver.surface(state, points)
    result = replace(result, rest=field_error(apex, points))
    yield result
    if trajectory:
        yield _along(session, positions, result)


def _along(session: Session, positions: Floats, result: Accuracy) -> Accuracy:
    """Return `result` with the comparison with the converged trajectory."""
    rest, errors, off, way = session.body.surface.points, [], 0.0, 0.0
    for frame in _converged_session(session).frames(copy=False):
        errors.append(field_error(positions[frame.index], frame.points))
        off += float(((positions[frame.index] - frame.points) ** 2).sum())
        way += float(((frame.points - rest) ** 2).sum())
    return replace(result, trajectory=worst(errors), trajectory_share=float(np.sqrt(off / way)) if way > 0.0 else 0.0)


def _against(reference: Session, positions: Floats) -> FieldError:
    return worst([field_error(positions[frame.index], frame.points) for frame in reference.frames(copy=False)])


def full_session(session: Session) -> Session | None:
    """Return the same session with every vertex dynamic, None if it is already so."""
    options = session.options
    if not getattr(options, "adaptive", False):
        return None
    return with_options(session, replace(options, adaptive=False), session.dt)


def _converged_session(session: Session) -> Session:
    wanted: dict[str, Any] = {"adaptive": False, "scheme": "newton"}
    options = session.options
    known = {f.name for f in fields(options)} if is_dataclass(options) else set()
    better = replace(options, **{k: v for k, v in wanted.items() if k in known})
    return with_options(session, better, session.dt / FINE_STEPS)


def with_options(session: Session, options: Any, largest_step: float) -> Session:
    """Return the same session with other options and a largest step [s]."""
    return Session(
        session.face,
        session.expression,
        session.timeline,
        fps=session.fps,
        duration=session.duration,
        backend=session.backend,
        options=options,
        largest_step=largest_step * (1.0 + 1e-9),
        body=session.body,
    )
