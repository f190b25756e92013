"""The running simulation behind the page: a thread that steps in real time and can be steered from any other thread."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter, sleep
from typing import Any

import numpy as np

from faceanim.backends.solver import StepReport
from faceanim.body.body import Muscles
from faceanim.expression.action_units import Jaw
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import FaceanimError, RunError
from faceanim.studio.engine import STEP, Engine, Setup

EASING = 0.05
"""Time constant with which muscles and jaw follow the sliders [s]; three of them make 95 % of the way."""
_SETTLED = 1e-4
_COUNTED = 2.0
_MOST_LATE = 6
"""Updates that are caught up with after a delay; time that is lost beyond them is lost."""


@dataclass(frozen=True, eq=False)
class Moment:
    """One update: the skin `points` (n, 3) [mm], the pose of the jaw (4, 4), what the step cost [s]."""

    index: int
    points: Floats
    jaw_pose: Floats
    report: StepReport
    seconds: float


@dataclass(frozen=True)
class Target:
    """Where the face is to go: muscle -> activation in [0, 1], all others at rest, and the jaw."""

    activation: dict[str, float] = field(default_factory=dict)
    jaw: Jaw = field(default_factory=Jaw)


class LiveSimulation:
    """Steps a face at 30 updates a second of real time, under targets that may change at any moment.

    face : needs `jaw` (the jaw's motion)    setup : what is simulated at first
    on_moment(moment) : called from the simulation's thread after every step; must be quick
    on_message(kind, text) : "preparing", "ready", "error"; called from the simulation's threads
    Use `start` and `stop`; between them every method may be called from any thread.
    """

    def __init__(
        self,
        face: Any,
        setup: Setup,
        on_moment: Callable[[Moment], None] = lambda moment: None,
        on_message: Callable[[str, str], None] = lambda kind, text: None,
    ) -> None:
        self.face, self.on_moment, self.on_message = face, on_moment, on_message
        self._lock = threading.Condition()
        self._wanted, self._order, self._built = setup, 1, 0
        self._ready: Engine | None = None
        self._engine: Engine | None = None
        self._target = Target()
        self._jaw = np.zeros(3)
        self._stopping = False
        self._paused = False
        self._reset = False
        self._threads: list[threading.Thread] = []
        self._times: deque[float] = deque(maxlen=240)
        self.updates = 0
        self.preparation = 0.0

    def start(self) -> None:
        """Start stepping as soon as the solver is ready."""
        for work, name in ((self._build, "studio-build"), (self._run, "studio-step")):
            thread = threading.Thread(target=work, name=name, daemon=True)
            self._threads.append(thread)
            thread.start()

    def stop(self) -> None:
        """Stop both threads; calling it twice does no harm."""
        with self._lock:
            self._stopping = True
            self._lock.notify_all()
        for thread in self._threads:
            thread.join(timeout=10.0)

    def __enter__(self) -> LiveSimulation:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def aim(self, target: Target) -> None:
        """Head for `target`; muscles that the body lacks are left out."""
        with self._lock:
            self._target = target

    @property
    def target(self) -> Target:
        """Where the face is heading."""
        with self._lock:
            return self._target

    def rest(self) -> None:
        """Go back to rest at once."""
        with self._lock:
            self._target, self._reset = Target(), True

    def pause(self, paused: bool) -> None:
        """Stand still, or go on."""
        with self._lock:
            self._paused = paused
            self._lock.notify_all()

    def exchange(self, change: Callable[[Setup], Setup]) -> None:
        """Simulate something else as soon as it is prepared; until then, or if it fails, the old one goes on.

        Raises `UserError` at once if `change` finds that there is no such thing.
        """
        with self._lock:
            self._wanted = change(self._wanted)
            self._order += 1
            self._lock.notify_all()

    def use_muscles(self, muscles: Muscles) -> None:
        """Simulate the same body with other muscles."""
        self.exchange(lambda setup: replace(setup, body=replace(setup.body, muscles=muscles)))

    @property
    def setup(self) -> Setup:
        """What is simulated now, or will be once it is prepared."""
        with self._lock:
            return self._wanted

    @property
    def settled(self) -> bool:
        """Whether what was last asked for is what is being simulated."""
        with self._lock:
            return self._built == self._order and self._ready is None

    @property
    def rate(self) -> float:
        """Updates per second over the last two seconds [1/s]."""
        now = perf_counter()
        recent = [t for t in tuple(self._times) if now - t <= _COUNTED]
        return len(recent) / _COUNTED

    def wait_ready(self, timeout: float = 120.0) -> None:
        """Wait until what was asked for is running; raise `RunError` after `timeout` [s]."""
        end = perf_counter() + timeout
        while not (self.settled and self._engine is not None):
            if perf_counter() > end:
                raise RunError(f"the simulation was not ready within {timeout:g} s")
            sleep(0.01)

    def _build(self) -> None:
        """Prepare whatever is wanted last, off the stepping thread."""
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._stopping or self._built != self._order)
                if self._stopping:
                    return
                setup, order, first = self._wanted, self._order, self._engine is None
            self.on_message("preparing", "the first run compiles, about a minute" if first else "the new simulation")
            start, failure, engine = perf_counter(), "", None
            try:
                engine = Engine(setup, self.face.jaw)
                engine.warm()
            except FaceanimError as error:
                failure = str(error)
            except Exception as error:
                failure = f"unexpected {type(error).__name__}: {error}"
            self._deliver(engine, setup, order, failure, perf_counter() - start)

    def _deliver(self, engine: Engine | None, setup: Setup, order: int, failure: str, seconds: float) -> None:
        with self._lock:
            self._built = order
            if order != self._order:
                return  # something newer is wanted by now
            if failure:
                if self._engine is not None:
                    self._wanted = self._engine.setup
            else:
                self._ready = engine
            self.preparation = seconds
            self._lock.notify_all()
        if failure:
            self.on_message("error", f"{failure}; the former simulation goes on")
        else:
            self.on_message("ready", f"{setup.backend}, prepared in {seconds:.2f} s")

    def _run(self) -> None:
        due = perf_counter()
        while True:
            with self._lock:
                self._lock.wait_for(self._has_work)
                if self._stopping:
                    return
                self._adopt()
                target, reset, self._reset = self._target, self._reset, False
                engine = self._engine
            assert engine is not None
            if reset:
                engine.reset()
                self._jaw[:] = 0.0
            self._step(engine, target)
            due = max(due + STEP, perf_counter() - _MOST_LATE * STEP)
            sleep(max(0.0, due - perf_counter()))

    def _has_work(self) -> bool:
        return self._stopping or self._ready is not None or (self._engine is not None and not self._paused)

    def _adopt(self) -> None:
        """Exchange the engine for the one that is ready; it goes on where the old one is."""
        new, self._ready = self._ready, None
        if new is None:
            return
        old, self._engine = self._engine, new
        if old is not None:
            was = dict(zip(old.names, old.control.activation, strict=True))
            new.inherit(old)
            new.aim(np.array([was.get(name, 0.0) for name in new.names]), _jaw_of(self._jaw))

    def _step(self, engine: Engine, target: Target) -> None:
        keep = math.exp(-STEP / EASING)
        wanted = np.array([target.activation.get(name, 0.0) for name in engine.names])
        jaw = np.array([target.jaw.opening, target.jaw.lateral, target.jaw.protrusion])
        engine.aim(_eased(engine.control.activation, wanted, keep), _jaw_of(_eased(self._jaw, jaw, keep, self._jaw)))
        try:
            report, seconds = engine.step()
        except FaceanimError as error:
            engine.reset()
            self._jaw[:] = 0.0
            with self._lock:
                self._target = Target()
            self.on_message("diverged", f"back to rest: {error}")
            return
        self.updates += 1
        self._times.append(perf_counter())
        self.on_moment(Moment(self.updates, engine.points.copy(), engine.jaw_pose.copy(), report, seconds))


def _eased(now: Floats, wanted: Floats, keep: float, out: Floats | None = None) -> Floats:
    """Return `now` on its way to `wanted`, there at once when it is near."""
    way = wanted - now
    moved = np.where(np.abs(way) < _SETTLED, wanted, now + (1.0 - keep) * way)
    if out is not None:
        out[:] = moved
    return moved


def _jaw_of(values: Floats) -> Jaw:
    opening, lateral, protrusion = (float(v) for v in values)
    return Jaw(opening, lateral, protrusion)
