"""The course of an expression in time: onset, apex, offset, and the lag of the muscles behind their command."""

from __future__ import annotations

import math
from functools import cached_property

import msgspec
import numpy as np

from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError

LONGEST = 600.0
"""Longest phase of a timeline [s]."""

_LAG_STEP = 5e-4


class Timeline(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """Durations [s]: `delay` at rest, a smooth rise over `onset`, `apex` held, a fall over `offset`, `tail` at rest.

    Rise and fall are minimum-jerk curves (Flash & Hogan 1985): no velocity or acceleration at either end.
    tau_on, tau_off : time constants of a first-order lag of activation behind the command [s], 0 = no lag; about
    0.03 and 0.06 for facial muscle.
    """

    delay: float = 0.0
    onset: float = 0.5
    apex: float = 0.6
    offset: float = 0.5
    tail: float = 0.4
    tau_on: float = 0.0
    tau_off: float = 0.0

    def __post_init__(self) -> None:
        for name in ("delay", "onset", "apex", "offset", "tail", "tau_on", "tau_off"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0.0 <= value <= LONGEST):
                raise UserError(f"timeline: {name} = {value:g} s is outside 0..{LONGEST:g}")

    @property
    def duration(self) -> float:
        """The sum of all phases [s]."""
        return self.delay + self.onset + self.apex + self.offset + self.tail

    @property
    def apex_end(self) -> float:
        """The time at which the apex has been held and the offset begins [s]."""
        return self.delay + self.onset + self.apex

    def command(self, t: float) -> float:
        """Return the commanded intensity in [0, 1] at time `t` [s], without lag."""
        t -= self.delay
        if t < 0.0:
            return 0.0
        if t < self.onset:
            return _minimum_jerk(t / self.onset)
        t -= self.onset + self.apex
        if t < 0.0:
            return 1.0
        return 1.0 - _minimum_jerk(t / self.offset) if t < self.offset else 0.0

    def at(self, t: float) -> float:
        """Return the intensity in [0, 1] at time `t` [s], lag included."""
        if self.tau_on == 0.0 and self.tau_off == 0.0:
            return self.command(t)
        if t <= 0.0:
            return 0.0
        curve = self._lagged
        k = t / _LAG_STEP
        if k < len(curve) - 1:
            low = int(k)
            return float(curve[low] + (k - low) * (curve[low + 1] - curve[low]))
        rest = t - (len(curve) - 1) * _LAG_STEP
        return float(curve[-1] * math.exp(-rest / self.tau_off)) if self.tau_off > 0.0 else 0.0

    @cached_property
    def _lagged(self) -> Floats:
        """The lagged intensity every half millisecond: da/dt = (command - a) / tau, exact for each held command."""
        count = math.ceil((self.duration + 1.0) / _LAG_STEP) + 1
        keep_on, keep_off = (math.exp(-_LAG_STEP / tau) if tau > 0.0 else 0.0 for tau in (self.tau_on, self.tau_off))
        curve = np.zeros(count)
        a = 0.0
        for k in range(1, count):
            wanted = self.command((k - 0.5) * _LAG_STEP)
            a = wanted + (a - wanted) * (keep_on if wanted > a else keep_off)
            curve[k] = a
        return curve


def _minimum_jerk(u: float) -> float:
    u = min(1.0, max(0.0, u))
    return min(1.0, u * u * u * (10.0 + u * (6.0 * u - 15.0)))
