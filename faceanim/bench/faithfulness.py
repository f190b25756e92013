"""How close synthesized action units come to an artist's shapes and to published movements.

The artist's face units (MakeHuman community, CC0) were modelled on the mesh that the default face comes from, so both
displacement fields live on the same vertices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
