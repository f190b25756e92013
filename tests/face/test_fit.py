"""Laws of the automatic skull fit and of the distances it rests on."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from faceanim.face.fit import (
    affine,
    boundary_loops,
    fit,
    fit_skull,
    outer_surface,
    parse_depths,
    place,
    similarity,
    skin_marks,
    thin_plate,
)
from faceanim.face.library import asset_arrays, asset_text
from faceanim.face.skull import Skull
from faceanim.geometry.distance_field import point_distance, signed_distance_grid
from faceanim.geometry.rays import ray_hit
from faceanim.geometry.surface import TriMesh
from faceanim.ground.errors import AssetError, UserError


def sphere(radius: float = 20.0, steps: int = 24) -> TriMesh:
    """A sphere of rings."""
    a = np.linspace(0.0, np.pi, steps + 1)[1:-1]
    b = 2.0 * np.pi * np.arange(2 * steps) / (2 * steps)
    ring = np.stack(
        [np.sin(a)[:, None] * np.cos(b), np.cos(a)[:, None] * np.ones_like(b), np.sin(a)[:, None] * np.sin(b)], axis=2
    ).reshape(-1, 3)
    points = np.vstack([ring, [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]]) * radius
    n, m, triangles = len(a), len(b), []
    for i in range(n - 1):
        for j in range(m):
            p, q, r, s = i * m + j, i * m + (j + 1) % m, (i + 1) * m + j, (i + 1) * m + (j + 1) % m
            triangles += [(p, q, s), (p, s, r)]
    triangles += [(len(ring), (j + 1) % m, j) for j in range(m)]
    triangles += [(len(ring) + 1, (n - 1) * m + j, (n - 1) * m + (j + 1) % m) for j in range(m)]
    return TriMesh(points, np.array(triangles))


@pytest.fixture(scope="module")
def depths():
    """The built-in depth table."""
    return parse_depths(asset_text("tissue_depth.toml"), "tissue_depth.toml")


@pytest.fixture(scope="module")
def head():
    """The coarse built-in head: its closed outer skin and the landmarks on it."""
    data = asset_arrays("face_coarse.npz")
    skin = outer_surface(TriMesh(data["points"], data["triangles"]), data["region"])
    landmarks = {str(n): data["points"][i] for n, i in zip(data["landmark_names"], data["landmark_index"], strict=True)}
    return skin, landmarks


@pytest.fixture(scope="module")
def generic():
    """The built-in skull."""
    return Skull.from_arrays(asset_arrays("skull.npz"))


def test_sphere_distance_field_has_the_analytic_values():
    """The grid equals |x| - R to the facets' sagitta and the interpolation error, and is symmetric to the last bit."""
    grid = signed_distance_grid([sphere()], spacing=1.0, margin=6.0, band=5.0, symmetric=True)
    rng = np.random.default_rng(0)
    way = rng.normal(size=(400, 3))
    points = way / np.linalg.norm(way, axis=1)[:, None] * rng.uniform(16.0, 24.0, (400, 1))
    assert np.abs(grid.sample(points) - (np.linalg.norm(points, axis=1) - 20.0)).max() < 0.25
    assert np.array_equal(grid.values, grid.values[::-1])


def test_sign_survives_a_hole():
    """Six directions vote on the inside, so a hole of a few triangles does not turn the inside out."""
    whole = sphere()
    torn = TriMesh(whole.points, np.delete(whole.triangles, np.arange(400, 412), axis=0))
    grid = signed_distance_grid([torn], spacing=1.0, margin=4.0, band=3.0)
    deep = np.array([[0.0, 0.0, 0.0], [10.0, 5.0, 0.0], [0.0, 0.0, -16.0], [0.0, -15.0, 2.0]])
    assert (grid.sample(deep) < 0).all()
    assert (grid.sample(deep * [[1, 1, 1]] + [0.0, 0.0, 22.5]) > 0)[0]


def test_point_distance_and_rays_agree_with_the_sphere():
    """Distances to a fine sphere, and rays towards its centre, give | |x| - R | within the sagitta."""
    mesh = sphere(steps=30)
    rng = np.random.default_rng(1)
    way = rng.normal(size=(60, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    points = way * rng.uniform(5.0, 40.0, (60, 1))
    far = np.abs(np.linalg.norm(points, axis=1) - 20.0)
    assert np.abs(point_distance(points, mesh)[0] - far).max() < 0.12
    outside = np.linalg.norm(points, axis=1) > 20.5
    hit = ray_hit(points[outside], -way[outside], mesh, 100.0)
    assert np.abs(hit - far[outside]).max() < 0.12
    assert np.isinf(ray_hit(points[outside], way[outside], mesh, 100.0)).all()


def test_thin_plate_meets_its_pairs_and_keeps_affine_maps():
    """Without slack every pair is met; pairs related by an affine map give that map everywhere."""
    rng = np.random.default_rng(2)
    source = rng.normal(size=(20, 3)) * 50.0
    target = source + rng.normal(size=(20, 3)) * 5.0
    assert np.abs(thin_plate(source, target)(source) - target).max() < 1e-8
    linear, offset = np.eye(3) + 0.2 * rng.normal(size=(3, 3)), rng.normal(size=3) * 30.0
    elsewhere = rng.normal(size=(50, 3)) * 80.0
    moved = thin_plate(source, source @ linear + offset)(elsewhere)
    assert np.abs(moved - (elsewhere @ linear + offset)).max() < 1e-7


def test_affine_stage_recovers_boxes():
    """A head that is the generic one scaled along the axes is met exactly, whatever the weights."""
    rng = np.random.default_rng(3)
    source = rng.normal(size=(30, 3)) * 60.0
    target = source * [1.2, 0.9, 1.05] + [3.0, -7.0, 11.0]
    assert np.abs(affine(source, target, rng.uniform(0.2, 1.0, 30))(source) - target).max() < 1e-9


def test_similarity_recovers_a_rigid_move():
    """Rotation, scale and translation are found from the points they moved."""
    rng = np.random.default_rng(4)
    source = rng.normal(size=(12, 3)) * 10.0
    target = place(source, np.array([20.0, -35.0, 10.0]), np.array([4.0, 5.0, -6.0]), np.full(3, 1.13), np.zeros(3))
    move = similarity(source, target)
    assert abs(move.scale - 1.13) < 1e-12
    assert np.abs(move(source) - target).max() < 1e-10


def test_place_by_hand():
    """The hand's transform leaves `about` on the translation, scales along the axes and turns right-handed."""
    about = np.array([1.0, 2.0, 3.0])
    points = about + np.eye(3)
    out = place(points, np.array([90.0, 0.0, 0.0]), np.zeros(3), np.array([2.0, 3.0, 4.0]), about) - about
    assert np.allclose(out, [[2.0, 0.0, 0.0], [0.0, 0.0, 3.0], [0.0, -4.0, 0.0]])


def test_outer_surface_is_closed(head):
    """The capped skin has every edge as often in one direction as in the other, and no boundary is left."""
    skin, _ = head
    directed = skin.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward, backward = Counter(map(tuple, directed.tolist())), Counter(map(tuple, directed[:, ::-1].tolist()))
    assert forward == backward
    assert boundary_loops(skin.triangles) == []


def test_marks_know_the_face(head, depths):
    """Midline marks look straight back or down in their plane, paired ones are mirror images."""
    skin, landmarks = head
    marks = skin_marks(skin, landmarks, depths)
    index = {n: k for k, n in enumerate(marks.names)}
    for name, k in index.items():
        twin = index[name[:-5] + "_right"] if name.endswith("_left") else k if not name.endswith("_right") else None
        if twin is not None:
            assert np.abs(marks.target[twin] * [-1.0, 1.0, 1.0] - marks.target[k]).max() < 1e-6


def test_too_few_landmarks_are_refused(head, generic, depths):
    """A fit needs eight landmarks; the message says how many there were."""
    skin, landmarks = head
    few = {n: landmarks[n] for n in ("nasion", "menton", "vertex")}
    with pytest.raises(UserError, match="3 landmarks"):
        fit(generic, skin, few, depths)


def test_bad_depth_table_is_refused():
    """A row with an unknown bone, or a text that is not TOML, is named."""
    with pytest.raises(AssetError, match="nasion"):
        parse_depths('[nasion]\ndepth = 6.5\nspread = 1.0\nbone = "horn"\n', "mine.toml")
    with pytest.raises(AssetError, match=r"mine\.toml"):
        parse_depths("[nasion", "mine.toml")


@pytest.mark.slow
@pytest.mark.parametrize("stretch", [(1.0, 1.0, 1.0), (1.12, 0.95, 1.04)])
def test_fit_reaches_the_depths_inside_the_skin(head, generic, depths, stretch):
    """On the built-in head and on a stretched one: no bone outside, 2 mm of tissue, depths within 1 mm RMS."""
    skin, landmarks = head
    scale = np.array(stretch)
    other = TriMesh(skin.points * scale, skin.triangles)
    fitted = fit(generic, other, {n: p * scale for n, p in landmarks.items()}, depths)
    assert fitted.report.outside == 0.0
    assert fitted.report.thinnest > 2.0
    assert fitted.report.final_rms < 1.0
    assert fitted.report.spline_rms < fitted.report.affine_rms


@pytest.mark.slow
def test_fit_skull_keeps_the_bite(head, generic, depths):
    """A skull for another head keeps its teeth undistorted and inside, and its condyles apart."""
    skin, landmarks = head
    mouth = asset_arrays("mouth.npz")
    rows = tuple(TriMesh(mouth[f"teeth_{k}_points"], mouth[f"teeth_{k}_triangles"]) for k in ("upper", "lower"))
    scale = np.array([1.08, 0.97, 1.05])
    other = TriMesh(skin.points * scale, skin.triangles)
    skull, move, report = fit_skull(generic, rows, other, {n: p * scale for n, p in landmarks.items()}, depths)
    assert report.outside == 0.0
    assert np.allclose(move.rotation @ move.rotation.T, np.eye(3))
    assert 0.85 < move.scale < 1.15
    teeth = move(np.vstack([r.points for r in rows]))
    assert (point_distance(teeth, other)[0] > 1.0).all()
    assert skull.condyle_left[0] - skull.condyle_right[0] > 80.0
    gap = np.linalg.norm(skull.incisor_lower - skull.incisor_upper)
    assert abs(gap - move.scale * np.linalg.norm(generic.incisor_lower - generic.incisor_upper)) < 1e-9
