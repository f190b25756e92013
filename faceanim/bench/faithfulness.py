"""How close synthesized action units come to an artist's shapes and to published movements.

The artist's face units (MakeHuman community, CC0) were modelled on the mesh that the default face comes from, so both
displacement fields live on the same vertices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from faceanim.backends import make_solver
from faceanim.body.control import Control
from faceanim.expression.library import load_expression
from faceanim.face.attach import LID, LIP, SKIN
from faceanim.face.face import Face
from faceanim.face.library import asset_arrays
from faceanim.ground.arrays import Bools, Floats

ARTIST_UNITS = {
    "1": "browInnerUp",
    "2": "browOuterUp",
    "4": "browDown",
    "9": "noseSneer",
    "10": "mouthUpperUp",
    "12": "mouthSmile",
    "15": "mouthFrown",
    "16": "mouthLowerDown",
    "17": "mouthShrugLower",
    "20": "mouthStretch",
    "26": "jawOpen",
    "45": "eyeBlink",
}
"""Action unit -> the artist's unit of the same movement."""

MOVING_SHARE = 0.2
"""The moving region: outer skin whose artist displacement exceeds this share of its peak."""


@dataclass(frozen=True)
class FieldMatch:
    """mean_cosine : area-weighted over the moving region [-];  peak, artist_peak : largest displacement there [mm]."""

    action_unit: str
    artist_unit: str
    mean_cosine: float
    peak: float
    artist_peak: float

    @property
    def peak_ratio(self) -> float:
        return self.peak / self.artist_peak


def artist_fields(density: str) -> dict[str, Floats]:
    """Return the artist's displacement fields, name -> (n, 3) [mm], at a density that carries them."""
    data = asset_arrays(f"face_{density}.npz")
    return {str(name): field.astype(np.float64) for name, field in zip(data["artist_names"], data["artist"])}


def moving_region(face: Face, field: Floats) -> Bools:
    """Return the outer skin vertices (n,) that an artist's field moves by more than `MOVING_SHARE` of its peak."""
    outer = np.isin(face.region, (SKIN, LIP, LID))
    size = np.linalg.norm(field, axis=1) * outer
    return size > MOVING_SHARE * size.max()


def match_field(face: Face, unit: str, artist_name: str, displacement: Floats, field: Floats) -> FieldMatch:
    """Compare a synthesized displacement (n, 3) [mm] with the artist's `field` over the artist's moving region."""
    where = moving_region(face, field)
    u, a, area = displacement[where], field[where], face.mesh.vertex_areas[where]
    lengths = np.linalg.norm(u, axis=1) * np.linalg.norm(a, axis=1)
    cosine = np.einsum("ij,ij->i", u, a) / np.maximum(lengths, 1e-9)
    return FieldMatch(
        action_unit=unit,
        artist_unit=artist_name,
        mean_cosine=float((cosine * area).sum() / area.sum()),
        peak=float(np.linalg.norm(u, axis=1).max()),
        artist_peak=float(np.linalg.norm(a, axis=1).max()),
    )


@dataclass(frozen=True)
class Movement:
    """One published movement beside ours: `value` should lie in [low, high], in `unit`."""

    action_unit: str
    what: str
    value: float
    low: float
    high: float
    unit: str = "mm"

    @property
    def inside(self) -> bool:
        return self.low <= self.value <= self.high


class Poser:
    """A face and a solver that answer an action unit with its equilibrium at full intensity."""

    def __init__(self, face: Face, backend: str = "mass_spring", options: Any = None) -> None:
        self.face = face
        self.body = face.body()
        self.solver = make_solver(backend, self.body, options)
        self._known: dict[str, Floats] = {}

    def control(self, formula: str) -> Control:
        """Return the control of an expression or a formula such as "6+12" at full intensity."""
        drive = load_expression(formula).drive(self.body.muscles.names)
        control = Control.rest(self.body)
        control.activation[:] = drive.activation
        control.bone_pose[1] = self.face.jaw.pose(drive.jaw.opening, drive.jaw.lateral, drive.jaw.protrusion)
        return control

    def points(self, formula: str) -> Floats:
        """Return the equilibrium surface (n, 3) [mm] of an expression or formula; solved once, then remembered."""
        if formula not in self._known:
            out = np.empty_like(self.body.surface.points)
            self.solver.surface(self.solver.solve_static(self.control(formula)), out)
            self._known[formula] = out
        return self._known[formula]

    def displacement(self, formula: str) -> Floats:
        """Return the equilibrium displacement (n, 3) [mm]."""
        return self.points(formula) - self.body.surface.points


def artist_matches(poser: Poser) -> Iterator[FieldMatch]:
    """Yield the comparison with the artist for every action unit of `ARTIST_UNITS`."""
    fields = artist_fields(poser.face.density)
    for unit, artist in ARTIST_UNITS.items():
        yield match_field(poser.face, unit, artist, poser.displacement(unit), fields[artist])


def mouth_width(face: Face, points: Floats) -> float:
    """Return the distance between the mouth corners [mm]."""
    corners = points[[face.landmarks["cheilion_left"], face.landmarks["cheilion_right"]]]
    return float(np.linalg.norm(corners[0] - corners[1]))


def lid_aperture(face: Face, points: Floats) -> float:
    """Return the widest vertical opening between upper and lower lid margins, both eyes [mm]."""
    widest = 0.0
    for lids in face.lids.values():
        lower = points[lids.lower_margin]
        order = np.argsort(lower[:, 0])
        upper = points[lids.upper_margin]
        opening = upper[:, 1] - np.interp(upper[:, 0], lower[order, 0], lower[order, 1])
        widest = max(widest, float(opening.max()))
    return widest


def eyeball_clearance(face: Face, points: Floats) -> float:
    """Return the smallest distance of any skin vertex from the eyeballs, negative inside [mm]."""
    return min(float(np.linalg.norm(points - e.centre, axis=1).min()) - e.radius for e in face.eyes.values())


def _largest(poser: Poser, unit: str) -> float:
    outer = np.isin(poser.face.region, (SKIN, LIP, LID))
    return float(np.linalg.norm(poser.displacement(unit)[outer], axis=1).max())


def _corner(poser: Poser, unit: str) -> Floats:
    return poser.displacement(unit)[poser.face.landmarks["cheilion_left"]]


def _width_change(poser: Poser, unit: str) -> float:
    face = poser.face
    return 100.0 * (mouth_width(face, poser.points(unit)) / mouth_width(face, face.mesh.points) - 1.0)


def _incisors(poser: Poser) -> tuple[float, float, float]:
    """Opening between the incisors [mm], rotation [deg] and condylar slide [mm] at action unit 27."""
    pose, skull = poser.control("27").bone_pose[1], poser.face.skull

    def moved(p: Floats) -> Floats:
        return pose[:3, :3] @ p + pose[:3, 3]

    angle = float(np.rad2deg(np.arccos(np.clip((np.trace(pose[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))))
    opening = float(np.linalg.norm(moved(skull.incisor_lower) - skull.incisor_upper))
    slide = float(np.linalg.norm(moved(skull.condyle_left) - skull.condyle_left))
    return opening, angle, slide


_MEASURES: tuple[tuple[str, str, Callable[[Poser], float], float, float, str], ...] = (
    ("12", "mouth corner movement", lambda p: float(np.linalg.norm(_corner(p, "12"))), 11.0, 16.0, "mm"),
    ("12", "mouth corner outward", lambda p: float(_corner(p, "12")[0]), 0.0, 16.0, "mm"),
    ("12", "mouth corner up", lambda p: float(_corner(p, "12")[1]), 0.0, 16.0, "mm"),
    ("12", "mouth corner back", lambda p: -float(_corner(p, "12")[2]), 0.0, 16.0, "mm"),
    ("12", "mouth width change", lambda p: _width_change(p, "12"), 20.0, 35.0, "%"),
    ("1", "inner brow raise", lambda p: _largest(p, "1"), 5.0, 10.0, "mm"),
    ("2", "outer brow raise", lambda p: _largest(p, "2"), 5.0, 10.0, "mm"),
    ("4", "brow lowering", lambda p: _largest(p, "4"), 5.0, 8.0, "mm"),
    ("15", "mouth corner depression", lambda p: float(np.linalg.norm(_corner(p, "15"))), 4.0, 7.0, "mm"),
    ("9", "nose wrinkling", lambda p: _largest(p, "9"), 6.0, 10.0, "mm"),
    ("45", "lid aperture in a blink", lambda p: lid_aperture(p.face, p.points("45")), -0.5, 1.5, "mm"),
    ("45", "lid clearance from the eyeball", lambda p: eyeball_clearance(p.face, p.points("45")), 0.0, 1.0, "mm"),
    ("27", "opening between incisors", lambda p: _incisors(p)[0], 40.0, 47.0, "mm"),
    ("27", "jaw rotation", lambda p: _incisors(p)[1], 25.0, 39.0, "deg"),
    ("27", "condylar slide", lambda p: _incisors(p)[2], 12.0, 20.0, "mm"),
    ("18", "pucker: mouth width change", lambda p: _width_change(p, "18"), -45.0, -25.0, "%"),
    ("22", "funnel: mouth width change", lambda p: _width_change(p, "22"), -45.0, -25.0, "%"),
)


def movements(poser: Poser) -> Iterator[Movement]:
    """Yield every published movement with ours beside it."""
    for unit, what, measure, low, high, name in _MEASURES:
        yield Movement(unit, what, measure(poser), low, high, name)
