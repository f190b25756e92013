"""A session steps a solver along a timeline and yields frames; everything downstream sees only surface positions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from faceanim.backends import backend_class, make_solver
from faceanim.backends.solver import Solver, State, StepReport
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.expression.action_units import load_action_units, parse_unit
from faceanim.expression.expression import Expression
from faceanim.expression.library import load_expression
from faceanim.expression.timeline import Timeline
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import DivergenceError, UserError
from faceanim.session.command import Command

if TYPE_CHECKING:
    from faceanim.face.face import Face

FPS_LIMITS = (1.0, 1000.0)
LONGEST = 600.0
MOST_FRAMES = 20_000
_FARTHEST = 1000.0


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture's worth of motion: `points` (n, 3) [mm] at time `t` [s]; `seconds` of wall time it took."""

    index: int
    t: float
    points: Floats
    report: StepReport
    seconds: float


@dataclass
class Timings:
    """What a run cost: per frame wall time of the simulation [s], and the solver's phases added up [s]."""

    preparation: float = 0.0
    frame: list[float] = field(default_factory=list)
    steps: int = 0
    phases: dict[str, float] = field(default_factory=dict)

    @property
    def frames_per_second(self) -> float:
        """Simulated frames per second of wall time, from the median frame (nan before the first step)."""
        return 1.0 / float(np.median(self.frame)) if self.frame and np.median(self.frame) > 0 else math.nan


class Session:
    """An expression on a face: iterate it to get frames, from rest, as often as wanted, always the same.

    face : the face    expression : what it should do    timeline : None = the expression's own, else the usual one
    fps : frames per second [1/s]    duration : [s], None = the whole timeline    options : the backend's Options
    largest_step : longest time step [s]; a frame is divided into equal steps no longer than this
    body : the face's body, if it has been built already
    Raises `UserError` for a muscle the face lacks, or fps and duration outside their limits.
    """

    def __init__(
        self,
        face: Face,
        expression: Expression,
        timeline: Timeline | None = None,
        *,
        fps: float = 30.0,
        duration: float | None = None,
        backend: str = "mass_spring",
        options: Any = None,
        largest_step: float = 1.0 / 30.0,
        body: Body | None = None,
    ) -> None:
        self.face, self.expression = face, expression
        self.timeline = timeline or expression.timeline or Timeline()
        self.fps = fps
        self.duration = self.timeline.duration if duration is None else duration
        self.frame_count = _frame_count(fps, self.duration)
        self.body = face.body() if body is None else body
        self.options = backend_class(backend).Options() if options is None else options
        self._command = Command(face, self.body, expression)
        self.drive = self._command.drive
        self.solver: Solver = make_solver(backend, self.body, self.options)
        self.backend = backend
        limit = min(self.solver.dt_max, largest_step)
        if not limit > 0.0:
            raise UserError(f"backend {backend}: the largest step is {limit} s; it must be positive")
        self.steps_per_frame = max(1, math.ceil(1.0 / fps / limit - 1e-9))
        self.dt = 1.0 / fps / self.steps_per_frame
        self.timings = Timings()
        self._warm = False

    def control(self, intensity: float, out: Control | None = None) -> Control:
        """Return the control at `intensity` [0, 1] of the expression, written into `out` if given."""
        return self._command.at(intensity, out)

    def warm(self) -> None:
        """Prepare the solver for this expression and compile what it needs, so that frames are timed warm."""
        if self._warm:
            return
        start = perf_counter()
        control = self.control(1.0)
        prepare = getattr(self.solver, "prepare", None)
        if prepare is not None:
            prepare(control)
        state = self.solver.rest()
        for _ in range(2):
            self.solver.step(state, state, control, self.dt)
        self.solver.surface(state, np.empty_like(self.body.surface.points))
        self.timings.preparation = perf_counter() - start
        self._warm = True

    def frames(self, *, copy: bool = True) -> Iterator[Frame]:
        """Yield every frame in order, from rest. With copy=False all frames share one array, overwritten each time.

        Raises `DivergenceError` naming frame, time, step and what to change, instead of a frame that is not finite.
        """
        self.warm()
        self.timings = Timings(self.timings.preparation)
        state, control = self.solver.rest(), self.control(0.0)
        points = self.body.surface.points.copy()
        offset = np.empty_like(points)
        report = StepReport()
        for index in range(self.frame_count):
            seconds = 0.0
            if index:
                start = perf_counter()
                report = self._advance(state, control, index)
                self.solver.surface(state, points)
                seconds = perf_counter() - start
                self._keep(report, seconds)
                self._reject_divergence(points, offset, index)
            yield Frame(index, index / self.fps, points.copy() if copy else points, report, seconds)

    def __iter__(self) -> Iterator[Frame]:
        return self.frames()

    def __len__(self) -> int:
        return self.frame_count

    def _advance(self, state: State, control: Control, index: int) -> StepReport:
        """Step from frame `index` - 1 to frame `index`; each step sees the control at its end."""
        total = StepReport()
        for k in range(1, self.steps_per_frame + 1):
            self.control(self.timeline.at((index - 1) / self.fps + k * self.dt), control)
            try:
                report = self.solver.step(state, state, control, self.dt)
            except DivergenceError as error:
                raise DivergenceError(f"the simulation diverged at {self._when(index)}: {error}") from error
            total.iterations += report.iterations
            total.residual = report.residual
            total.converged &= report.converged
            for phase, seconds in report.seconds.items():
                total.seconds[phase] = total.seconds.get(phase, 0.0) + seconds
        return total

    def _keep(self, report: StepReport, seconds: float) -> None:
        self.timings.frame.append(seconds)
        self.timings.steps += self.steps_per_frame
        for phase, spent in report.seconds.items():
            self.timings.phases[phase] = self.timings.phases.get(phase, 0.0) + spent

    def _reject_divergence(self, points: Floats, offset: Floats, index: int) -> None:
        np.subtract(points, self.body.surface.points, out=offset)
        np.abs(offset, out=offset)
        if offset.max() < _FARTHEST:
            return
        vertex = int(np.argmax(~(offset < _FARTHEST).all(axis=1)))
        raise DivergenceError(
            f"the simulation diverged at {self._when(index)}: vertex {vertex} moved {float(offset[vertex].max()):.3g} "
            "mm; choose another scheme, a shorter step or a smaller activation"
        )

    def _when(self, index: int) -> str:
        return f"frame {index} (t = {index / self.fps:.3f} s, steps of {self.dt * 1e3:.3g} ms, backend {self.backend})"


def _frame_count(fps: float, duration: float) -> int:
    if not FPS_LIMITS[0] <= fps <= FPS_LIMITS[1]:
        raise UserError(f"fps = {fps:g} is outside {FPS_LIMITS[0]:g}..{FPS_LIMITS[1]:g} frames per second")
    if not 0.0 < duration <= LONGEST:
        raise UserError(f"duration = {duration:g} s is outside the limits: more than 0, at most {LONGEST:g}")
    count = max(1, round(duration * fps))
    if count > MOST_FRAMES:
        raise UserError(f"duration {duration:g} s at {fps:g} fps makes {count} frames; at most {MOST_FRAMES} are made")
    return count


def express(
    name: str,
    *,
    face: str = "default",
    density: str = "default",
    units: Iterable[str] = (),
    activation: dict[str, float] | None = None,
    jaw: dict[str, float] | None = None,
    **session: Any,
) -> Session:
    """Return the session of expression `name` on a face of the library; iterate it to get frames.

    units : action units on top of it, such as "12=0.8" or "R12=0.5"    activation : muscle name -> [0, 1]
    jaw : opening, lateral, protrusion    session : what `Session` takes (timeline, fps, duration, backend, options)
    Raises `UserError` for a name or a value that cannot be, naming the nearest that can.
    """
    from faceanim.face.library import load_face

    expression = adjusted(load_expression(name), units, activation or {}, jaw or {})
    return Session(load_face(face, density), expression, **session)


def adjusted(
    expression: Expression, units: Iterable[str], activation: dict[str, float], jaw: dict[str, float]
) -> Expression:
    """Return `expression` with action units, muscles and jaw controls of one's own set on top."""
    table = load_action_units()
    changed = expression.with_units(parse_unit(text, table) for text in units)
    return replace(changed, muscles={**changed.muscles, **activation}, jaw={**changed.jaw, **jaw})
