"""The skull: a fixed cranium, a jaw that turns and slides, and what the jaw may do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from faceanim.geometry.distance import DistanceGrid
from faceanim.geometry.distance_field import point_distance, signed_distance_grid
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Floats, floats, ints
from faceanim.ground.errors import AssetError, UserError

GRID_SPACING = 1.75
GRID_MARGIN = 15.0
GRID_BAND = 12.0


@dataclass(frozen=True, eq=False)
class Skull:
    """Cranium and jaw at rest in the head frame [mm].

    cranium, jaw : bone without teeth, closed surfaces
    cranium_grid, jaw_grid : signed distance to bone with its teeth, positive outside, each in the rest frame
    condyle_left, condyle_right : (3,) centres of the jaw's heads, the ends of the opening axis
    incisor_upper, incisor_lower : (3,) tips at the midline
    landmarks : name -> (3,) on the bone, under the skin landmark of that name;  landmark_bone : name -> 0 or 1
    """

    cranium: TriMesh
    jaw: TriMesh
    cranium_grid: DistanceGrid
    jaw_grid: DistanceGrid
    condyle_left: Floats
    condyle_right: Floats
    incisor_upper: Floats
    incisor_lower: Floats
    landmarks: dict[str, Floats] = field(default_factory=dict)
    landmark_bone: dict[str, int] = field(default_factory=dict)

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Skull:
        """Return the skull stored in `skull.npz`; raise `AssetError` naming an array that is missing."""
        try:
            names = [str(n) for n in arrays["landmark_names"]]
            points = floats("skull landmark_points", arrays["landmark_points"], len(names), 3)
            bones = ints("skull landmark_bone", arrays["landmark_bone"], len(names), below=2)
            return cls(
                cranium=_mesh(arrays, "cranium"),
                jaw=_mesh(arrays, "jaw"),
                cranium_grid=_grid(arrays, "cranium"),
                jaw_grid=_grid(arrays, "jaw"),
                condyle_left=floats("skull condyle_left", arrays["condyle_left"], 3),
                condyle_right=floats("skull condyle_right", arrays["condyle_right"], 3),
                incisor_upper=floats("skull incisor_upper", arrays["incisor_upper"], 3),
                incisor_lower=floats("skull incisor_lower", arrays["incisor_lower"], 3),
                landmarks=dict(zip(names, points, strict=True)),
                landmark_bone={n: int(b) for n, b in zip(names, bones, strict=True)},
            )
        except KeyError as error:
            raise AssetError(f"the skull lacks the array {error}; rebuild or reinstall the assets") from error

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of `skull.npz`; grids as float16."""
        names = sorted(self.landmarks)
        out: dict[str, Any] = {
            "condyle_left": self.condyle_left,
            "condyle_right": self.condyle_right,
            "incisor_upper": self.incisor_upper,
            "incisor_lower": self.incisor_lower,
            "landmark_names": np.array(names, dtype="<U32"),
            "landmark_points": np.array([self.landmarks[n] for n in names]).reshape(-1, 3),
            "landmark_bone": np.array([self.landmark_bone[n] for n in names], dtype=np.int32),
        }
        for name, mesh, grid in (
            ("cranium", self.cranium, self.cranium_grid),
            ("jaw", self.jaw, self.jaw_grid),
        ):
            out[f"{name}_points"], out[f"{name}_triangles"] = mesh.points, mesh.triangles
            out[f"{name}_grid"] = grid.values.astype(np.float16)
            out[f"{name}_origin"], out[f"{name}_spacing"] = grid.origin, np.float64(grid.spacing)
        return out

    def depth(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the distance of `points` (n, 3) to the cranium and to the jaw without teeth, 2 x (n,) [mm]."""
        return point_distance(points, self.cranium)[0], point_distance(points, self.jaw)[0]


def _mesh(arrays: dict[str, np.ndarray], name: str) -> TriMesh:
    return TriMesh(arrays[f"{name}_points"], arrays[f"{name}_triangles"])


def _grid(arrays: dict[str, np.ndarray], name: str) -> DistanceGrid:
    values = np.ascontiguousarray(arrays[f"{name}_grid"], dtype=np.float32)
    origin = floats(f"skull {name}_origin", arrays[f"{name}_origin"], 3)
    return DistanceGrid(values, origin, float(arrays[f"{name}_spacing"]))


def bone_grid(bone: TriMesh, teeth: Sequence[TriMesh] = (), *, symmetric: bool = True) -> DistanceGrid:
    """Return the signed distance to a bone with its teeth as the contact needs it."""
    return signed_distance_grid(
        [bone, *teeth], spacing=GRID_SPACING, margin=GRID_MARGIN, band=GRID_BAND, symmetric=symmetric
    )


class JawLaw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How far and along which path the jaw goes; see `assets/jaw.toml` for units and sources.

    max_opening_deg : rotation about the condylar axis at full opening
    slide_forward_mm, slide_down_mm : way of the condyles at full opening
    slide_onset : share of the opening that is almost pure rotation [-]
    max_lateral_deg : turn about Y to either side;   max_protrusion_mm, protrusion_down_mm : way at full protrusion
    """

    max_opening_deg: float
    slide_forward_mm: float
    slide_down_mm: float
    slide_onset: float
    max_lateral_deg: float
    max_protrusion_mm: float
    protrusion_down_mm: float

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if not (math.isfinite(value) and 0.0 <= value <= 60.0):
                raise UserError(f"jaw law: {name} = {value} lies outside 0..60")
        if self.slide_onset >= 1.0:
            raise UserError(f"jaw law: slide_onset = {self.slide_onset} must be below 1")


@dataclass(frozen=True, eq=False)
class JawMotion:
    """The jaw's pose from three controls.

    The jaw turns about the line through the condyles (opening, X), turns about Y through their middle (lateral) and
    moves along Z (protrusion): the three freedoms of Zhang, Prakash & Sung. While it opens, the condyles also slide
    forward and down the articular eminence, as they do in life; rotation alone cannot reach the natural opening.

    condyle_left, condyle_right : (3,) [mm];  law : the limits
    """

    condyle_left: Floats
    condyle_right: Floats
    law: JawLaw

    @classmethod
    def from_assets(cls, arrays: dict[str, np.ndarray], text: str) -> JawMotion:
        """Return the motion for the stored skull and the text of `jaw.toml`; raise `AssetError` if either is broken."""
        try:
            law = msgspec.toml.decode(text, type=JawLaw)
            return cls(
                floats("condyle_left", arrays["condyle_left"], 3),
                floats("condyle_right", arrays["condyle_right"], 3),
                law,
            )
        except (msgspec.DecodeError, KeyError) as error:
            raise AssetError(f"jaw motion: {error}; rebuild or reinstall the assets") from error

    @property
    def centre(self) -> Floats:
        """Middle between the condyles, (3,) [mm]."""
        return np.asarray(0.5 * (self.condyle_left + self.condyle_right), dtype=np.float64)

    def slide(self, opening: float) -> Floats:
        """Return how far the condyles have slid at `opening` [0, 1], (3,) [mm]: rotation first, then the slide."""
        onset = self.law.slide_onset
        share = (math.sqrt((opening - onset) ** 2 + _SOFT**2) - math.hypot(onset, _SOFT) + opening) / (
            math.sqrt((1.0 - onset) ** 2 + _SOFT**2) - math.hypot(onset, _SOFT) + 1.0
        )
        return np.array([0.0, -self.law.slide_down_mm * share, self.law.slide_forward_mm * share])

    def pose(self, opening: float, lateral: float = 0.0, protrusion: float = 0.0) -> Floats:
        """Return the pose (4, 4) that carries the jaw from rest to the given controls.

        opening : [0, 1];  lateral : [-1, 1], positive to the subject's left;  protrusion : [0, 1].
        Raises `UserError` outside those ranges.
        """
        for name, value, low in (
            ("opening", opening, 0.0),
            ("lateral", lateral, -1.0),
            ("protrusion", protrusion, 0.0),
        ):
            if not low <= value <= 1.0:
                raise UserError(f"jaw {name} = {value} lies outside {low:g}..1")
        axis = self.condyle_left - self.condyle_right
        turn = rotation(np.array([0.0, 1.0, 0.0]), math.radians(self.law.max_lateral_deg * lateral))
        turn = turn @ rotation(axis, math.radians(self.law.max_opening_deg * opening))
        way = self.slide(opening)
        way += protrusion * np.array([0.0, -self.law.protrusion_down_mm, self.law.max_protrusion_mm])
        pose = np.eye(4)
        pose[:3, :3] = turn
        pose[:3, 3] = self.centre + way - turn @ self.centre
        return pose


_SOFT = 0.08
"""Width of the change from rotation to slide, as a share of the opening."""


def rotation(axis: Floats, angle: float) -> Floats:
    """Return the rotation (3, 3) by `angle` [rad] about `axis` (3,), right-handed (Rodrigues)."""
    x, y, z = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross))


def incisor_gap(skull: Skull, pose: Floats) -> float:
    """Return the distance between the tips of the upper and lower central incisors at `pose` (4, 4) of the jaw [mm]."""
    moved = pose[:3, :3] @ skull.incisor_lower + pose[:3, 3]
    return float(np.linalg.norm(moved - skull.incisor_upper))
