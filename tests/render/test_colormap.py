"""Laws of the colour maps, scales and what is written on pictures."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.ground.errors import UserError
from faceanim.render.colormap import Scale, _lab, colour_table
from faceanim.render.overlay import draw_colour_bar, ticks


def test_sequential_map_grows_lighter_in_even_steps() -> None:
    """Lightness never falls, and neighbouring colours differ by nearly the same perceived amount."""
    lab = _lab(colour_table("depth"))
    assert (np.diff(lab[:, 0]) > 0.0).all()
    step = np.linalg.norm(np.diff(lab, axis=0), axis=1)
    assert step.max() / step.min() < 1.25


def test_two_sided_map_is_lightest_in_the_middle() -> None:
    """Zero is the lightest colour and both ends are about equally dark."""
    light = _lab(colour_table("two_sided"))[:, 0]
    assert abs(int(np.argmax(light)) - 127.5) < 2.0
    assert (np.diff(light[:127]) > 0.0).all() and (np.diff(light[129:]) < 0.0).all()
    assert abs(light[0] - light[-1]) < 0.08


def test_scale_clips_and_interpolates() -> None:
    """Values outside take the end colours; the table's colours are hit at its places."""
    scale, table = Scale(2.0, 4.0, "strain", "two_sided"), colour_table("two_sided")
    np.testing.assert_allclose(scale.colours([-9.0, 2.0, 4.0, 99.0]), table[[0, 0, 255, 255]])
    np.testing.assert_allclose(scale.colours([3.0])[0], 0.5 * (table[127] + table[128]))
    assert np.isfinite(Scale(1.0, 1.0, "nothing").colours([1.0])).all()
    with pytest.raises(UserError, match="depth"):
        colour_table("dept")


@pytest.mark.parametrize(("low", "high"), [(0.0, 12.0), (-0.3, 0.3), (0.0, 0.007), (5.0, 1234.0), (3.0, 3.0)])
def test_ticks_are_round_and_inside(low: float, high: float) -> None:
    """Between one and six numbers, all inside the scale."""
    marks = ticks(low, high)
    assert 1 <= len(marks) <= 6
    assert all(low - 1e-12 <= m <= high + 1e-12 for m in marks)


def test_colour_bar_shows_the_scale() -> None:
    """The bar runs from the low colour at the bottom to the high colour on top."""
    picture = np.full((256, 256, 3), 200, np.uint8)
    scale = Scale(0.0, 1.0, "x [mm]")
    draw_colour_bar(picture, scale)
    low, high = np.round(255 * scale.colours([0.0, 1.0]))
    rows = {tuple(end): np.argwhere((np.abs(picture - end) < 2.0).all(axis=2))[:, 0].mean() for end in (low, high)}
    assert rows[tuple(low)] > rows[tuple(high)] + 100
