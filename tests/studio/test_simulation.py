"""The live simulation: it steps in time, follows its targets, exchanges what it steps, and survives what goes wrong."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from toys import MUSCLES, ToyOptions, toy_body, toy_face

from faceanim.backends import BACKENDS
from faceanim.expression.action_units import Jaw
from faceanim.ground.errors import UserError
from faceanim.studio.engine import STEP, Setup
from faceanim.studio.mixing import Demands, Mixer
from faceanim.studio.simulation import LiveSimulation, Moment, Target

WHO = "zygomaticus_major_left"


class Watch:
    """Keeps what a simulation tells."""

    def __init__(self) -> None:
        self.moments: list[Moment] = []
        self.messages: list[tuple[str, str]] = []

    def kinds(self) -> list[str]:
        """Return the kinds of messages so far."""
        return [kind for kind, _ in self.messages]


def until(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    """Wait for `condition`; fail after some seconds."""
    end = time.perf_counter() + seconds
    while not condition():
        assert time.perf_counter() < end, "it did not happen in time"
        time.sleep(0.005)


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Watch:
    """Register the toy backend and return something to watch with."""
    monkeypatch.setitem(BACKENDS, "toy", "toys:ToySolver")
    return Watch()


@pytest.fixture
def live(watch: Watch) -> Iterator[LiveSimulation]:
    """A running simulation of the toy face."""
    simulation = LiveSimulation(
        toy_face(), Setup(toy_body(), "toy"), watch.moments.append, lambda *message: watch.messages.append(message)
    )
    with simulation:
        simulation.wait_ready()
        until(lambda: bool(watch.moments))
        yield simulation


def lift(moment: Moment) -> float:
    """Return how far the muscle under test has moved its vertex [mm]."""
    body = toy_body()
    node = body.muscles.node[MUSCLES.index(WHO)]
    return float(moment.points[node, 2] - body.surface.points[node, 2])


@pytest.mark.slow
def test_it_keeps_time(live: LiveSimulation) -> None:
    """Thirty updates a second of real time, neither more nor fewer."""
    start, before = time.perf_counter(), live.updates
    time.sleep(2.0)
    rate = (live.updates - before) / (time.perf_counter() - start)
    assert rate == pytest.approx(1.0 / STEP, rel=0.05)


def test_it_eases_towards_its_target(live: LiveSimulation, watch: Watch) -> None:
    """No jump, most of the way within 0.15 s, and exactly there in the end."""
    live.aim(Target({WHO: 0.8}))
    until(lambda: lift(watch.moments[-1]) == pytest.approx(8.0, abs=1e-9))
    way = [lift(m) for m in watch.moments]
    first = next(k for k, v in enumerate(way) if v > 0.0)
    assert way[first] < 6.0
    assert way[first + round(0.15 / STEP)] > 0.9 * 8.0
    assert np.all(np.diff(way) >= -1e-12)


def test_the_jaw_follows_too(live: LiveSimulation, watch: Watch) -> None:
    """The jaw's pose is published with every update."""
    live.aim(Target({}, Jaw(opening=1.0)))
    until(lambda: watch.moments[-1].jaw_pose[1, 3] == pytest.approx(-40.0))


def test_muscles_that_are_not_there_are_left_out(live: LiveSimulation, watch: Watch) -> None:
    """A slider of a muscle that was just deleted does no harm."""
    live.aim(Target({"no_such_muscle": 1.0, WHO: 1.0}))
    until(lambda: lift(watch.moments[-1]) == pytest.approx(10.0))
    assert "error" not in watch.kinds()


def test_other_muscles_take_over_where_the_old_ones_are(live: LiveSimulation, watch: Watch) -> None:
    """The face does not jump when a muscle is added, and the target stays."""
    live.aim(Target({WHO: 1.0}))
    until(lambda: lift(watch.moments[-1]) == pytest.approx(10.0))
    count = len(watch.moments)
    old = live.setup.body.muscles
    live.use_muscles(replace(old, names=(*old.names[:-1], "renamed")))
    live.wait_ready()
    until(lambda: len(watch.moments) > count + 10)
    assert all(lift(m) == pytest.approx(10.0) for m in watch.moments[count:])


def test_a_wrong_choice_is_refused_at_once(live: LiveSimulation) -> None:
    """An unknown scheme raises where it was asked for, and nothing changes."""
    before = live.setup
    with pytest.raises(UserError, match="unknown scheme"):
        live.exchange(lambda old: replace(old, backend="mass_spring", options=None).with_scheme("magic"))
    assert live.setup is before


def test_what_cannot_be_prepared_leaves_the_old_one_running(live: LiveSimulation, watch: Watch) -> None:
    """A solver that fails in its constructor is reported; the old simulation goes on."""
    before, setup = live.updates, live.setup
    live.exchange(lambda old: replace(old, options="not options at all"))
    until(lambda: "error" in watch.kinds())
    until(lambda: live.updates > before + 5)
    assert live.setup is setup


def test_divergence_resets_and_reports(live: LiveSimulation, watch: Watch) -> None:
    """A skin that leaves the finite numbers goes back to rest, the targets too, and stepping goes on."""
    live.aim(Target({WHO: 1.0}))
    live.exchange(lambda old: replace(old, options=ToyOptions(blow_up=0.2)))
    until(lambda: "diverged" in watch.kinds())
    assert live.target == Target()
    assert all(np.isfinite(m.points).all() for m in watch.moments)
    count = live.updates
    until(lambda: live.updates > count + 2)


@pytest.mark.slow
def test_a_slow_solver_is_counted_honestly(live: LiveSimulation, watch: Watch) -> None:
    """Fewer updates than wanted are told as such; messages and targets still get through."""
    live.exchange(lambda old: replace(old, options=ToyOptions(pause=0.1)))
    live.wait_ready()
    time.sleep(2.2)
    assert live.rate < 12.0


def test_it_pauses_and_rests(live: LiveSimulation, watch: Watch) -> None:
    """Nothing steps while paused; rest is immediate."""
    live.aim(Target({WHO: 1.0}))
    until(lambda: lift(watch.moments[-1]) == pytest.approx(10.0))
    live.pause(True)
    time.sleep(0.1)
    before = live.updates
    time.sleep(0.2)
    assert live.updates == before
    live.rest()
    live.pause(False)
    until(lambda: live.updates > before)
    assert lift(watch.moments[-1]) == pytest.approx(0.0)


def test_only_the_last_of_many_choices_is_used(live: LiveSimulation, watch: Watch) -> None:
    """Clicking through choices quickly prepares the last one and ends there."""
    for pause in (0.001, 0.002, 0.003):
        live.exchange(lambda old, pause=pause: replace(old, options=ToyOptions(pause=pause)))  # type: ignore[misc]
    live.wait_ready()
    assert live.setup.options.pause == 0.003


def test_demands_are_mixed_by_the_largest() -> None:
    """Two units that use one muscle do not add; single muscles count as well; lateral movements add and are limited."""
    mixer = Mixer(MUSCLES)
    alone = mixer.target(Demands(units={(12, "both"): 0.5}))
    both = mixer.target(Demands(units={(12, "both"): 0.5, (11, "both"): 0.2}, muscles={"zygomaticus_minor_left": 0.9}))
    assert both.activation["zygomaticus_minor_left"] == 0.9
    assert both.activation["zygomaticus_major_left"] == alone.activation["zygomaticus_major_left"] == 0.5
    jaw = mixer.target(Demands(units={(30, "left"): 1.0}, jaw={"lateral": 0.7, "opening": 0.5})).jaw
    assert (jaw.lateral, jaw.opening) == (1.0, 0.5)


def test_an_expression_at_half_asks_for_half() -> None:
    """A slider at 0.5 asks each muscle for half of what the expression asks at its apex."""
    mixer = Mixer(MUSCLES)
    full: Any = mixer.target(Demands(expressions={"happiness": 1.0}))
    half = mixer.target(Demands(expressions={"happiness": 0.5}))
    assert half.activation == {name: 0.5 * value for name, value in full.activation.items()}
