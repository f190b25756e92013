"""How well muscle images are read: muscles drawn, the picture treated as files are, and mapped back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import cv2
import numpy as np

from faceanim.face.muscle_image import MuscleMap, read_picture_marks
from faceanim.face.muscle_places import RINGS, Places
from faceanim.face.muscles import AnyMuscle, LinearMuscle, SheetMuscle, one_sided
from faceanim.ground.arrays import Floats
from faceanim.render.muscle_picture import muscle_image

if TYPE_CHECKING:
    from faceanim.face.face import Face


def jpeg(picture: np.ndarray, quality: int = 90) -> np.ndarray:
    """Return what JPEG makes of a picture (h, w, 3) RGB bytes."""
    data = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.ascontiguousarray(decoded[:, :, ::-1])


def resized(picture: np.ndarray, size: int, how: int = cv2.INTER_AREA) -> np.ndarray:
    """Return a picture at another size [pixel]."""
    return cv2.resize(picture, (size, size), interpolation=how)


TREATMENTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as drawn": lambda p: p,
    "JPEG 90": jpeg,
    "384": lambda p: resized(p, 384),
    "384, linear": lambda p: resized(p, 384, cv2.INTER_LINEAR),
    "1024": lambda p: resized(p, 1024, cv2.INTER_LINEAR),
    "1024, cubic": lambda p: resized(p, 1024, cv2.INTER_CUBIC),
    "384 and JPEG 90": lambda p: jpeg(resized(p, 384)),
}
"""What happens to pictures 512 pixels wide on their way."""


@dataclass(frozen=True)
class RoundTrip:
    """One picture read back: muscles drawn, found and named right, faults, errors of all marks [mm], seconds."""

    kind: str
    treatment: str
    drawn: int
    right: int
    faults: int
    median: float
    max: float
    seconds: float


def mark_errors(found: MuscleMap, rows: Mapping[str, AnyMuscle], places: Places) -> Floats:
    """Return the distance of every mark that was found from where one-sided `rows` have it, (n,) [mm]."""
    out = [np.zeros(0)]
    for placed in found.placed:
        row = rows.get(placed.name)
        ends = np.stack([placed.insertion, placed.origin])
        if isinstance(row, (LinearMuscle, SheetMuscle)):
            out.append(np.linalg.norm(ends - np.array([row.insertion, row.origin]), axis=1))
            continue
        wanted = places.axis_ends(rows, placed.name)
        if wanted is None:
            out.append(np.full(2, np.inf))
        else:  # the two ends of a ring may come in either order
            ways = [np.linalg.norm(way - wanted, axis=1) for way in (ends, ends[::-1])]
            out.append(min(ways, key=np.sum))
    return np.concatenate(out)


def round_trips(face: Face, size: int = 512) -> list[RoundTrip]:
    """Return the errors of the face's own muscles, drawn in both kinds of picture and read after every treatment."""
    places, rows = Places(face), one_sided(face.muscle_table)
    wanted = {n for n, m in rows.items() if isinstance(m, (LinearMuscle, SheetMuscle))} | set(RINGS)
    out = []
    for kind in ("front", "cylinder"):
        picture, _ = muscle_image(face, face.muscle_table, kind, size, places=places)
        for name, treatment in TREATMENTS.items():
            treated = treatment(picture)
            start = perf_counter()
            found = read_picture_marks(treated, face)
            seconds = perf_counter() - start
            errors = mark_errors(found, rows, places)
            right = len(wanted & {p.name for p in found.placed}) if found.kind == kind else 0
            worst = float(errors.max()) if len(errors) else float("inf")
            middle = float(np.median(errors)) if len(errors) else float("inf")
            out.append(RoundTrip(kind, name, len(wanted), right, len(found.faults), middle, worst, seconds))
    return out
