"""Where the labels of a chart go: near their points, inside the axes, and never over each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from faceanim.ground.arrays import Bools, Floats

PAD = 3.0
"""Room around every label [pixel at 100 dots per inch]."""
RADII = (0.12, 0.18, 0.28, 0.40, 0.55, 0.75, 1.0, 1.4, 1.9, 2.5)
"""Gaps between a point and its label that are tried [inch]."""
ANGLES = np.radians(np.arange(0.0, 360.0, 15.0))
LEADER = 0.07
"""A label further away than this is joined to its point by a line [inch]."""
HARD, COVER, PASS, LINE, FAR = 1e6, 90.0, 30.0, 2.0, 25.0
"""What it costs: to cover a label or leave the axes, to cover a mark, to lead past one, to cover a line (each of its
samples), to be an inch away."""


SWEEPS = 5
"""How often every label is placed anew, given where the others are."""


@dataclass
class Clutter:
    """What labels should keep off, in pixels.

    boxes : low x, low y, high x, high y of other text, never covered   marks, lines : (m, 2) points
    """

    boxes: list[Floats] = field(default_factory=list)
    marks: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    lines: Floats = field(default_factory=lambda: np.zeros((0, 2)))

    def add_line(self, start: Floats, end: Floats) -> None:
        """Add a line from one point (2,) to another."""
        count = 2 + int(np.hypot(*(end - start)) / 4.0)
        self.lines = np.concatenate([self.lines, start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)])

    def with_labels(self, points: Floats, boxes: Sequence[Floats | None], without: int) -> Clutter:
        """Return a copy with the `boxes` of labels and the lines to their `points`, but for one label."""
        out = Clutter(list(self.boxes), self.marks, self.lines)
        for k, box in enumerate(boxes):
            if box is not None and k != without:
                out.boxes.append(box)
                out.add_line(points[k], np.clip(points[k], box[:2], box[2:]))
        return out


def place_labels(axes: Any, points: Floats, texts: Sequence[str], clutter: Clutter, **style: Any) -> int:
    """Write `texts` beside `points` (n, 2) [data], with thin lines between; return how many found no room.

    clutter : in pixels of the figure as it is drawn now; the layout must not change afterwards
    style : of `axes.text`;  labels carry the gid "label"
    """
    renderer = axes.figure.canvas.get_renderer()
    dpi = axes.figure.dpi
    frame = np.array(axes.get_window_extent(renderer).extents) + 2.0 * np.array([1, 1, -1, -1])
    labels = [
        axes.text(0.0, 0.0, t, transform=axes.transAxes, va="bottom", ha="left", gid="label", **style) for t in texts
    ]
    for label in labels:
        label.set_parse_math(False)
    extents = [label.get_window_extent(renderer) for label in labels]
    at = axes.transData.transform(points)
    boxes = arranged(at, [np.array([e.width, e.height]) for e in extents], frame, clutter, dpi)
    origin, to_axes = axes.transAxes.transform((0.0, 0.0)), axes.transAxes.inverted()
    for label, extent, point, box in zip(labels, extents, at, boxes, strict=True):
        if box is None:
            label.remove()
            continue
        label.set_position(to_axes.transform(box[:2] - extent.p0 + origin))
        near = np.clip(point, box[:2], box[2:])
        if np.hypot(*(near - point)) > LEADER * dpi:
            ends = to_axes.transform([point, near])
            axes.plot(*ends.T, color="#777777", linewidth=0.7, transform=axes.transAxes, zorder=1.5, gid="leader")
    return sum(box is None for box in boxes)


def arranged(
    points: Floats, sizes: Sequence[Floats], frame: Floats, clutter: Clutter, dpi: float
) -> list[Floats | None]:
    """Return a box (4,) for every label, inside `frame` and off all other boxes; None where there is no room [pixel].

    points : (n, 2)   sizes : (2,) of each label.  One label after the other goes where it is best, given the others,
    until none moves any more
    """
    boxes: list[Floats | None] = [None] * len(sizes)
    for _ in range(SWEEPS):
        before = list(boxes)
        for k, (point, size) in enumerate(zip(points, sizes, strict=True)):
            corner = _best(point, size, frame, clutter.with_labels(points, boxes, k), dpi)
            boxes[k] = None if corner is None else np.concatenate([corner, corner + size])
        if all(a is not None and b is not None and np.array_equal(a, b) for a, b in zip(before, boxes, strict=True)):
            break
    return boxes


def _best(point: Floats, size: Floats, frame: Floats, clutter: Clutter, dpi: float) -> Floats | None:
    """Return the lower left corner of the best free box of `size` near `point`, None if there is none [pixel]."""
    for corners in (_around(point, size, dpi), _everywhere(size, frame)):
        if len(corners):
            cost = _cost(corners, point, size, frame, clutter, dpi)
            if cost.min() < HARD:
                return np.asarray(corners[int(np.argmin(cost))])
    return None


def _around(point: Floats, size: Floats, dpi: float) -> Floats:
    """Return corners of boxes whose borders are at the given gaps from the point, in every direction."""
    direction = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    # From the middle of a box to its border, the way it is looked at.
    reach = 0.5 * size / np.maximum(np.abs(direction), 1e-9)
    border = direction * reach.min(axis=1, keepdims=True)
    gap = np.array(RADII)[:, None, None] * dpi * direction
    return np.asarray((point + gap + border - 0.5 * size).reshape(-1, 2))


def _everywhere(size: Floats, frame: Floats) -> Floats:
    x = np.arange(frame[0], frame[2] - size[0], 8.0)
    y = np.arange(frame[1], frame[3] - size[1], 8.0)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _cost(low: Floats, point: Floats, size: Floats, frame: Floats, clutter: Clutter, dpi: float) -> Floats:
    """Return what it costs to put the label's lower left corner at each of `low` (k, 2)."""
    high, pad = low + size, PAD * dpi / 100.0
    off = (low < frame[:2]).any(axis=1) | (high > frame[2:]).any(axis=1)
    near = np.clip(point, low, high)
    cost = HARD * off + FAR * np.hypot(*(near - point).T) / dpi
    cost += COVER * _inside(clutter.marks, low - 2.5 * pad, high + 2.5 * pad).sum(axis=1)
    cost += LINE * _inside(clutter.lines, low - pad, high + pad).sum(axis=1)
    # The line to the point must not run through other labels, nor over marks.
    path = (point + np.linspace(0.0, 1.0, 16)[:, None, None] * (near - point)).swapaxes(0, 1)
    for box in clutter.boxes:
        apart = (high + pad <= box[:2]).any(axis=1) | (low - pad >= box[2:]).any(axis=1)
        cost += HARD * ~apart
        crossed = np.all((path > box[:2]) & (path < box[2:]), axis=2)
        cost += 4.0 * PASS * np.any(crossed, axis=1)
    others = clutter.marks[np.hypot(*(clutter.marks - point).T) > 2.0 * pad]
    if len(others):
        distance = np.hypot(*(path[:, :, None] - others).transpose(3, 0, 1, 2)).min(axis=1)
        cost += PASS * (distance < 2.5 * pad).sum(axis=1)
    return np.asarray(cost)


def _inside(points: Floats, low: Floats, high: Floats) -> Bools:
    """Return which `points` (m, 2) lie in which boxes (k, 2), as (k, m)."""
    return np.asarray(((points > low[:, None]) & (points < high[:, None])).all(axis=2))
