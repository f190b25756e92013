"""From clicks to muscles: an insertion on the skin and an attachment on bone, or the two ends of a ring's axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from faceanim.face.muscles import AnyMuscle, LinearMuscle, SheetMuscle
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError
from faceanim.studio.muscle_shapes import AXIS, INSERTION, ORIGIN

if TYPE_CHECKING:
    from faceanim.face.muscle_places import Places

LOOK, SKIN, BONE, RING = "look", "insertion", "attachment", "ring"
MODES = {SKIN: "Insertion", BONE: "Attachment", RING: "Ring axis"}
"""What a click places, and the label of its button."""
_HINTS = {
    LOOK: "Choose what to place; drag to turn the head.",
    SKIN: "Click the **skin** where the muscle inserts.",
    BONE: "Click the **bone** where the muscle begins.",
    RING: "Click the **first end** of the ring's axis on the skin: the corner of the mouth, or beside the eye.",
}
_SECOND_END = "Click the **second end** of the axis: above the upper lip, or above the eye."


@dataclass
class Placer:
    """Takes clicks until they make a muscle.

    mode : what the next click places    insertion, origin : (3,) [mm] placed so far, with the origin's bone
    ends : ends of a ring's axis placed so far
    """

    places: Places
    mode: str = LOOK
    insertion: Floats | None = None
    origin: tuple[Floats, str] | None = None
    ends: list[Floats] = field(default_factory=list)

    @property
    def hint(self) -> str:
        """What to do next, in words."""
        return _SECOND_END if self.mode == RING and self.ends else _HINTS[self.mode]

    @property
    def pending(self) -> bool:
        """Whether something is placed that is no muscle yet."""
        return self.insertion is not None or self.origin is not None or bool(self.ends)

    def drop(self) -> None:
        """Forget what is placed so far and begin again."""
        if self.mode == BONE and self.insertion is not None:
            self.mode = SKIN
        self.insertion, self.origin, self.ends = None, None, []

    def choose(self, mode: str) -> None:
        """Place something else with the next click; what is placed so far and fits is kept."""
        self.mode = mode
        if mode == RING:
            self.insertion, self.origin = None, None
        else:
            self.ends = []

    def marks(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the points placed so far, (k, 3) [mm], and their colours (k, 3)."""
        points = [] if self.insertion is None else [(self.insertion, INSERTION)]
        points += [] if self.origin is None else [(self.origin[0], ORIGIN)]
        points += [(end, AXIS) for end in self.ends]
        return (
            np.array([p for p, _ in points], dtype=np.float32).reshape(-1, 3),
            np.array([c for _, c in points], dtype=np.uint8).reshape(-1, 3),
        )

    def click(self, start: Floats, direction: Floats, table: Mapping[str, AnyMuscle]) -> dict[str, AnyMuscle]:
        """Take the ray (3,), (3,) of a click and return the muscles that it completes, empty while more is needed.

        Raises `UserError` if the ray misses what is to be clicked.
        """
        if self.mode == LOOK:
            return {}
        if self.mode == RING:
            return self._ring(start, direction)
        self._end(start, direction)
        if self.insertion is None or self.origin is None:
            self.mode = BONE if self.origin is None else SKIN
            return {}
        insertion, (origin, bone) = self.insertion, self.origin
        name = self.places.name_of(insertion, origin, list(table))
        self.insertion, self.origin, self.mode = None, None, SKIN
        return {name: self.places.muscle(name, insertion, origin, bone)}

    def move(self, start: Floats, direction: Floats, muscle: AnyMuscle) -> dict[str, object]:
        """Return which end of `muscle` goes where the ray of a click points, as `MuscleDocument.move` takes it."""
        if self.mode == RING or not isinstance(muscle, (LinearMuscle, SheetMuscle)):
            raise UserError("a ring cannot be moved by one end; place its axis again with two clicks")
        mode = self.mode
        self._end(start, direction)
        insertion, origin = self.insertion, self.origin
        self.insertion, self.origin = None, None
        if mode == SKIN and insertion is not None:
            return {"insertion": _vec(insertion)}
        assert origin is not None
        return {"origin": _vec(origin[0]), "bone": origin[1]}

    def _end(self, start: Floats, direction: Floats) -> None:
        if self.mode == SKIN:
            self.insertion = _found(self.places.skin_along(start, direction), "skin")
            return
        hit = self.places.bone_along(start, direction)
        if hit is None:
            raise UserError("there is no bone under this click; click the skull or the jaw")
        self.origin = hit

    def _ring(self, start: Floats, direction: Floats) -> dict[str, AnyMuscle]:
        self.ends.append(_found(self.places.ring_layer(start, direction), "skin"))
        if len(self.ends) < 2:
            return {}
        first, second = self.ends
        self.ends = []
        if abs(first[0] - second[0]) < 1.0 or abs(first[1] - second[1]) < 1.0:
            raise UserError(
                "the ends of the axis must differ sideways and in height: one beside, one above the opening"
            )
        return self.places.rings(self.places.ring_name(first, second), first, second)


def _found(point: Floats | None, what: str) -> Floats:
    if point is None:
        raise UserError(f"there is no {what} under this click; click the {what} of the face")
    return point


def _vec(point: Floats) -> tuple[float, float, float]:
    x, y, z = (round(float(v), 3) + 0.0 for v in point)
    return (x, y, z)
