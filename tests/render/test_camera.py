"""Laws of the cameras."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from faceanim.ground.errors import UserError
from faceanim.render.camera import VIEWS, Camera


@given(st.sampled_from(sorted(VIEWS)), st.sampled_from([(320, 320), (640, 360), (240, 400)]), st.integers(0, 999))
def test_named_view_frames_all_points_tightly(view: str, size: tuple[int, int], seed: int) -> None:
    """Every point to be framed lies inside the margin, and one side of the picture is used up to it."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, 3)) * rng.uniform(20.0, 120.0, 3) + rng.uniform(-300.0, 300.0, 3)
    camera = Camera.named(view, points, aspect=size[0] / size[1], margin=0.05)
    spot = camera.project(points, *size)[:, :2] / size
    assert spot.min() > 0.045 and spot.max() < 0.955
    assert np.ptp(spot, axis=0).max() > 0.88


def test_two_points_mean_the_box_between_them() -> None:
    """Bounds may be given as two opposite corners."""
    low, high = np.array([-70.0, -110.0, -90.0]), np.array([70.0, 120.0, 100.0])
    corner = np.array([[x, y, z] for x in (-70.0, 70.0) for y in (-110.0, 120.0) for z in (-90.0, 100.0)])
    np.testing.assert_allclose(Camera.front([low, high]).position, Camera.front(corner).position)


def test_sides_and_turns() -> None:
    """The subject's left (+x) is on the right of a front view; the side view shows the face looking to the left."""
    box = [[-80.0, -100.0, -90.0], [80.0, 100.0, 100.0]]
    front, side = Camera.front(box), Camera.side(box)
    assert front.project([[50.0, 0.0, 0.0]], 100, 100)[0, 0] > 50.0
    assert side.project([[0.0, 0.0, 100.0]], 100, 100)[0, 0] < 50.0
    assert side.position[0] > 100.0
    assert Camera.three_quarter(box).position[0] > 0.0 > Camera.named("three_quarter_right", box).position[0]


def test_camera_refuses_nonsense() -> None:
    """An unknown view suggests the nearest; a camera without a direction is refused."""
    with pytest.raises(UserError, match="three_quarter"):
        Camera.named("threequarter", np.eye(3))
    with pytest.raises(UserError, match="fewer than two"):
        Camera.named("front", np.zeros((1, 3)))
    with pytest.raises(UserError, match="up direction"):
        Camera((0.0, 5.0, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    with pytest.raises(UserError, match="fov"):
        Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), fov=0.0)
