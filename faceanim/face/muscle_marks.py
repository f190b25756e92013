"""Muscle images: from the coloured marks and white lines in a picture of a face to their places [pixel].

Red discs are insertions, green ones attachments, a white line joins the two ends of a muscle; blue discs are the ends
of a sphincter's axes. Lines are drawn first, marks on top.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from faceanim.face.muscle_discs import find_discs
from faceanim.face.muscle_lines import Lines, find_lines
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import UserError

SMALLEST_SIDE = 16


@dataclass(frozen=True)
class MarkFault:
    """What is wrong with a mark or line, in one word and in a sentence, and where [pixel]."""

    code: str
    message: str
    pixel: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Marks:
    """Marks of a muscle image, in continuous coordinates: (0, 0) is the picture's top left corner [pixel].

    insertion : (n, 2) centres of red marks   attachment : (m, 2) of green ones   axis : (k, 2) of blue ones
    line : (l, 2) index of attachment, index of insertion, one row for each pair that a line joins
    fault : what is wrong with the picture; those marks and lines that are right are returned all the same
    """

    insertion: Floats
    attachment: Floats
    axis: Floats
    line: Ints
    fault: tuple[MarkFault, ...] = field(default=())


def find_marks(picture: Any) -> Marks:
    """Return the marks and lines of `picture`, (h, w, 3) uint8 RGB; raise `UserError` for anything else."""
    picture = np.asarray(picture)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8 or min(picture.shape) == 0:
        raise UserError(f"the picture has shape {picture.shape} of {picture.dtype}; (h, w, 3) of uint8 is needed")
    none = np.zeros((0, 2))
    if min(picture.shape[:2]) < SMALLEST_SIDE:
        return Marks(none, none, none, np.zeros((0, 2), np.int32))
    discs = find_discs(picture)
    insertion, attachment, axis = (_in_order(c) for c in discs.centre)
    ends = np.vstack([attachment, insertion])
    kind = np.repeat(np.array([0, 1], np.int32), [len(attachment), len(insertion)])
    lines = find_lines(picture, ends, kind, discs.radius, np.vstack([axis, discs.wrong]))
    right = kind[lines.pair[:, 0]] != kind[lines.pair[:, 1]]
    line = lines.pair[right] - np.array([0, len(attachment)], np.int32)
    fault = _line_faults(lines, right, ends, kind) + _lonely(lines, ends, kind) + _disc_faults(discs.wrong)
    return Marks(insertion, attachment, axis, line[np.lexsort(line.T[::-1])], tuple(fault))


def _in_order(points: Floats) -> Floats:
    """Return points (n, 2) from top to bottom."""
    return points[np.lexsort(points.T)]


def _at(point: Floats) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _line_faults(lines: Lines, right: np.ndarray, ends: Floats, kind: Ints) -> list[MarkFault]:
    out = []
    for a, b in lines.pair[~right]:
        middle = 0.5 * (ends[a] + ends[b])
        if kind[a]:
            text = "this line joins two insertions (red); a muscle needs an attachment: make one of the two marks green"
            out.append(MarkFault("two-insertions", text, _at(middle)))
        else:
            text = "this line joins two attachments (green); a muscle needs an insertion: make one of the two marks red"
            out.append(MarkFault("two-attachments", text, _at(middle)))
    text = (
        "this white line ends here without a mark; draw it up to the centre of a mark, add the mark, or erase the line"
    )
    return out + [MarkFault("line-without-end", text, _at(end)) for end in lines.loose]


def _lonely(lines: Lines, ends: Floats, kind: Ints) -> list[MarkFault]:
    joined = lines.touched.copy()
    joined[lines.pair.ravel()] = True
    out = []
    for k in np.flatnonzero(~joined):
        if kind[k]:
            text = "no white line reaches this insertion (red); join it to an attachment (green), or erase the mark"
            out.append(MarkFault("insertion-without-line", text, _at(ends[k])))
        else:
            text = "no white line reaches this attachment (green); join it to an insertion (red), or erase the mark"
            out.append(MarkFault("attachment-without-line", text, _at(ends[k])))
    return out


def _disc_faults(wrong: Floats) -> list[MarkFault]:
    text = (
        "the colour of this mark means nothing; paint it pure red (255, 0, 0) for an insertion, green (0, 255, 0) for "
        "an attachment or blue (0, 0, 255) for the end of a ring's axis"
    )
    return [MarkFault("wrong-colour", text, _at(point)) for point in wrong]
