"""Build the skull: repair the generic bones, fit them into the face, measure the depths, write skull.npz and mouth.npz.

Source: OpenSim geometry `hat_skull.stl` and `hat_jaw.stl` as shipped by the package myo-sim 0.2.4.
"""

from __future__ import annotations

import struct
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from assets_mouth import Piece, build_mouth, plan_bite, shape_alveolus
from assets_source import Package
from remesh import decimate, drop_specks, half_surface, mirrored
from scipy.ndimage import gaussian_filter

sys.path.insert(0, str(Path(__file__).parent.parent))

from faceanim.face.fit import (
    Depth,
    Fit,
    FitReport,
    fit,
    head_grid,
    mark_depths,
    outer_surface,
    parse_depths,
    report_fit,
)
from faceanim.face.skull import Skull, bone_grid
from faceanim.geometry.distance import DistanceGrid
from faceanim.geometry.distance_field import signed_distance_grid
from faceanim.geometry.rays import ray_hit
from faceanim.geometry.surface import TriMesh

MESHES = "models/meshes"
SPACING = 1.1  # mm, of the grid on which the bones are repaired
BAND = 5.0  # mm
FATTEN = 0.5  # mm, given back to thin bone that the smoothing wears off
HALF_VERTICES = {"cranium": 2200, "jaw": 800}

# Landmarks on the generic bone, in the head frame of the source [mm]: midline ones as (y, z), paired ones as the line
# (x, y, z) with one coordinate left open, found by a ray from outside along that axis.
MIDLINE = {
    "vertex": (650.5, -5.0), "opisthocranion": (562.0, -81.0), "supraglabella": (601.0, 78.5),
    "glabella": (579.0, 82.5), "nasion": (565.0, 79.5), "mid_nasal": (556.0, 84.0), "rhinion": (549.0, 87.0),
    "subnasale": (514.0, 84.0), "mid_philtrum": (506.0, 83.0), "labrale_superius": (500.5, 84.0),
    "labrale_inferius": (485.0, 77.0), "mentolabial": (476.5, 72.0), "pogonion": (466.0, 74.0),
    "gnathion": (460.0, 72.0), "menton": (457.7, 68.5),
}  # fmt: skip
PAIRED = {
    "mid_supraorbital": (28.0, 577.0, None), "mid_infraorbital": (27.0, 539.0, None), "alare": (13.5, 527.0, None),
    "malar": (48.0, 529.0, None), "lateral_orbit": (50.0, 556.0, None), "frontotemporale": (48.0, 588.0, None),
    "supra_canine": (19.0, 504.0, None), "infra_canine": (17.0, 478.0, None), "zygion": (None, 533.0, 27.0),
    "supra_m2": (None, 503.0, 50.0), "infra_m2": (None, 484.0, 48.0), "mid_ramus": (None, 507.0, 25.0),
    "gonion": (None, 489.0, 17.0), "mid_mandibular_border": (None, 469.0, 47.0), "euryon": (None, 596.0, -5.0),
}  # fmt: skip
ON_JAW = {
    "labrale_inferius", "mentolabial", "pogonion", "gnathion", "menton", "infra_canine", "infra_m2", "mid_ramus",
    "gonion", "mid_mandibular_border",
}  # fmt: skip
CONDYLE = (47.0, 529.0, 14.0)


@dataclass(frozen=True)
class Generic:
    """The repaired generic skull and the mirror index of its vertices."""

    skull: Skull
    mirror: dict[str, np.ndarray]


def read_stl(data: bytes) -> TriMesh:
    """Return a binary STL in metres, x front, y up, z right, as a mesh in mm in the head frame, points welded."""
    count = struct.unpack_from("<I", data, 80)[0]
    record = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("spare", "<u2")])
    corners = np.frombuffer(data, record, count, 84)["corner"].astype(np.float64).reshape(-1, 3) * 1000.0
    points, packed = np.unique(np.round(corners[:, [2, 1, 0]] * [-1.0, 1.0, 1.0], 4), axis=0, return_inverse=True)
    triangles = packed.reshape(-1, 3)
    proper = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return TriMesh(points, triangles[proper].astype(np.int32))


def generic_skull(source: Path) -> Generic:
    """Return the generic skull: repaired, without teeth, mirror symmetric, with landmarks and condyles."""
    package = Package(source, "myo_sim")
    bones, mirrors = {}, {}
    for name, file in (("cranium", "hat_skull.stl"), ("jaw", "hat_jaw.stl")):
        bones[name], mirrors[name] = repair(read_stl(package.read(f"{MESHES}/{file}")), name)
    landmarks, bone_of = bone_landmarks(bones["cranium"], bones["jaw"])
    right = np.array(CONDYLE) * [-1.0, 1.0, 1.0]
    nothing = DistanceGrid(np.ones((2, 2, 2), np.float32), np.zeros(3), 1.0)
    skull = Skull(
        bones["cranium"], bones["jaw"], nothing, nothing, np.array(CONDYLE), right, np.zeros(3), np.zeros(3),
        landmarks, bone_of,
    )  # fmt: skip
    return Generic(skull, mirrors)


def repair(raw: TriMesh, name: str) -> tuple[TriMesh, np.ndarray]:
    """Return a bone as one closed, mirror symmetric surface without teeth, and its mirror index.

    The bone is turned into a signed distance, cut, smoothed and turned back into triangles.
    """
    grid = signed_distance_grid([raw], spacing=SPACING, margin=7.0, band=BAND, symmetric=True, even=True)
    values = grid.values.astype(np.float64)
    x, y, z = (
        (grid.origin[k] + SPACING * np.arange(values.shape[k])).reshape([-1 if k == j else 1 for j in range(3)])
        for k in range(3)
    )
    if name == "cranium":
        teeth = (499.5 + (83.0 - z) * 0.1) - y
        values = np.where(z > 33.0, np.maximum(values, teeth), values)
        styloid = np.minimum(np.minimum(526.0 - y, z + 3.0), 30.0 - z)
        values = np.maximum(values, styloid)
    else:
        teeth = y - (487.0 + (79.0 - z) * 0.13)
        values = np.where((z > 44.0) | ((z > 27.0) & (np.abs(x) < 34.0)), np.maximum(values, teeth), values)
    values = gaussian_filter(values - FATTEN, 0.8)
    values = 0.5 * (values + values[::-1])
    points, triangles = drop_specks(*half_surface(values, grid.origin, SPACING), smallest=400)
    front = (points[:, 2] > 25.0) & (points[:, 1] < 600.0)
    weight = np.where(front, 1.0, 0.25) if name == "cranium" else np.ones(len(points))
    points, triangles, mirror = mirrored(*decimate(points, triangles, HALF_VERTICES[name], weight))
    return TriMesh(points, triangles.astype(np.int32)), mirror


def bone_landmarks(cranium: TriMesh, jaw: TriMesh) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Return the landmarks on the generic bone, name -> (3,), and the bone of each."""
    points = {name: np.array([0.0, *yz]) for name, yz in MIDLINE.items()}
    for name, line in PAIRED.items():
        axis = line.index(None)
        start = np.array([[200.0 if c is None else c for c in line]])
        way = -np.eye(3)[axis][None]
        hit = ray_hit(start, way, jaw if name in ON_JAW else cranium, 400.0)
        left = (start + hit[:, None] * way)[0]
        if not np.isfinite(left).all():
            raise ValueError(f"the ray for the landmark {name} misses the generic bone")
        points[f"{name}_left"], points[f"{name}_right"] = left, left * [-1.0, 1.0, 1.0]
    bone = {n: int(n.removesuffix("_left").removesuffix("_right") in ON_JAW) for n in points}
    return points, bone


def fit_to_face(generic: Generic, face: dict[str, np.ndarray], table: dict[str, Depth]) -> tuple[Fit, TriMesh]:
    """Return the generic skull fitted into a face file's head, exactly mirror symmetric, and the head's outer skin."""
    head = outer_surface(TriMesh(face["points"], face["triangles"]), face["region"])
    landmarks = {str(n): face["points"][i] for n, i in zip(face["landmark_names"], face["landmark_index"], strict=True)}
    return fit(generic.skull, head, landmarks, table), head


def symmetric(mesh: TriMesh, mirror: np.ndarray) -> TriMesh:
    """Return the mesh averaged with its mirror image; exact to the last bit."""
    points = mesh.points.copy()
    points = 0.5 * (points + points[mirror] * [-1.0, 1.0, 1.0])
    left = points[:, 0] >= 0.0
    points[mirror[left]] = points[left] * [-1.0, 1.0, 1.0]
    points[mirror == np.arange(len(points)), 0] = 0.0
    return TriMesh(points, mesh.triangles)


def build(faces_dir: Path, source_dir: Path, out_dir: Path) -> None:
    """Fit the skull to `faces_dir`/face_default.npz, write skull.npz and mouth.npz, fill in the depths of all faces."""
    table = parse_depths((out_dir / "tissue_depth.toml").read_text(encoding="utf-8"), "tissue_depth.toml")
    face = dict(np.load(faces_dir / "face_default.npz", allow_pickle=False))
    generic = generic_skull(source_dir)
    fitted, head = fit_to_face(generic, face, table)
    plan = plan_bite(face)
    cranium, jaw = (
        symmetric(TriMesh(shape_alveolus(bone.points, plan, upper), bone.triangles), generic.mirror[name])
        for name, bone, upper in (("cranium", fitted.cranium, True), ("jaw", fitted.jaw, False))
    )
    fitted = replace(fitted, cranium=cranium, jaw=jaw)
    print("skull fit:", final_report(fitted, head))
    mouth, tips = build_mouth(plan)
    condyle = fitted.warp(np.array([CONDYLE]))[0]
    skull = Skull(
        cranium,
        jaw,
        bone_grid(cranium, _single_teeth(mouth["teeth_upper"])),
        bone_grid(jaw, _single_teeth(mouth["teeth_lower"])),
        condyle,
        condyle * [-1.0, 1.0, 1.0],
        tips[0],
        tips[1],
        {n: _snap(fitted, n) for n in fitted.marks.names},
        generic.skull.landmark_bone,
    )
    np.savez_compressed(out_dir / "skull.npz", **skull.to_arrays())
    np.savez_compressed(out_dir / "mouth.npz", **{k: v for p in mouth.values() for k, v in p.arrays().items()})
    for density in ("coarse", "default", "fine"):
        write_depths(faces_dir / f"face_{density}.npz", out_dir / f"face_{density}.npz", skull)


def final_report(fitted: Fit, head: TriMesh) -> FitReport:
    """The report of the bones as they are now, after symmetry and the trimming of the tooth-bearing rims."""
    stages = fitted.report.affine_rms, fitted.report.spline_rms
    return report_fit(fitted.marks, fitted.cranium, fitted.jaw, head, head_grid(head), *stages)


def _single_teeth(row: Piece) -> list[TriMesh]:
    """The row of teeth as one closed mesh (disjoint parts: their winding numbers add up)."""
    return [TriMesh(row.points, row.triangles)]


def _snap(fitted: Fit, name: str) -> np.ndarray:
    """Where the fitted bone meets the ray of a landmark, (3,)."""
    ends = mark_depths(fitted.marks, fitted.cranium, fitted.jaw)[1]
    index = fitted.marks.names
    point = ends[index.index(name)]
    if name.endswith("_right"):
        point = ends[index.index(name.removesuffix("_right") + "_left")] * [-1.0, 1.0, 1.0]
    elif not name.endswith("_left"):
        point = point * [0.0, 1.0, 1.0]
    return np.asarray(point)


def write_depths(source: Path, target: Path, skull: Skull) -> None:
    """Rewrite a face file with the distances of its vertices to bone, exactly mirror symmetric."""
    face = dict(np.load(source, allow_pickle=False))
    cranium, jaw = skull.depth(np.ascontiguousarray(face["points"]))
    mirror = face["mirror"]
    cranium, jaw = (0.5 * (d + d[mirror]) for d in (cranium, jaw))
    face["depth_cranium"], face["depth_jaw"] = cranium.astype(np.float32), jaw.astype(np.float32)
    face["depth"] = np.minimum(cranium, jaw).astype(np.float32)
    np.savez_compressed(target, **face)
