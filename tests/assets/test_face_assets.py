"""Laws of the shipped face: symmetry, topology, closed lips, lids on the eyeballs, agreement of the densities."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

ASSETS = Path(__file__).resolve().parents[2] / "assets"
DENSITIES = ("coarse", "default", "fine")
FLIP = np.array([-1.0, 1.0, 1.0])


@cache
def face(density: str) -> dict[str, np.ndarray]:
    with np.load(ASSETS / f"face_{density}.npz", allow_pickle=False) as data:
        return dict(data)


@cache
def eyes() -> dict[str, np.ndarray]:
    with np.load(ASSETS / "parts.npz", allow_pickle=False) as data:
        return dict(data)


def halfedges(triangles: np.ndarray) -> np.ndarray:
    return np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64)


def lip_heights(face: dict[str, np.ndarray], lip: str, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Lowest (upper lip) or highest (lower lip) y over the grid (x, z), nan where the lip is absent."""
    upper = lip == "lip_upper"
    points, triangles = face["points"], face["triangles"]
    mine = np.zeros(len(points), bool)
    mine[face[lip]] = True
    out = np.full((len(x), len(z)), np.inf if upper else -np.inf)
    for t in triangles[mine[triangles].all(axis=1)]:
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = points[t]
        area = (bx - ax) * (cz - az) - (cx - ax) * (bz - az)
        if abs(area) < 1e-9:
            continue
        i = slice(*np.searchsorted(x, [min(ax, bx, cx), max(ax, bx, cx)]))
        j = slice(*np.searchsorted(z, [min(az, bz, cz), max(az, bz, cz)]))
        u, v = x[i][:, None] - ax, z[j][None, :] - az
        w1, w2 = (u * (cz - az) - (cx - ax) * v) / area, ((bx - ax) * v - u * (bz - az)) / area
        y = np.where((w1 >= 0) & (w2 >= 0) & (w1 + w2 <= 1), ay + w1 * (by - ay) + w2 * (cy - ay), out[i, j])
        out[i, j] = np.minimum(out[i, j], y) if upper else np.maximum(out[i, j], y)
    return np.where(np.isfinite(out), out, np.nan)


@pytest.mark.parametrize("density", DENSITIES)
def test_mirror_symmetry_is_exact(density: str) -> None:
    """Vertices, triangles and regions are their own mirror image, without any rounding."""
    f = face(density)
    mirror = f["mirror"]
    assert np.array_equal(mirror[mirror], np.arange(len(mirror)))
    assert np.array_equal(f["points"][mirror], f["points"] * FLIP + 0.0)
    assert np.array_equal(f["region"][mirror], f["region"])
    ours = {tuple(sorted(t)) for t in f["triangles"].tolist()}
    assert ours == {tuple(sorted(t)) for t in mirror[f["triangles"]].tolist()}


@pytest.mark.parametrize("density", DENSITIES)
def test_surface_is_an_oriented_manifold_with_three_holes(density: str) -> None:
    """Every directed edge occurs once, no vertex is loose, and only the neck and the two eyes are open."""
    f = face(density)
    edges = halfedges(f["triangles"])
    key = edges[:, 0] * len(f["points"]) + edges[:, 1]
    assert len(np.unique(key)) == len(key)
    border = edges[~np.isin(key, edges[:, 1] * len(f["points"]) + edges[:, 0])]
    assert np.array_equal(np.unique(f["triangles"]), np.arange(len(f["points"])))
    assert np.array_equal(np.sort(border[:, 0]), np.sort(border[:, 1])), "border edges form closed loops"
    follow = dict(border.tolist())
    loops = 0
    while follow:
        loops += 1
        at = next(iter(follow))
        while at in follow:
            at = follow.pop(at)
    assert loops == 3
    euler = len(f["points"]) - len(np.unique(np.sort(edges, axis=1), axis=0)) + len(f["triangles"])
    assert euler == 2 - 3


@pytest.mark.parametrize(
    "density, edge, height", [("coarse", 0.25, 0.2), ("default", 0.25, 0.15), ("fine", 0.12, 0.08)]
)
def test_no_triangle_is_degenerate(density: str, edge: float, height: float) -> None:
    """Edges and heights of all triangles stay above a floor, so no spring is nearly without length."""
    f = face(density)
    corner = f["points"][f["triangles"]]
    sides = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2)
    double_area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    assert sides.min() > edge
    assert (double_area / sides.max(axis=1)).min() > height
    assert (sides.max(axis=1) ** 2 / double_area).max() < 25.0


@pytest.mark.parametrize("density", DENSITIES)
def test_lips_meet_along_the_whole_seam_and_do_not_cross(density: str) -> None:
    """Over every place of the seam the upper lip lies above the lower one, and somewhere along its depth they touch."""
    f = face(density)
    x, z = np.arange(-21.0, 21.01, 0.5), np.arange(80.0, 110.0, 0.15)
    gap = lip_heights(f, "lip_upper", x, z) - lip_heights(f, "lip_lower", x, z)
    narrowest = np.nanmin(gap, axis=1)
    slack = {"coarse": 0.12, "default": 0.05, "fine": 0.03}[density]  # straight edges across a curved seam
    assert narrowest.min() > 0.02 - slack
    assert narrowest.max() < 0.5


@pytest.mark.parametrize("density", DENSITIES)
@pytest.mark.parametrize("side", ["left", "right"])
def test_lids_rest_outside_the_eyeball(density: str, side: str) -> None:
    """Every skin vertex is outside both eyeballs, and the inner lid lies 0.1 to 0.4 mm above them."""
    f, e = face(density), eyes()
    centre, radius = e[f"eye_{side}_centre"], float(e[f"eye_{side}_radius"])
    height = np.linalg.norm(f["points"] - centre, axis=1) - radius
    assert height.min() > 0.05
    lists = np.concatenate([f[f"lid_upper_{side}"], f[f"lid_lower_{side}"]])
    inner = lists[height[lists] < 0.4]
    assert len(inner) >= 56


def test_eyes_are_open_and_closed_by_nothing() -> None:
    """The lids stand 8 to 11 mm apart and the eyes look straight ahead, mirror images of each other."""
    f, e = face("default"), eyes()
    mark = dict(zip(f["landmark_names"].tolist(), f["landmark_index"].tolist()))
    opening = f["points"][mark["lid_upper_mid_left"], 1] - f["points"][mark["lid_lower_mid_left"], 1]
    assert 8.0 < opening < 11.0
    assert np.array_equal(e["eye_left_points"] * FLIP, e["eye_right_points"])
    assert np.array_equal(e["eye_left_triangles"][:, ::-1], e["eye_right_triangles"])


@pytest.mark.parametrize("density", ["coarse", "fine"])
def test_densities_are_samples_of_one_surface(density: str) -> None:
    """Landmarks, which every density keeps as vertices, lie within 0.5 mm of each other."""
    a, b = face("default"), face(density)
    assert np.array_equal(a["landmark_names"], b["landmark_names"])
    apart = np.linalg.norm(a["points"][a["landmark_index"]] - b["points"][b["landmark_index"]], axis=1)
    assert apart.max() < 0.5


@pytest.mark.parametrize("density", DENSITIES)
def test_uv_covers_the_picture_without_folds(density: str) -> None:
    """Texture triangles keep the orientation of the surface and stay inside the picture."""
    f = face(density)
    uv = f["uv"].astype(float)
    assert uv.min() >= 0.0 and uv.max() <= 1.0
    a, b, c = (uv[f["uv_triangles"][:, k]] for k in range(3))
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (turn > 0).mean() > 0.999


@pytest.mark.parametrize("density", ["coarse", "default"])
def test_artist_fields_are_symmetric_and_move_what_they_name(density: str) -> None:
    """Displacement fields mirror exactly; a smile lifts the mouth corners, a blink lowers the lids, the jaw drops."""
    f = face(density)
    field = dict(zip(f["artist_names"].tolist(), f["artist"].astype(float)))
    mark = dict(zip(f["landmark_names"].tolist(), f["landmark_index"].tolist()))
    for name, d in field.items():
        assert np.array_equal(d[f["mirror"]], d * FLIP + 0.0), name
    assert field["mouthSmile"][mark["cheilion_left"], 1] > 3.0
    assert field["mouthSmile"][mark["cheilion_left"], 0] > 3.0
    assert field["eyeBlink"][mark["lid_upper_mid_left"], 1] < -5.0
    assert field["jawOpen"][mark["menton"], 1] < -15.0
    assert field["browInnerUp"][mark["glabella"], 1] > 0.5


def test_face_files_are_small_and_listed() -> None:
    """The face's own files stay below 4 MB together, and the README names every file of the folder."""
    own = [ASSETS / f"face_{d}.npz" for d in DENSITIES] + [ASSETS / "parts.npz", ASSETS / "albedo.jpg"]
    assert sum(path.stat().st_size for path in own) < 4 * 2**20
    text = (ASSETS / "README.md").read_text(encoding="utf-8")
    missing = [path.name for path in ASSETS.iterdir() if f"`{path.name}" not in text and path.name != "README.md"]
    assert not missing
