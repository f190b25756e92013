"""Signed distances between skins, and their figures."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest
import trimesh

from faceanim.face.library import load_face
from faceanim.geometry.surface import TriMesh
from faceanim.ground.errors import UserError
from faceanim.surgery.distance_map import (
    FACING,
    compare,
    csv_text,
    face_regions,
    nearest_on,
    quantiles,
    signed_distance,
    statistics,
    table,
)


def _ball(radius: float, subdivisions: int = 4) -> TriMesh:
    made = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return TriMesh(made.vertices, made.faces.astype(np.int32))


def test_the_nearest_point_of_a_triangle() -> None:
    """As trimesh finds it, for points anywhere."""
    rng = np.random.default_rng(3)
    corners, points = rng.normal(size=(400, 3, 3)), 2.0 * rng.normal(size=(400, 3))
    wanted = trimesh.triangles.closest_point(corners, points)
    np.testing.assert_allclose(nearest_on(points, corners), wanted, atol=1e-9)


def test_balls_of_two_sizes_on_two_triangulations() -> None:
    """The larger lies in front by the difference of radii, the smaller behind; the triangulation costs little."""
    small, large = _ball(50.0), _ball(52.0, 3)
    assert np.abs(compare(large, small) - 2.0).max() < 0.06
    assert np.abs(compare(small, large) + 2.0).max() < 0.30  # flat triangles of 8 mm lie 0.2 mm inside their ball
    assert np.abs(compare(small, small)).max() < 1e-9


def test_sheets_that_face_each_other_do_not_measure_each_other() -> None:
    """A lip that has come near the other one is measured against itself."""
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), indexing="ij"), axis=-1).reshape(-1, 2)
    one = np.array([[i * 5 + j, (i + 1) * 5 + j, i * 5 + j + 1] for i in range(4) for j in range(4)])
    two = np.array([[(i + 1) * 5 + j, (i + 1) * 5 + j + 1, i * 5 + j + 1] for i in range(4) for j in range(4)])
    up = np.concatenate([one, two])
    points = np.concatenate([np.c_[grid, np.zeros(25)], np.c_[grid, np.full(25, 2.0)]])
    lips = TriMesh(points, np.concatenate([up, up[:, ::-1] + 25]).astype(np.int32))
    raised = np.c_[grid, np.full(25, 1.6)]
    np.testing.assert_allclose(signed_distance(raised, lips, np.tile([0.0, 0.0, 1.0], (25, 1))), 1.6)
    np.testing.assert_allclose(signed_distance(raised, lips), 0.4)


def test_the_quick_search_finds_what_the_full_one_does() -> None:
    """Points all over a crumpled sheet, facing anywhere, against every triangle that faces the same way."""
    rng = np.random.default_rng(5)
    ball = _ball(10.0, 3)
    sheet = TriMesh(ball.points + rng.normal(scale=0.35, size=ball.points.shape), ball.triangles)
    points = 8.0 * rng.normal(size=(80, 3))
    normals = rng.normal(size=(80, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    unit = sheet.normals_by_area / sheet.areas[:, None]
    for point, normal, distance in zip(points, normals, signed_distance(points, sheet, normals), strict=True):
        facing = sheet.points[sheet.triangles[unit @ normal >= FACING]]
        at = nearest_on(np.broadcast_to(point, (len(facing), 3)), facing)
        assert abs(distance) == pytest.approx(np.linalg.norm(at - point, axis=1).min(), rel=1e-9)


def test_figures_of_equal_areas_are_those_of_numpy() -> None:
    """Mean, signed mean, median, percentiles and shares of many numbers."""
    error = np.random.default_rng(1).laplace(scale=0.5, size=200_000)
    got = statistics(error, np.ones(len(error)))
    size = np.abs(error)
    assert got.mean == pytest.approx(size.mean()) and got.signed_mean == pytest.approx(error.mean())
    assert (got.median, got.p90, got.p95) == pytest.approx(tuple(np.percentile(size, (50, 90, 95))), abs=1e-4)
    assert got.max == size.max()
    assert got.within_1_5 == pytest.approx(100 * (1 - np.exp(-3.0)), abs=0.2)
    assert got.within_2 == pytest.approx(100 * (1 - np.exp(-4.0)), abs=0.2)


def test_areas_count() -> None:
    """Splitting a point into many changes no figure."""
    assert quantiles(np.array([1.0, 2.0, 3.0]), np.array([1.0, 1.0, 1.0]), (0.5,)) == (2.0,)
    once = statistics(np.array([1.0, -2.0, 3.0]), np.array([4.0, 2.0, 2.0]))
    split = statistics(np.array([1.0, 1.0, -2.0, 3.0]), np.array([2.0, 2.0, 2.0, 2.0]))
    assert (once.mean, once.signed_mean, once.within_1_5) == (split.mean, split.signed_mean, split.within_1_5)
    assert once.mean == 1.75 and once.within_1_5 == 50.0


def test_nothing_to_measure_and_bad_numbers() -> None:
    """An empty region is no number; a distance that is no number is refused."""
    empty = statistics(np.zeros(0), np.zeros(0))
    assert np.isnan(empty.mean) and empty.vertices == 0
    rows = list(csv.reader(io.StringIO(csv_text({"chin, moved": empty}))))
    assert rows[1][0] == "chin, moved" and rows[1][3] == "" and len(rows[0]) == len(rows[1])
    with pytest.raises(UserError):
        statistics(np.array([np.nan]), np.ones(1))


def test_regions_of_the_face() -> None:
    """No vertex is in two; each lies where its name says; they are as symmetric as the face."""
    face = load_face("default", "coarse")
    regions = face_regions(face)
    parts = {name: mask for name, mask in regions.items() if name != "face"}
    assert np.sum(list(parts.values()), axis=0).max() == 1
    assert all(mask.sum() > 5 for mask in parts.values())
    for name, landmark in (("nose", "pronasale"), ("lips", "labrale_superius"), ("chin", "pogonion"),
                           ("cheeks", "malar_left"), ("forehead", "supraglabella")):  # fmt: skip
        assert parts[name][face.landmarks[landmark]], name
    for mask in regions.values():
        assert np.array_equal(mask, mask[face.mirror])
    whole = regions["face"]
    assert not (whole & (parts["eyes"] | parts["neck"])).any()
    rows = table(np.full(len(whole), 2.5), face.mesh, regions, whole)
    assert rows["nose, moved"].mean == pytest.approx(2.5) and rows["face"].within_2 == 0.0
