"""Laws of the head scene and of ambient occlusion."""

from __future__ import annotations

import numpy as np
import pytest
from picture_shapes import ball

from faceanim.ground.errors import UserError
from faceanim.render.colormap import PARTITION, Scale
from faceanim.render.occlusion import vertex_openness
from faceanim.render.scene import Part, head_scene


@pytest.fixture(scope="module")
def skin() -> tuple[np.ndarray, np.ndarray]:
    return ball((0.0, 0.0, 0.0), 80.0, 16)


def test_a_convex_body_is_open_everywhere(skin: tuple[np.ndarray, np.ndarray]) -> None:
    """Nothing hides the sky from a ball."""
    assert vertex_openness(*skin, size=128, directions=32, bias=4.0).min() > 0.9


def test_a_bowl_sees_the_sky_through_its_mouth() -> None:
    """Every point inside a sphere cut open sees the same part of the sky: the cut-off part of the sphere's area."""
    points, quads = ball((0.0, 0.0, 0.0), 50.0, 20)
    keep = (points[quads, 1] < 30.0).all(axis=1)
    value = vertex_openness(points, quads[keep][:, ::-1], size=128, directions=96)
    np.testing.assert_allclose(value[points[:, 1] < 25.0], 0.2, atol=0.1)
    assert abs(value[points[:, 1] < 25.0].mean() - 0.2) < 0.02
    left, right = value[points[:, 0] > 10.0], value[points[:, 0] < -10.0]
    assert abs(left.mean() - right.mean()) < 0.01


def test_parts_move_with_their_bone(skin: tuple[np.ndarray, np.ndarray]) -> None:
    """A part on bone 1 follows its pose, one on bone 0 stays."""
    knob, faces = ball((0.0, 0.0, 85.0), 12.0, 8)
    colour = np.tile(np.array([255, 0, 0], np.uint8), (len(knob), 1))
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[1, :3, 3] = (40.0, 0.0, 0.0)
    red = []
    for bone in (0, 1):
        scene = head_scene(*skin, size=96, parts=[Part("other", knob, faces, colour, bone)], occlusion=1.0)
        image = scene.draw(skin[0], pose).astype(int)
        red.append(np.argwhere(image[..., 0] > 2 * image[..., 1]).mean(axis=0))
    assert red[1][1] - red[0][1] > 15 and abs(red[1][0] - red[0][0]) < 3


def test_values_and_partition_colour_the_skin(skin: tuple[np.ndarray, np.ndarray]) -> None:
    """Each mode shows its own colours on the skin, with a bar or a legend; wrong values are refused."""
    points, quads = skin
    scene = head_scene(points, quads, size=96, mode="values", scale=Scale(0.0, 1.0, "d [mm]"), occlusion=1.0)
    low = scene.draw(points, values=np.zeros(len(points)))[48, 48].astype(int)
    high = scene.draw(points, values=np.ones(len(points)))[48, 48].astype(int)
    assert high[0] > low[0] + 80
    sets = head_scene(points, quads, size=96, mode="partition", occlusion=1.0)
    shown = sets.draw(points, values=np.zeros(len(points), int))[28, 48]
    assert int(np.argmax(shown)) == int(np.argmax(PARTITION[0][1]))
    with pytest.raises(UserError, match="node set"):
        sets.draw(points, values=np.full(len(points), 3))
    with pytest.raises(UserError, match="shows no values"):
        head_scene(points, quads, size=32, occlusion=1.0).draw(points, values=np.zeros(len(points)))
    with pytest.raises(UserError, match="colour mode"):
        head_scene(points, quads, size=32, mode="partitio")
    with pytest.raises(UserError, match="scale"):
        head_scene(points, quads, size=32, mode="values")


def test_bone_shows_through_the_skin(skin: tuple[np.ndarray, np.ndarray]) -> None:
    """A bone inside the head changes the picture where it lies, and only there."""
    inner = ball((0.0, 0.0, 0.0), 40.0, 12)
    plain = head_scene(*skin, size=96, occlusion=1.0).draw(skin[0]).copy().astype(int)
    seen = head_scene(*skin, size=96, bones=[Part("cranium", *inner)], occlusion=1.0).draw(skin[0]).astype(int)
    change = np.abs(seen - plain).max(axis=2)
    assert change[48, 48] > 10 and change[:16].max() == 0
