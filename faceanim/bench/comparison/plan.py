"""The cheapest way to animate a scene that is accurate and fast enough, from what has been measured on this machine.

For a scene that has been measured the errors are its own. For another expression of the face they are forecast: each
region of the face is taken to move as far as a quick run says, and to be off by the largest share of its movement by
which the candidate was off in any measured scene. How far that can be trusted is measured as well: every measured scene
is forecast from the others, and the hits are counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from faceanim.bench.comparison.rows import Row, worst
from faceanim.ground.errors import UserError

STILL = 0.5
"""A region whose RMS movement [mm] is smaller counts as standing still: its error is forecast in mm, not as a share."""
RESERVE = 1.15
"""The upper quartile of the cost times this must fit into a frame."""
TOLERANCES, RATES = (0.001, 100.0), (1.0, 1000.0)

Regions = Mapping[str, tuple[float, float]]
"""RMS movement of each region [mm], and its share of the probes."""


@dataclass(frozen=True)
class Option:
    """What a row promises for a scene at a rate: error [mm], cost of a frame (median and with reserve) [ms], steps."""

    row: Row
    error: float
    frame_ms: float
    reserved_ms: float
    steps_per_frame: int

    def meets(self, tolerance: float, fps: float) -> bool:
        """Whether it is accurate and fast enough."""
        return self.error <= tolerance and self.fast(fps)

    def fast(self, fps: float) -> bool:
        """Whether it is fast enough."""
        return self.reserved_ms <= 1e3 / fps


@dataclass(frozen=True)
class Plan:
    """What was asked, what is chosen (None = nothing meets both), and the nearest to it on either side.

    accurate : the fastest within the tolerance   fast : the most accurate at the rate   best : the most accurate of all
    measured : the scene itself has been measured; otherwise `hits` of `trials` forecasts of measured scenes held
    uncertainty : RMS error of the reference itself [mm]
    """

    scene: str
    tolerance: float
    fps: float
    against: str
    chosen: Option | None
    accurate: Option | None
    fast: Option | None
    best: Option | None
    measured: bool
    hits: int
    trials: int
    uncertainty: float

    def sentence(self) -> str:
        """Say what to take, or which of the two wishes to relax and by how much."""
        if self.chosen is not None:
            one = self.chosen
            return (
                f"{one.row.label}: {one.error:.2g} mm RMS, {one.frame_ms:.3g} ms a frame "
                f"({1e3 / one.frame_ms:.0f} frames/s); {self.trust()}"
            )
        ways = []
        if self.fast is not None:
            ways.append(f"allow {_up(self.fast.error)} mm ({self.fast.row.label})")
        if self.accurate is not None:
            rate = _down(1e3 / self.accurate.reserved_ms)
            ways.append(f"be content with {rate} of these frames a second ({self.accurate.row.label})")
        elif self.best is not None and (self.fast is None or self.best.error < self.fast.error):
            rate, name = _down(1e3 / self.best.reserved_ms), self.best.row.label
            ways.append(f"allow {_up(self.best.error)} mm and be content with {rate} of these frames a second ({name})")
        if not ways:
            ways.append("no candidate came so far; relax both")
        return f"nothing meets {self.tolerance:g} mm at {self.fps:g} frames/s: " + ", or ".join(ways)

    def record(self) -> dict[str, Any]:
        """Return what was asked and chosen, for a run's record."""
        return {
            "tolerance_mm": self.tolerance,
            "fps": self.fps,
            "against": self.against,
            "chosen": None if self.chosen is None else self.chosen.row.label,
            "promised_mm": None if self.chosen is None else self.chosen.error,
            "trust": self.trust(),
        }

    def trust(self) -> str:
        """Say how sure the promise is."""
        if self.measured:
            sure = "measured on this machine"
        else:
            sure = f"forecast: {self.hits} of {self.trials} such forecasts of measured scenes held"
        if self.against == "reference" and self.tolerance < 2.0 * self.uncertainty:
            sure += f"; the reference itself is known to {self.uncertainty:.2g} mm"
        return sure


def _up(value: float) -> str:
    """Return a number rounded up to two digits."""
    scale = 10.0 ** (math.floor(math.log10(value)) - 1) if value > 0 else 1.0
    return f"{math.ceil(value / scale - 1e-9) * scale:.2g}"


def _down(value: float) -> str:
    """Return a number rounded down to two digits."""
    scale = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.floor(value / scale + 1e-9) * scale:.2g}"


def cost(row: Row, fps: float) -> tuple[float, float, int]:
    """Return the cost of a frame at `fps`, the same with reserve [ms], and its steps, none longer than the row's."""
    assert row.frame_ms is not None and row.frame_high_ms is not None
    steps = max(1, math.ceil(1.0 / fps / row.step - 1e-9))
    share = steps / row.steps_per_frame
    return row.frame_ms * share, RESERVE * max(row.frame_high_ms, row.frame_ms) * share, steps


def own_error(row: Row) -> float:
    """Return what the time stepping alone costs in accuracy [mm], infinite where that is not known."""
    return math.inf if row.scheme_error is None else row.scheme_error.rms


MEASURES: dict[str, Callable[[Row], float]] = {"reference": worst, "own": own_error}
"""What "accurate" means: near the scene's reference, or near the converged motion of the same model."""


def candidate_key(row: Row) -> tuple[str, str, str, int]:
    """Return what makes two rows of different scenes the same candidate."""
    return row.backend, row.scheme, row.density, row.steps_per_frame


def forecast(rows: Sequence[Row], movement: Regions) -> float:
    """Return the RMS error [mm] to expect of one candidate where regions move by `movement`, from its `rows`.

    Infinite if the candidate failed in any of them: it may fail again.
    """
    if not all(row.counts for row in rows) or not rows:
        return math.inf
    shares, rests = _shares(rows)
    total, weight = 0.0, 0.0
    for name, (moved, part) in movement.items():
        error = rests.get(name, 0.0) if moved < STILL else shares.get(name, max(shares.values(), default=1.0)) * moved
        total, weight = total + part * error**2, weight + part
    return math.sqrt(total / weight) if weight else math.inf


def _shares(rows: Sequence[Row]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the largest relative error of each region that moved, and the largest error of each that stood still."""
    shares: dict[str, float] = {}
    rests: dict[str, float] = {}
    for row in rows:
        for name, (error, moved, _) in row.regions.items():
            if moved >= STILL:
                shares[name] = max(shares.get(name, 0.0), error / moved)
            else:
                rests[name] = max(rests.get(name, 0.0), error)
    return shares, rests


def grouped(rows: Sequence[Row]) -> list[list[Row]]:
    """Return the rows of each candidate together."""
    out: dict[tuple[str, str, str, int], list[Row]] = {}
    for row in rows:
        out.setdefault(candidate_key(row), []).append(row)
    return list(out.values())


def options_of_scene(rows: Sequence[Row], fps: float, against: str) -> list[Option]:
    """Return what the rows of one measured scene promise."""
    return [Option(row, MEASURES[against](row), *cost(row, fps)) for row in rows if row.counts]


def options_forecast(rows: Sequence[Row], movement: Regions, fps: float, against: str) -> list[Option]:
    """Return what the rows of several measured scenes promise for one that moves by `movement`."""
    out = []
    for group in grouped(rows):
        if not all(row.counts for row in group):
            continue
        dearest = max(group, key=lambda row: cost(row, fps)[1])
        if against == "own":
            error = max(own_error(row) for row in group)
        else:
            error = forecast(group, movement)
        out.append(Option(dearest, error, *cost(dearest, fps)))
    return out


def left_out(rows: Sequence[Row], tolerance: float, fps: float, against: str) -> tuple[int, int]:
    """Return how many plans held of those made for each measured scene from the other ones.

    A plan that chooses nothing is no trial: it promises nothing.
    """
    hits, trials = 0, 0
    scenes = sorted({row.scene for row in rows})
    for scene in scenes:
        others = [row for row in rows if row.scene != scene]
        truth = {candidate_key(row): row for row in rows if row.scene == scene}
        movement = {n: (moved, part) for row in truth.values() for n, (_, moved, part) in row.regions.items()}
        for wish in (tolerance, 2.0 * tolerance, 4.0 * tolerance):
            chosen = _cheapest(options_forecast(others, movement, fps, against), wish, fps)
            if chosen is None or candidate_key(chosen.row) not in truth:
                continue
            came = truth[candidate_key(chosen.row)]
            trials += 1
            hits += came.counts and MEASURES[against](came) <= wish
    return hits, trials


def _cheapest(options: Sequence[Option], tolerance: float, fps: float) -> Option | None:
    good = [one for one in options if one.meets(tolerance, fps)]
    return min(good, key=lambda one: (one.frame_ms, one.error), default=None)


def planned(
    scene: str,
    options: Sequence[Option],
    tolerance: float,
    fps: float,
    *,
    against: str = "reference",
    uncertainty: float = 0.0,
    measured: bool = True,
    trials: tuple[int, int] = (0, 0),
) -> Plan:
    """Return the plan for a scene; raise `UserError` for a tolerance or rate outside the limits or no options at all."""
    for name, value, (low, high) in (("tolerance", tolerance, TOLERANCES), ("fps", fps, RATES)):
        if not low <= value <= high:
            raise UserError(f"{name} = {value:g} is outside {low:g} to {high:g}")
    if not options:
        raise UserError(f"no candidate came through scene {scene}; see its table with `faceanim compare`")
    accurate = min((o for o in options if o.error <= tolerance), key=lambda o: o.reserved_ms, default=None)
    fast = min(
        (o for o in options if o.fast(fps) and math.isfinite(o.error)),
        key=lambda o: (o.error, o.frame_ms),
        default=None,
    )
    best = min((o for o in options if math.isfinite(o.error)), key=lambda o: (o.error, o.frame_ms), default=None)
    chosen = _cheapest(options, tolerance, fps)
    return Plan(scene, tolerance, fps, against, chosen, accurate, fast, best, measured, *trials, uncertainty)
