"""How a head is laid flat: unrolled about an upright axis, or seen from the front.

Picture coordinates are continuous: (0, 0) is the top left corner, (0.5, 0.5) the centre of the first pixel. The subject's
left is to the right. Both maps follow Zhang, Prakash & Sung, section 3.2 (their Figs 5 and 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from faceanim.ground.arrays import Floats, floats

_MARGIN = 0.02
"""Empty border above and below the head, as a part of its height."""

Size = tuple[int, int]
"""Width and height of a picture [pixel]."""


class Projection(Protocol):
    """A map from space to a picture, and back along rays."""

    def pixels(self, points: Any, size: Size) -> Floats:
        """Return where `points` (n, 3) [mm] lie in a picture, (n, 2) [pixel]."""

    def rays(self, pixels: Any, size: Size) -> tuple[Floats, Floats]:
        """Return where the rays of `pixels` (n, 2) start, outside the head, and their unit directions, 2 x (n, 3).

        What a ray meets first is the outermost layer.
        """


@dataclass(frozen=True)
class Cylinder:
    """The head unrolled: longitude about an upright axis from left to right, the face in the middle, height upwards.

    axis : x and z of the axis [mm]   low, high : heights at the lower and upper border [mm]
    reach : distance of the rays' starts from the axis [mm]
    """

    axis: tuple[float, float]
    low: float
    high: float
    reach: float

    @classmethod
    def of(cls, points: Floats) -> Cylinder:
        """Return the cylinder about the box of a head's `points` (n, 3) [mm]."""
        low, high = points.min(axis=0), points.max(axis=0)
        x, _, z = 0.5 * (low + high)
        border = _MARGIN * float(high[1] - low[1])
        return cls((float(x), float(z)), float(low[1]) - border, float(high[1]) + border, float(np.ptp(points)))

    def longitude(self, points: Floats) -> Floats:
        """Return the angle from straight ahead towards the subject's left of `points` (n, 3), (n,) [rad]."""
        return np.arctan2(points[:, 0] - self.axis[0], points[:, 2] - self.axis[1])

    def pixels(self, points: Any, size: Size) -> Floats:
        """As `Projection.pixels`."""
        points = floats("points", points, None, 3)
        right = 0.5 + self.longitude(points) / (2.0 * np.pi)
        down = (self.high - points[:, 1]) / (self.high - self.low)
        return np.stack([right * size[0], down * size[1]], axis=1)

    def rays(self, pixels: Any, size: Size) -> tuple[Floats, Floats]:
        """As `Projection.rays`; they run towards the axis."""
        pixels = floats("pixels", pixels, None, 2)
        angle = 2.0 * np.pi * (pixels[:, 0] / size[0] - 0.5)
        out = np.stack([np.sin(angle), np.zeros(len(angle)), np.cos(angle)], axis=1)
        height = self.high - pixels[:, 1] / size[1] * (self.high - self.low)
        foot = np.stack([np.full(len(angle), self.axis[0]), height, np.full(len(angle), self.axis[1])], axis=1)
        return foot + self.reach * out, -out


@dataclass(frozen=True)
class Front:
    """The head seen from the front without perspective; its height fills the picture.

    centre : x in the middle of the picture [mm]   low, high : heights at the lower and upper border [mm]
    start : z of the rays' starts [mm]
    """

    centre: float
    low: float
    high: float
    start: float

    @classmethod
    def of(cls, points: Floats) -> Front:
        """Return the view of a head with `points` (n, 3) [mm]."""
        low, high = points.min(axis=0), points.max(axis=0)
        border = _MARGIN * float(high[1] - low[1])
        middle, start = 0.5 * float(low[0] + high[0]), float(2.0 * high[2] - low[2])
        return cls(middle, float(low[1]) - border, float(high[1]) + border, start)

    def pixels(self, points: Any, size: Size) -> Floats:
        """As `Projection.pixels`."""
        points = floats("points", points, None, 3)
        scale = size[1] / (self.high - self.low)
        return np.stack(
            [0.5 * size[0] + scale * (points[:, 0] - self.centre), scale * (self.high - points[:, 1])], axis=1
        )

    def rays(self, pixels: Any, size: Size) -> tuple[Floats, Floats]:
        """As `Projection.rays`; they run straight back."""
        pixels = floats("pixels", pixels, None, 2)
        scale = (self.high - self.low) / size[1]
        start = np.empty((len(pixels), 3))
        start[:, 0] = self.centre + scale * (pixels[:, 0] - 0.5 * size[0])
        start[:, 1] = self.high - scale * pixels[:, 1]
        start[:, 2] = self.start
        return start, np.tile([0.0, 0.0, -1.0], (len(pixels), 1))
