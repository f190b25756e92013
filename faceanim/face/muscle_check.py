"""What is wrong with a muscle image or a list of muscles, and where."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from faceanim.face.muscle_image import Fault, MuscleMap, read_picture_marks
from faceanim.face.muscle_places import PAPER_MUSCLES, RINGS, Places, tallest_ring
from faceanim.face.muscles import AnyMuscle, LinearMuscle, SheetMuscle, build_muscles, one_sided
from faceanim.geometry.distance_field import point_distance
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import AssetError

if TYPE_CHECKING:
    from faceanim.face.face import Face

OFF_SKIN, OFF_BONE = 2.0, 2.5
"""How far an insertion may lie from the skin and an origin from its bone [mm], in a head of the usual size."""


def check_picture(picture: np.ndarray, face: Face, kind: str = "auto", *, places: Places | None = None) -> list[Fault]:
    """Return what is wrong with a muscle image (h, w, 3) RGB bytes on `face`, errors first; an empty list if nothing."""
    return picture_faults(read_picture_marks(picture, face, kind, places=places))


def picture_faults(found: MuscleMap) -> list[Fault]:
    """Return what is wrong with a picture that has been read, errors first."""
    if not found.placed and not found.faults:
        return [Fault("nothing-found", "there are no marks in the picture: no red, green or blue disc, no white line")]
    return _sorted([*found.faults, *_missing(found.table)])


def check_table(table: Mapping[str, AnyMuscle], face: Face, *, places: Places | None = None) -> list[Fault]:
    """Return what is wrong with a list of muscles on `face`, errors first; an empty list if nothing."""
    places = Places(face) if places is None else places
    rows = one_sided(table)
    linear = {n: m for n, m in rows.items() if isinstance(m, (LinearMuscle, SheetMuscle))}
    faults: list[Fault] = []
    if linear:
        faults += _off_layers(linear, face, places)
    for name, row in rows.items():
        try:
            build_muscles({name: row}, face.terrain)
        except AssetError as error:
            faults.append(Fault("no-skin", str(error), "error", None, name))
    return _sorted([*faults, *_missing(rows)])


def _off_layers(linear: Mapping[str, LinearMuscle | SheetMuscle], face: Face, places: Places) -> list[Fault]:
    """Insertions off the skin, origins off the bone that carries them."""
    insertion = np.array([m.insertion for m in linear.values()])
    origin = np.array([m.origin for m in linear.values()])
    skin = point_distance(insertion, face.mesh)[0] / places.scale
    bones = {"cranium": point_distance(origin, face.cranium)[0], "jaw": point_distance(origin, face.jaw_mesh)[0]}
    faults: list[Fault] = []
    for k, (name, m) in enumerate(linear.items()):
        if skin[k] > OFF_SKIN:
            message = f"the insertion of {name} lies {skin[k]:.1f} mm off the skin; insertions lie in the skin"
            faults.append(Fault("insertion-off-skin", message, "error", None, name))
        own = bones[m.bone][k] / places.scale
        other = "jaw" if m.bone == "cranium" else "cranium"
        if own > OFF_BONE and not places.fascia(name):
            if bones[other][k] / places.scale <= OFF_BONE:
                message = (
                    f'the origin of {name} lies on the {other} but is carried by the {m.bone}; set bone = "{other}"'
                )
                faults.append(Fault("wrong-layer", message, "error", None, name))
            else:
                message = f"the origin of {name} floats {own:.1f} mm off the {m.bone}; move it onto the bone"
                faults.append(Fault("floating-origin", message, "error", None, name))
    return faults


def _missing(table: Mapping[str, AnyMuscle]) -> list[Fault]:
    """Muscles of the 23 that are not there."""
    wanted = [f"{name}_{side}" for name in PAPER_MUSCLES for side in ("left", "right")]
    absent = [name for name in wanted if name not in table]
    absent += [ring for ring in RINGS if tallest_ring(table, ring) is None]
    return [Fault("missing", f"{n} is missing; it is one of the 23 muscles", "warning", None, n) for n in absent]


def _sorted(faults: list[Fault]) -> list[Fault]:
    return sorted(faults, key=lambda fault: fault.severity != "error")


def distances(points: Floats, face: Face) -> tuple[Floats, Floats]:
    """Return the distance of `points` (n, 3) to the skin and to the nearest bone, 2 x (n,) [mm]."""
    bone = np.minimum(point_distance(points, face.cranium)[0], point_distance(points, face.jaw_mesh)[0])
    return point_distance(points, face.mesh)[0], bone
