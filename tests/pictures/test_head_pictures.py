"""The default head as pictures: small, tolerant, one behaviour each."""

from __future__ import annotations

from functools import cache
from typing import Any

import cv2
import numba
import numpy as np
import pytest

from faceanim.face.library import load_face
from faceanim.render.camera import Camera
from faceanim.render.colormap import Scale
from faceanim.render.occlusion import vertex_openness
from faceanim.render.scene import HeadScene, Part, head_scene
from faceanim.render.shading import Look, Texture

SIZE = 192


@cache
def ingredients() -> tuple[Any, Any, Texture]:
    face = load_face("default", "coarse")
    return face, vertex_openness(face.mesh.points, face.mesh.triangles, directions=32), Texture.of(face.texture)


def scene(view: str | Camera = "front", **options: Any) -> HeadScene:
    face, openness, texture = ingredients()
    parts = [Part(part.name, part.points, part.triangles, part.colour, part.bone) for part in face.parts]
    settings = {"size": SIZE, "view": view, "parts": parts, "occlusion": openness, **options}
    if settings.get("mode", "skin") == "skin":
        settings |= {"uv": face.uv, "uv_triangles": face.uv_triangles, "texture": texture}
    return head_scene(face.mesh.points, face.mesh.triangles, **settings)


def rest() -> np.ndarray:
    return np.asarray(ingredients()[0].mesh.points)


def background() -> np.ndarray:
    return np.round(255 * np.linspace(Look().background.top, Look().background.bottom, SIZE))


def head_mask(picture: np.ndarray) -> np.ndarray:
    border = picture[:, :1].astype(int)
    return np.abs(picture - border).max(axis=2) > 6


def test_the_head_fills_the_picture() -> None:
    """In the front view the head touches the margins and stands in the middle."""
    mask = head_mask(scene().draw(rest()))
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    assert max(np.ptp(rows), np.ptp(columns)) > 0.85 * SIZE
    assert abs(columns.mean() - SIZE / 2) < 3


def test_skin_has_the_colour_of_skin() -> None:
    """Over the cheeks red exceeds green exceeds blue, neither dark nor burnt out, and the light models the form."""
    picture = scene().draw(rest()).astype(int)
    face = picture[SIZE // 2 : SIZE // 2 + 30, SIZE // 2 - 40 : SIZE // 2 + 40].reshape(-1, 3)
    red, green, blue = np.median(face, axis=0)
    assert 120 < red < 245 and red > green + 15 > blue + 20
    assert np.percentile(face[:, 1], 95) - np.percentile(face[:, 1], 5) > 25


def test_the_face_is_nearly_symmetric() -> None:
    """Under mirrored light the mirrored picture of the symmetric head is the same, but for the painted skin."""
    look = Look()
    mirrored = Look(look.lighting.mirrored(), look.background)
    one = scene(mode="plain", look=look).draw(rest()).astype(int)
    two = scene(mode="plain", look=mirrored).draw(rest())[:, ::-1].astype(int)
    assert np.abs(one - two).mean() < 1.0


def test_eyes_glint_and_lie_behind_the_lids() -> None:
    """Each eye shows a small glint and an iris darker than the white; most of the eyeball is hidden by the lids."""
    face = ingredients()[0]
    balls = [part for part in face.parts if part.name.startswith("eye")]
    assert len(balls) == 2
    for ball in balls:
        low, high = ball.points.min(axis=0), ball.points.max(axis=0)
        camera = Camera.front([low, high], margin=0.02)
        shown = scene(camera).draw(rest()).copy().astype(int)
        bare = scene(camera, parts=[]).draw(rest()).astype(int)
        eye = np.abs(shown - bare).max(axis=2) > 8
        assert 0.04 < eye.mean() < 0.5
        light = shown.sum(axis=2)[eye]
        assert light.max() > 3 * 215, "the glint"
        assert np.percentile(light, 5) < 0.45 * np.percentile(light, 90), "iris and pupil"


def test_the_head_does_not_depend_on_the_number_of_threads() -> None:
    """One thread and all threads give the same bytes, shadow included, also while the jaw moves."""
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[1, 1, 3] = -6.0
    drawn = scene()
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = [drawn.draw(rest(), p).copy() for p in (None, pose)]
    finally:
        numba.set_num_threads(before)
    other = scene()
    for picture, p in zip(one, (None, pose), strict=True):
        np.testing.assert_array_equal(picture, other.draw(rest(), p))


def test_eyes_and_mouth_have_few_triangles() -> None:
    """Parts that fill few pixels cost little: eyes at most 2,500 triangles each, teeth, gums and tongue 14,000."""
    count = {part.name: len(part.triangles) for part in ingredients()[0].parts}
    eyes = [n for name, n in count.items() if name.startswith("eye")]
    assert max(eyes) <= 2500 and sum(count.values()) - sum(eyes) <= 14_000


def test_the_iris_is_round() -> None:
    """Close up, the lower outline of the iris is a circle to within 2 % of its radius and a pixel."""
    ball = next(part for part in ingredients()[0].parts if part.name == "eye_left")
    low, high = ball.points.min(axis=0), ball.points.max(axis=0)
    camera = Camera.front([low, high])
    part = Part(ball.name, ball.points, ball.triangles, ball.colour)
    tiny = low + 1e-3 * np.eye(3)  # a head scene needs some skin
    drawn = head_scene(tiny, np.array([[0, 1, 2]]), size=512, view=camera, parts=[part], occlusion=1.0, mode="plain")
    light = drawn.draw(tiny).astype(int).sum(axis=2)
    middle = camera.project([np.append(0.5 * (low + high)[:2], high[2])], 512, 512)[0, :2]
    turn, reach = np.radians(np.arange(180, 360, 3)), np.arange(60, 200)
    x = (middle[0] + np.cos(turn)[:, None] * reach).astype(int)
    y = (middle[1] - np.sin(turn)[:, None] * reach).astype(int)
    edge = reach[np.diff(light[y, x], axis=1).argmax(axis=1)]
    assert np.abs(edge - np.median(edge)).max() <= 0.02 * np.median(edge) + 1.0


@pytest.mark.parametrize("view", ["front", "three_quarter", "side"])
def test_closed_mouth_hides_the_teeth(view: str) -> None:
    """At rest, teeth, gums and tongue cover no more than a trace of the picture."""
    parts = [Part(p.name, p.points, p.triangles, p.colour, p.bone) for p in ingredients()[0].parts]
    eyes = [part for part in parts if part.name.startswith("eye")]
    with_mouth = scene(view, parts=parts).draw(rest()).copy().astype(int)
    without = scene(view, parts=eyes).draw(rest()).astype(int)
    assert (np.abs(with_mouth - without).max(axis=2) > 12).mean() < 5e-4


def test_skull_shines_through() -> None:
    """The skull changes the picture within the head's outline, and nowhere else."""
    face = ingredients()[0]
    bones = [
        Part("cranium", face.cranium.points, face.cranium.triangles),
        Part("jaw", face.jaw_mesh.points, face.jaw_mesh.triangles, bone=1),
    ]
    plain = scene().draw(rest()).copy().astype(int)
    seen = scene(bones=bones).draw(rest()).astype(int)
    change = np.abs(seen - plain).max(axis=2) > 8
    assert change.mean() > 0.2
    assert not (
        change & ~cv2.dilate(head_mask(plain.astype(np.uint8)).astype(np.uint8), np.ones((5, 5))).astype(bool)
    ).any()


def test_displacement_is_seen_where_it_is() -> None:
    """A bump of values on one side colours that side only."""
    points = rest()
    values = np.where(points[:, 0] > 15.0, 10.0, 0.0)
    shown = scene(mode="values", scale=Scale(0.0, 10.0, "displacement [mm]")).draw(points, values=values).astype(int)
    middle = shown[SIZE // 2 : SIZE // 2 + 20]
    left, right = middle[:, SIZE // 2 - 40 : SIZE // 2 - 20], middle[:, SIZE // 2 + 20 : SIZE // 2 + 40]
    assert right[..., 1].mean() > left[..., 1].mean() + 60
