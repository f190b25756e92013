"""Laying a head flat and finding the way back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faceanim.geometry.projection import Cylinder, Front
from faceanim.geometry.rays import barycentric, first_hit
from faceanim.geometry.shapes import sphere

POINTS = np.array([[-70.0, -120.0, -90.0], [70.0, 130.0, 110.0]])
SIZES = st.tuples(st.integers(64, 2048), st.integers(64, 2048))


@settings(max_examples=50, deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(-100.0, 100.0), st.floats(5.0, 100.0), SIZES)
def test_a_ray_of_the_cylinder_passes_through_the_point_of_its_pixel(
    angle: float, height: float, radius: float, size: tuple[int, int]
) -> None:
    """Down to round-off, for any picture."""
    view = Cylinder.of(POINTS)
    point = np.array([view.axis[0] + radius * np.sin(angle), height, view.axis[1] + radius * np.cos(angle)])
    start, way = view.rays(view.pixels(point[None], size), size)
    assert np.linalg.norm(np.cross(point - start[0], way[0])) < 1e-9
    assert (point - start[0]) @ way[0] > 0.0
    assert np.linalg.norm(way) == pytest.approx(1.0)


@settings(max_examples=50, deadline=None)
@given(st.tuples(st.floats(-100, 100), st.floats(-100, 100), st.floats(-90, 110)), SIZES)
def test_a_ray_from_the_front_passes_through_the_point_of_its_pixel(
    point: tuple[float, float, float], size: tuple[int, int]
) -> None:
    """Also where the picture is not square: pixels are."""
    view = Front.of(POINTS)
    start, way = view.rays(view.pixels([point], size), size)
    np.testing.assert_allclose(start[0, :2], point[:2], atol=1e-9)
    assert start[0, 2] > 110.0 and way[0].tolist() == [0.0, 0.0, -1.0]


def test_the_face_looks_out_of_the_middle_and_the_seam_is_behind() -> None:
    """The subject's left is to the right; straight back is at both borders."""
    view = Cylinder.of(POINTS)
    middle, height = view.axis[1], 5.0
    points = [[0.0, height, 100.0], [60.0, height, middle], [-60.0, height, middle], [1e-9, height, -90.0]]
    x = view.pixels(points, (400, 300))[:, 0]
    np.testing.assert_allclose(x, [200.0, 300.0, 100.0, 400.0], atol=1e-6)


@pytest.mark.parametrize("scale", [0.3, 2.0])
def test_a_scaled_head_is_laid_flat_alike(scale: float) -> None:
    """Pixels do not depend on the size of the head."""
    rng = np.random.default_rng(3)
    points = rng.uniform(POINTS[0], POINTS[1], (30, 3))
    for view, other in (
        (Cylinder.of(POINTS), Cylinder.of(scale * POINTS)),
        (Front.of(POINTS), Front.of(scale * POINTS)),
    ):
        pixels = other.pixels(scale * points, (512, 512))
        np.testing.assert_allclose(view.pixels(points, (512, 512)), pixels, atol=1e-9)


def test_rays_towards_a_ball_end_on_it() -> None:
    """At the outermost triangle; barycentric coordinates give the point back; misses are said to be misses."""
    mesh = sphere(50.0, 3)
    rng = np.random.default_rng(0)
    way = rng.normal(size=(40, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    far, triangle = first_hit(-200.0 * way, way, mesh, np.inf)
    assert ((far > 149.9) & (far < 152.0)).all()
    hit = -200.0 * way + far[:, None] * way
    corner = mesh.points[mesh.triangles[triangle]]
    share = barycentric(corner, hit)
    assert (share > -1e-9).all()
    np.testing.assert_allclose(np.einsum("ij,ijk->ik", share, corner), hit, atol=1e-9)
    far, triangle = first_hit(-200.0 * way, -way, mesh, np.inf)
    assert np.isinf(far).all() and (triangle == -1).all()
    assert np.isinf(first_hit(-200.0 * way, way, mesh, 100.0)[0]).all()
