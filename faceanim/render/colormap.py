"""Colour maps that are even to the eye, made from a few anchors in a perceptual colour space."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from faceanim.ground.arrays import Floats
from faceanim.ground.errors import unknown_name
from faceanim.render.shading import linear, srgb

# Bjoern Ottosson's Oklab (2020): linear sRGB -> cone responses -> lightness and two opponent colours.
_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)

# sRGB anchors; the sequential map climbs in lightness all the way, the two-sided one peaks in the middle.
_ANCHORS = {
    "depth": [(0.13, 0.12, 0.30), (0.16, 0.33, 0.55), (0.10, 0.57, 0.57), (0.45, 0.76, 0.40), (0.98, 0.91, 0.35)],
    "two_sided": [(0.08, 0.22, 0.55), (0.35, 0.58, 0.85), (0.95, 0.94, 0.92), (0.90, 0.52, 0.38), (0.55, 0.06, 0.16)],
}
_TABLE = 256


def _lab(colour: Floats) -> Floats:
    return np.cbrt(linear(colour) @ _CONES.T) @ _LAB.T


def _from_lab(lab: Floats) -> Floats:
    return np.clip(srgb(np.clip((lab @ np.linalg.inv(_LAB).T) ** 3 @ np.linalg.inv(_CONES).T, 0.0, 1.0)), 0.0, 1.0)


@cache
def colour_table(name: str) -> Floats:
    """Return 256 sRGB colours (256, 3) in [0, 1] at even steps of perceived difference along the map.

    "depth" is for quantities from zero up, "two_sided" for those of either sign. Raises `UserError` otherwise.
    """
    if name not in _ANCHORS:
        raise unknown_name("colour map", name, _ANCHORS)
    anchor = _lab(np.array(_ANCHORS[name]))
    fine = np.linspace(0.0, len(anchor) - 1.0, 4096)
    path = np.stack([np.interp(fine, np.arange(len(anchor)), anchor[:, k]) for k in range(3)], axis=1)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    if name == "two_sided":  # the middle colour stays in the middle
        half = len(length) // 2
        length = np.concatenate(
            [
                0.5 * length[:half] / length[half],
                0.5 + 0.5 * (length[half:] - length[half]) / (length[-1] - length[half]),
            ]
        )
    even = np.interp(np.linspace(0.0, length[-1], _TABLE), length, fine)
    table = _from_lab(np.stack([np.interp(even, fine, path[:, k]) for k in range(3)], axis=1))
    table.setflags(write=False)
    return table


@dataclass(frozen=True)
class Scale:
    """A colour scale: values from `low` to `high` over the map `name`, with a label that names quantity and unit."""

    low: float
    high: float
    label: str
    name: str = "depth"

    def colours(self, values: Any) -> Floats:
        """Return sRGB colours (n, 3) in [0, 1] for `values` (n,), clipped to the scale."""
        span = self.high - self.low if self.high > self.low else 1.0
        place = np.clip((np.asarray(values, dtype=np.float64) - self.low) / span, 0.0, 1.0) * (_TABLE - 1)
        table = colour_table(self.name)
        i = np.minimum(place.astype(np.int64), _TABLE - 2)
        part = (place - i)[..., None]
        return (1.0 - part) * table[i] + part * table[i + 1]


PARTITION: tuple[tuple[str, tuple[float, float, float]], ...] = (
    ("dynamic", (0.84, 0.30, 0.22)),
    ("quasi-static", (0.95, 0.77, 0.30)),
    ("static", (0.62, 0.66, 0.70)),
)
"""Node sets 0, 1, 2 of the adaptive scheme: name and sRGB colour."""


def round_top(value: float) -> float:
    """Return the next round number from `value` on, for the upper end of a scale (1 if `value` is not positive)."""
    if not 0.0 < value < np.inf:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    steps = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
    return float(next((s * power for s in steps if s * power >= 0.9999 * value), 10.0 * power))
