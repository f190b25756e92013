"""How far two skins are apart: signed distances from point to surface, and what they amount to in each region."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from faceanim.face.attach import LID, LIP, NECK, SKIN
from faceanim.geometry.distance_field import point_distance
from faceanim.geometry.rays import barycentric
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Bools, Floats, Ints, floats
from faceanim.ground.errors import UserError

if TYPE_CHECKING:
    from faceanim.face.face import Face

FACING = 0.2
"""A point belongs to triangles whose normal makes at least this cosine with its own: lips do not measure each other."""
_TRIED = 128
MOVED = 1.0
"""Skin that has gone farther than this counts as moved [mm]."""
REGIONS = ("lips", "nose", "chin", "cheeks", "forehead", "eyes", "neck")


def signed_distance(points: Any, surface: TriMesh, normals: Any = None) -> Floats:
    """Return the distance of `points` (n, 3) to a surface, (n,) [mm]: positive in front of it (where its normals point).

    normals : (n, 3) of the points; each then looks for the nearest place that faces the same way, if there is one
    """
    points = floats("points", points, None, 3)
    distance, triangle = point_distance(points, surface)
    if normals is not None:
        normals = floats("normals", normals, len(points), 3)
        _face_the_same_way(points, normals, surface, triangle)
    at = nearest_on(points, surface.points[surface.triangles[triangle]])
    weight = barycentric(surface.points[surface.triangles[triangle]], at)
    normal = np.einsum("na,nai->ni", np.clip(weight, 0.0, 1.0), surface.vertex_normals[surface.triangles[triangle]])
    away = points - at
    distance = np.linalg.norm(away, axis=1)
    return np.where((away * normal).sum(axis=1) < 0.0, -distance, distance)


def _face_the_same_way(points: Floats, normals: Floats, surface: TriMesh, triangle: Ints) -> None:
    """Replace in `triangle` (n,) those that face away from their point by the nearest that does not.

    The triangles with the nearest centres are tried first; all of them, where a farther one might be nearer.
    """
    unit = surface.normals_by_area / np.maximum(surface.areas, 1e-30)[:, None]
    wrong = np.flatnonzero((normals * unit[triangle]).sum(axis=1) < FACING)
    if not len(wrong):
        return
    corners = surface.points[surface.triangles]
    centre = corners.mean(axis=1)
    radius = float(np.linalg.norm(corners - centre[:, None], axis=2).max())
    some = min(_TRIED, len(centre))
    reach, tried = cKDTree(centre).query(points[wrong], k=range(1, some + 1))
    there = nearest_on(np.repeat(points[wrong], some, axis=0), corners[tried.ravel()]).reshape(len(wrong), some, 3)
    away = np.linalg.norm(there - points[wrong][:, None], axis=2)
    away[np.einsum("ni,nki->nk", normals[wrong], unit[tried]) < FACING] = np.inf
    best = np.argmin(away, axis=1)
    found = away[np.arange(len(wrong)), best]
    sure = (found <= reach[:, -1] - radius) | ((some == len(centre)) & np.isfinite(found))
    triangle[wrong[sure]] = tried[np.arange(len(wrong)), best][sure]
    for i in wrong[~sure]:
        allowed = np.flatnonzero(unit @ normals[i] >= FACING)
        if len(allowed):
            at = nearest_on(np.broadcast_to(points[i], (len(allowed), 3)), corners[allowed])
            triangle[i] = allowed[np.argmin(((at - points[i]) ** 2).sum(axis=1))]


def nearest_on(points: Floats, corners: Floats) -> Floats:
    """Return the point of each triangle (n, 3, 3) that is nearest to its point (n, 3), (n, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    squared = np.maximum((normal * normal).sum(axis=1), 1e-300)
    out = points - (((points - a) * normal).sum(axis=1) / squared)[:, None] * normal
    inside = np.ones(len(points), dtype=bool)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(q - p, points - p) * normal).sum(axis=1) >= 0.0
    best = np.where(inside, -1.0, np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        side = q - p
        share = ((points - p) * side).sum(axis=1) / np.maximum((side * side).sum(axis=1), 1e-300)
        there = p + np.clip(share, 0.0, 1.0)[:, None] * side
        away = ((points - there) ** 2).sum(axis=1)
        nearer = away < best
        out[nearer], best[nearer] = there[nearer], away[nearer]
    return np.asarray(out)


def compare(predicted: TriMesh, reference: TriMesh) -> Floats:
    """Return how far each vertex of `predicted` lies in front of `reference`, (n,) [mm]; negative = behind it.

    The triangulations need not be alike. After a skin before its operation as `reference`: the movement map.
    """
    return signed_distance(predicted.points, reference, predicted.vertex_normals)


@dataclass(frozen=True)
class Statistics:
    """Distances in figures [mm, %], each vertex counted by its area.

    vertices, area [cm^2] : what was measured   mean, median, p90, p95, max : of absolute values
    signed_mean : positive = in front   within_1_5, within_2 : share of absolute values below 1.5 and 2 mm [%]
    """

    vertices: int
    area: float
    mean: float
    signed_mean: float
    median: float
    p90: float
    p95: float
    max: float
    within_1_5: float
    within_2: float


def statistics(distance: Any, area: Any) -> Statistics:
    """Return the figures of signed distances (n,) [mm] over vertices of `area` (n,) [mm^2]; all NaN if there are none.

    Raises `UserError` for distances that are not finite.
    """
    distance, area = floats("distance", distance, None), floats("area", area, len(distance))
    if not (np.isfinite(distance).all() and (area >= 0.0).all()):
        raise UserError("statistics: distances must be finite and areas positive")
    size = np.abs(distance)
    total = float(area.sum())
    if not total > 0.0:
        return Statistics(len(distance), 0.0, *([float("nan")] * 8))
    median, p90, p95 = quantiles(size, area, (0.5, 0.9, 0.95))
    return Statistics(
        vertices=len(distance),
        area=total / 100.0,
        mean=float(area @ size) / total,
        signed_mean=float(area @ distance) / total,
        median=median,
        p90=p90,
        p95=p95,
        max=float(size.max()),
        within_1_5=100.0 * float(area[size < 1.5].sum()) / total,
        within_2=100.0 * float(area[size < 2.0].sum()) / total,
    )


def quantiles(values: Floats, weight: Floats, shares: tuple[float, ...]) -> tuple[float, ...]:
    """Return the values below which each of the `shares` of the weight lies."""
    order = np.argsort(values, kind="stable")
    climbed = np.cumsum(weight[order])
    middle = (climbed - 0.5 * weight[order]) / climbed[-1]
    return tuple(float(v) for v in np.interp(shares, middle, values[order]))


def face_regions(face: Face) -> dict[str, Bools]:
    """Return which skin belongs to each of `REGIONS`, and to "face" (all but eyes and neck), name -> (n,).

    Lips, eyes and neck are those of the face file; landmarks bound the others. Skin inside the mouth, scalp and ears
    belong to none. No vertex is in two regions.
    """
    p, code = face.mesh.points, face.region
    mark = {name: p[i] for name, i in face.landmarks.items()}
    x, y, z = np.abs(p[:, 0]), p[:, 1], p[:, 2]
    skin = (code == SKIN) & (z > mark["zygion_left"][2])
    brow, lower = mark["mid_supraorbital_left"], mark["mid_infraorbital_left"]
    wing = 1.15 * abs(mark["alare_left"][0])
    out = {"neck": code == NECK, "lips": code == LIP}
    corner = abs(mark["cheilion_left"][0])
    around = (y < mark["subnasale"][1]) & (y > mark["mentolabial"][1]) & (x < 1.1 * corner)
    out["lips"] = out["lips"] | (skin & around)
    taper = np.clip((y - mark["subnasale"][1]) / (mark["nasion"][1] - mark["subnasale"][1]), 0.0, 1.0)
    out["nose"] = skin & (y >= mark["subnasale"][1]) & (y < mark["nasion"][1]) & (x < wing * (1.0 - 0.55 * taper))
    orbit = abs(mark["lateral_orbit_left"][0])
    out["eyes"] = (code == LID) | (skin & ~out["nose"] & (y > lower[1]) & (y < brow[1]) & (x < orbit))
    out["chin"] = skin & (y <= mark["mentolabial"][1]) & (x < 1.1 * corner)
    out["forehead"] = skin & (y >= brow[1])
    taken = np.any(list(out.values()), axis=0)
    out["cheeks"] = skin & ~taken
    out["forehead"] = out["forehead"] & ~out["eyes"]
    whole = np.any([out[name] for name in ("lips", "nose", "chin", "cheeks", "forehead")], axis=0)
    return {"face": whole, **{name: out[name] for name in REGIONS}}


def table(
    distance: Floats, surface: TriMesh, regions: Mapping[str, Bools], moved: Bools | None = None
) -> dict[str, Statistics]:
    """Return the figures of every region, and with `moved` (n,) those of what has moved in each ("moved", "lips, moved").

    distance : (n,) [mm] at the vertices of `surface`
    """
    area = surface.vertex_areas
    out = {}
    for name, mask in regions.items():
        out[name] = statistics(distance[mask], area[mask])
        if moved is not None:
            both = mask & moved
            out[f"{name}, moved"] = statistics(distance[both], area[both])
    return out


def csv_text(rows: Mapping[str, Statistics]) -> str:
    """Return the figures as comma-separated values, one region a line; nothing where there is nothing to measure."""
    names = list(Statistics.__dataclass_fields__)
    lines = ["region," + ",".join(_COLUMNS.get(name, name) for name in names)]
    for region, row in rows.items():
        values = [asdict(row)[name] for name in names]
        lines.append(f'"{region}",' + ",".join("" if v != v else f"{v:.6g}" for v in values))
    return "\n".join(lines) + "\n"


_COLUMNS = {
    "area": "area_cm2",
    "mean": "mean_abs_mm",
    "signed_mean": "signed_mean_mm",
    "median": "median_abs_mm",
    "p90": "p90_abs_mm",
    "p95": "p95_abs_mm",
    "max": "max_abs_mm",
    "within_1_5": "below_1.5mm_percent",
    "within_2": "below_2mm_percent",
}
