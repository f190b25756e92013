"""Pictures of errors: false colours on one scale, of any body."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import bridge

from faceanim.bench.comparison.pictures import error_picture, face_error_picture
from faceanim.face.library import load_face
from faceanim.ground.errors import UserError
from faceanim.render.colormap import round_top

SURFACE = bridge().surface


def drawn(value: float, top: float = 2.0) -> np.ndarray:
    values = np.full(len(SURFACE.points), value)
    size = (96, 72)
    return error_picture(SURFACE.points, SURFACE.triangles, SURFACE.points, values, top, size, view="front").astype(int)


def test_colour_tells_the_error_on_a_fixed_scale() -> None:
    """Small errors are dark, large ones yellow, and the same error has the same colour in every picture."""
    low, high = drawn(0.0), drawn(2.0)
    assert low.shape == (72, 96, 3)
    assert high[36, 40, 0] > low[36, 40, 0] + 60
    np.testing.assert_array_equal(drawn(5.0), high)
    assert (drawn(1.0) != drawn(1.0, top=4.0)).any()


@pytest.mark.parametrize(
    ("value", "top"), [(0.0, 1.0), (np.nan, 1.0), (1.2, 1.5), (0.031, 0.04), (1.5, 1.5), (97, 100)]
)
def test_scales_end_at_round_numbers(value: float, top: float) -> None:
    """The next round number is taken, one if there is nothing to show."""
    assert round_top(value) == pytest.approx(top)


def test_bad_input_is_refused() -> None:
    """A scale without extent, values of another length, positions that are no numbers."""
    points, triangles = SURFACE.points, SURFACE.triangles
    with pytest.raises(UserError, match="top is 0"):
        error_picture(points, triangles, points, np.zeros(len(points)), 0.0)
    with pytest.raises(UserError, match="values"):
        error_picture(points, triangles, points, np.zeros(3), 1.0)
    with pytest.raises(UserError, match="not finite"):
        error_picture(points, triangles, points * np.nan, np.zeros(len(points)), 1.0)


def test_a_face_is_shown_twice_with_one_bar() -> None:
    """Front and three quarters side by side; an error on one cheek brightens both views there."""
    face = load_face("default", "coarse")
    points = face.mesh.points
    cheek = 4.0 * np.exp(-((points[:, :2] - [25.0, -40.0]) ** 2).sum(axis=1) / 800.0)
    open_to_light = np.ones(len(points))
    still, off = (
        face_error_picture(face, points, values, 4.0, 96, openness=open_to_light).astype(int)
        for values in (np.zeros(len(points)), cheek)
    )
    assert off.shape == (96, 192, 3)
    brighter = (off - still)[:, :, 0] > 60
    assert brighter[:, :96].sum() > 20 and brighter[:, 96:].sum() > 20
    assert not brighter[:30].any()
