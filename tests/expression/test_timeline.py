"""Timelines: smooth, within [0, 1], and lagging as a first-order lag does."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from faceanim.expression.timeline import Timeline
from faceanim.ground.errors import UserError

seconds = st.floats(0.0, 2.0)


@given(st.builds(Timeline, seconds, seconds, seconds, seconds, seconds), st.floats(-1.0, 12.0))
def test_intensity_stays_between_rest_and_apex(line: Timeline, t: float) -> None:
    """At any time and for any phases, zero-length ones included, the intensity lies in [0, 1]."""
    assert 0.0 <= line.at(t) <= 1.0


def test_phases_follow_one_another() -> None:
    """Rest, half way up in the middle of the onset, apex, half way down in the middle of the offset, rest."""
    line = Timeline(delay=0.1, onset=0.4, apex=0.3, offset=0.2, tail=0.5)
    wanted = [(0.0, 0.0), (0.1, 0.0), (0.3, 0.5), (0.5, 1.0), (0.79, 1.0), (0.9, 0.5), (1.0, 0.0), (1.4, 0.0)]
    for t, value in wanted:
        assert line.at(t) == pytest.approx(value, abs=1e-9)
    assert line.duration == pytest.approx(1.5)
    assert line.apex_end == pytest.approx(0.8)


def test_the_course_is_smooth() -> None:
    """Minimum jerk: between fine samples neither intensity nor its slope jumps."""
    line = Timeline()
    a = np.array([line.at(t) for t in np.linspace(0.0, line.duration, 4001)])
    slope = np.diff(a) / (line.duration / 4000)
    assert np.abs(slope).max() < 1.9 / 0.5
    assert np.abs(np.diff(slope)).max() < 0.02


def test_the_lag_is_the_exact_first_order_response() -> None:
    """A step up follows 1 - exp(-t / tau_on), the step down exp(-t / tau_off) (30 and 60 ms)."""
    line = Timeline(onset=0.0, apex=1.0, offset=0.0, tail=0.5, tau_on=0.03, tau_off=0.06)
    for t in (0.01, 0.03, 0.1):
        assert line.at(t) == pytest.approx(1.0 - math.exp(-t / 0.03), abs=1e-6)
        assert line.at(1.0 + t) == pytest.approx(math.exp(-t / 0.06), abs=1e-6)
    assert line.at(5.0) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf, 1e9])
@pytest.mark.parametrize("phase", ["delay", "onset", "apex", "offset", "tail", "tau_on", "tau_off"])
def test_impossible_durations_are_refused(phase: str, bad: float) -> None:
    """The message names the phase and its limits."""
    with pytest.raises(UserError, match=f"{phase} = .* is outside 0..600"):
        Timeline(**{phase: bad})
