"""Laws of the rasteriser: what covers what, by how much, and in which colour."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from picture_shapes import ball

from faceanim.ground.errors import RunError, UserError
from faceanim.render.camera import Camera
from faceanim.render.renderer import DrawItem, Renderer
from faceanim.render.shading import Background, Light, Lighting, Look, Material, Texture, linear

SIZE = 64
BLACK = Look(background=Background((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
WHITE = Material(colour=(1.0, 1.0, 1.0), specular=0.0, flat=1.0, two_sided=True)
# One unit is one pixel at z = 0, the origin lies in the middle of the picture.
DISTANCE = 1000.0
CAMERA = Camera(
    (0.0, 0.0, DISTANCE), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), fov=np.degrees(2.0 * np.arctan(0.5 * SIZE / DISTANCE))
)


def plain(red: float, green: float = 0.0, blue: float = 0.0, **options: object) -> Material:
    return Material(colour=(red, green, blue), specular=0.0, flat=1.0, two_sided=True, **options)  # type: ignore[arg-type]


def picture(*items: DrawItem, camera: Camera = CAMERA, size: int = SIZE, look: Look = BLACK) -> np.ndarray:
    return Renderer(size, camera, items, look=look).draw().copy()


def triangle(corners: object, material: Material = WHITE) -> DrawItem:
    points = np.asarray(corners, dtype=float)
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(3)])
    return DrawItem(points, np.array([[0, 1, 2]]), material)


def square(half: float, z: float, material: Material, x: float = 0.0) -> DrawItem:
    corner = np.array([[x - half, -half], [x + half, -half], [x + half, half], [x - half, half]])
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return DrawItem(np.column_stack([corner, np.full(4, z)]), np.array([[0, 1, 2], [0, 2, 3]]), material, uv)


def covered(*items: DrawItem, camera: Camera = CAMERA) -> np.ndarray:
    """Which of the four samples of each pixel show something."""
    return np.isfinite(Renderer(SIZE, camera, items).depth())


def test_covered_area_is_the_area_of_the_triangle() -> None:
    """The number of samples inside a triangle is four times its area, up to its rim: error < perimeter / 8."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        corner = rng.uniform(-30.0, 30.0, (3, 2))
        (ax, ay), (bx, by) = corner[1] - corner[0], corner[2] - corner[0]
        area = 0.5 * abs(ax * by - ay * bx)
        rim = np.linalg.norm(corner - np.roll(corner, 1, axis=0), axis=1).sum()
        assert abs(covered(triangle(corner)).sum() / 4.0 - area) < rim / 8.0


def test_neighbours_share_no_sample_and_leave_no_gap() -> None:
    """A fan of triangles around a point covers each sample of its outline exactly once, wherever the point lies."""
    rng = np.random.default_rng(5)
    rim = 25.0 * np.stack([np.cos(np.arange(7) * 2 * np.pi / 7), np.sin(np.arange(7) * 2 * np.pi / 7)], axis=1)
    for hub in np.concatenate([rng.uniform(-10, 10, (6, 2)), np.round(rng.uniform(-10, 10, (4, 2)) * 8) / 8, [[0, 0]]]):
        count = np.zeros((SIZE, SIZE, 4), dtype=int)
        for k in range(7):
            count += covered(triangle([hub, rim[k], rim[(k + 1) % 7]]))
        assert count.max() == 1
        shifted = np.zeros_like(count)
        for k in range(7):
            shifted += covered(triangle([(1.0, 2.0), rim[k], rim[(k + 1) % 7]]))
        np.testing.assert_array_equal(count, shifted)


def test_edge_pixels_are_grey_in_proportion_to_coverage() -> None:
    """Along an upright edge at any fraction of a pixel, the pixel's linear light is the part covered, to 1/8."""
    for x in np.linspace(0.03, 0.97, 9):
        right = [[x, -100.0], [200.0, -100.0], [x, 100.0]]
        row = linear(picture(triangle(right, plain(0.8)))[SIZE // 2 + 20, :, 0] / 255.0)
        assert row[SIZE // 2 - 1] == 0.0 and row[SIZE // 2 + 1] > 0.5
        assert abs(row[SIZE // 2] / row[SIZE // 2 + 1] - (1.0 - x)) <= 0.126


def test_near_hides_far_in_any_order() -> None:
    """The surface nearer to the eye is seen, whichever item comes first."""
    near, far = square(10.0, 5.0, plain(1.0)), square(20.0, -5.0, plain(0.0, 1.0))
    one, two = picture(near, far), picture(far, near)
    np.testing.assert_array_equal(one, two)
    assert one[32, 32, 0] > 200 and one[32, 32, 1] == 0
    assert one[32, 32 + 15, 1] > 200 and one[32, 32 + 15, 0] == 0


def test_crossing_surfaces_meet_on_their_common_line() -> None:
    """Two tilted planes that cross at x = 0 swap places exactly there, and the pixels beside it are pure."""
    left = [[-40.0, -40.0, 4.0], [40.0, -40.0, -4.0], [0.0, 60.0, 0.0]]
    right = [[-40.0, -40.0, -4.0], [40.0, -40.0, 4.0], [0.0, 60.0, 0.0]]
    row = picture(triangle(left, plain(1.0)), triangle(right, plain(0.0, 1.0)))[40]
    assert (row[12:31, 0] > 200).all() and (row[12:31, 1] == 0).all()
    assert (row[33:52, 1] > 200).all() and (row[33:52, 0] == 0).all()


def test_depth_is_the_distance_to_the_plane() -> None:
    """Depth is that of the ray's meeting with the plane (perspective, not linear on the screen), to 0.01 mm."""
    corner = np.array([[-400.0, -300.0, -900.0], [400.0, -300.0, 500.0], [0.0, 500.0, -100.0]])
    depth = Renderer(SIZE, CAMERA, [triangle(corner)]).depth()
    normal = np.cross(corner[1] - corner[0], corner[2] - corner[0])
    offset = np.array([[-1, -3], [3, -1], [1, 3], [-3, 1]]) / 8.0
    y, x = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5, indexing="ij")
    for s in range(4):
        rx, ry = (x + offset[s, 0] - 32.0) / DISTANCE, (32.0 - y - offset[s, 1]) / DISTANCE
        exact = normal @ (corner[0] - CAMERA.position) / (normal[0] * rx + normal[1] * ry - normal[2])
        seen = np.isfinite(depth[:, :, s])
        assert seen.sum() > 500
        np.testing.assert_allclose(depth[:, :, s][seen], exact[seen], atol=0.01)


@pytest.mark.parametrize("ahead", [1, 2])
def test_near_plane_cuts_a_triangle(ahead: int) -> None:
    """A triangle that crosses the near plane shows exactly the part beyond it, with one or two corners in front."""
    near = 600.0
    camera = Camera(CAMERA.position, CAMERA.target, CAMERA.up, CAMERA.fov, near)
    front, behind = (
        np.array([[-5.0, -8.0, 0.0], [9.0, -6.0, -300.0]]),
        np.array([[3.0, 7.0, 700.0], [-4.0, 2.0, 1500.0]]),
    )
    corner = np.concatenate([front[:ahead], behind[: 3 - ahead]])
    polygon = []
    for a, b in zip(corner, np.roll(corner, -1, axis=0), strict=True):
        da, db = DISTANCE - a[2] - near, DISTANCE - b[2] - near
        if da >= 0.0:
            polygon.append(a)
        if da * db < 0.0:
            polygon.append(a + da / (da - db) * (b - a) - (0.0, 0.0, 1e-6))
    count = len(polygon)
    assert count == (3 if ahead == 1 else 4)
    cut = DrawItem(np.array(polygon), np.array([[0, k, k + 1] for k in range(1, count - 1)]), WHITE)
    np.testing.assert_array_equal(covered(triangle(corner), camera=camera), covered(cut, camera=camera))
    assert covered(cut, camera=camera).any()


def test_nothing_behind_the_eye_is_drawn() -> None:
    """What lies wholly before the near plane or behind the eye leaves the picture empty."""
    assert not covered(square(10.0, DISTANCE + 5.0, WHITE), square(10.0, DISTANCE - 2.0, WHITE)).any()


def test_back_sides_are_culled_unless_asked_for() -> None:
    """A triangle seen from behind is drawn only with a two-sided material."""
    corner = [[-20.0, -20.0], [20.0, -20.0], [0.0, 20.0]]
    one_sided = Material(colour=(1.0, 1.0, 1.0), two_sided=False)
    assert covered(triangle(corner, one_sided)).any()
    assert not covered(triangle(corner[::-1], one_sided)).any()
    assert covered(triangle(corner[::-1], WHITE)).any()


def test_mirrored_scene_gives_a_mirrored_picture() -> None:
    """Mirroring bodies and lights in x mirrors the picture; only the sample pattern differs, at silhouettes."""
    points, quads = ball((6.0, 3.0, 0.0), 18.0)
    look, skin = BLACK, Material(colour=(0.8, 0.6, 0.5), wrap=(0.4, 0.2, 0.1))
    mirrored = Look(look.lighting.mirrored(), look.background)
    one = picture(DrawItem(points, quads, skin), look=look).astype(float)
    two = picture(DrawItem(points * (-1.0, 1.0, 1.0), quads[:, ::-1], skin), look=mirrored).astype(float)[:, ::-1]
    inside = np.hypot(*(np.mgrid[:SIZE, :SIZE] + 0.5 - np.array([29.0, 38.0])[:, None, None])) < 16.0
    assert np.abs(one - two)[inside].max() <= 3.0
    assert np.abs(one - two).mean() < 1.0


def test_picture_does_not_depend_on_the_number_of_threads() -> None:
    """One thread and all threads give the same bytes."""
    points, quads = ball((0.0, 0.0, 0.0), 25.0)
    renderer = Renderer(SIZE, CAMERA, [DrawItem(points, quads, Material())])
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = renderer.draw().copy()
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(one, renderer.draw())
    np.testing.assert_array_equal(one, Renderer(SIZE, CAMERA, [DrawItem(points, quads, Material())]).draw())


def test_hidden_parts_leave_no_trace() -> None:
    """A ball inside a ball changes no pixel, whether it is drawn before or after; nor does its own far side."""
    (points, quads), (inner, faces) = ball((0.0, 0.0, 0.0), 25.0), ball((3.0, 2.0, 0.0), 18.0, 12)
    shell = DrawItem(points, quads, Material(two_sided=True))
    core = DrawItem(inner, faces, plain(0.0, 1.0))
    alone = picture(DrawItem(points, quads, Material(two_sided=False)))
    for items in ((shell,), (shell, core), (core, shell)):
        np.testing.assert_array_equal(alone, picture(*items))


def test_edges_far_beyond_the_picture_are_exact() -> None:
    """The edge of a triangle thousands of pictures wide passes each sample on the right side, to 0.02 pixel."""
    y, x = np.mgrid[:SIZE, :SIZE][..., None] + 0.5 - SIZE / 2
    height = -(y + np.array([-3, -1, 3, 1]) / 8.0) + 0.1 * (x + np.array([-1, 3, 1, -3]) / 8.0)
    clear = np.abs(height - 7.3) > 0.02
    for far in (300.0, 40_000.0, 400_000.0):
        corner = [[-far, 0.1 * far + 7.3], [0.0, -3.0 * far], [far, -0.1 * far + 7.3]]
        np.testing.assert_array_equal(covered(triangle(corner))[clear], (height < 7.3)[clear])


def test_texture_seams_leave_no_crease() -> None:
    """A ball whose texture is cut along a meridian is lit as one in one piece: normals are shared across the seam."""
    points, quads = ball((0.0, 0.0, 0.0), 25.0)
    texture = Texture.of(np.full((4, 4, 3), 170, np.uint8))
    skin = Material(texture=texture)
    uv = np.full((2 * len(points), 2), 0.5)
    cut = quads + len(points) * (points[quads, 0].mean(axis=1) > 0.0)[:, None]
    whole = picture(DrawItem(points, quads, skin, uv, quads))
    np.testing.assert_array_equal(whole, picture(DrawItem(points, quads, skin, uv, cut)))


def test_texture_lies_as_its_uv_say() -> None:
    """u runs to the right and v upwards over the picture of the texture, whose first row is on top."""
    image = np.zeros((2, 2, 3), np.uint8)
    image[0, 0], image[0, 1], image[1, 0] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    out = picture(square(24.0, 0.0, plain(1.0, texture=Texture.of(image))))
    np.testing.assert_array_equal(out[16, 16] > 128, [True, False, False])
    np.testing.assert_array_equal(out[16, 48] > 128, [False, True, False])
    np.testing.assert_array_equal(out[48, 16] > 128, [False, False, True])
    assert out[48, 48].max() < 100


def test_minified_texture_is_its_mean() -> None:
    """A fine black and white pattern seen from afar shows an even half of the light, without shimmer."""
    board = np.indices((256, 256)).sum(axis=0) % 2
    texture = Texture.of(np.repeat(board[..., None] * 255, 3, axis=2).astype(np.uint8))
    out = linear(picture(square(20.0, 0.0, plain(1.0, texture=texture)))[20:44, 20:44] / 255.0)
    assert abs(out.mean() - 0.5) < 0.02 and np.ptp(out) < 0.03


def test_colours_per_vertex_are_interpolated_in_space() -> None:
    """On a plane seen at a slant, half-way in space (not on the screen) shows half of the linear colour."""
    corner = np.array([[-20.0, -30.0, 300.0], [20.0, -30.0, 300.0], [0.0, 30.0, -900.0]])
    item = DrawItem(
        corner, np.array([[0, 1, 2]]), plain(0.0, vertex_colour=True), vertex_colour=[[0] * 3, [0] * 3, [0.9] * 3]
    )
    out = linear(picture(item)[:, SIZE // 2, 0] / 255.0)
    middle = CAMERA.project([[0.0, 0.0, -300.0]], SIZE, SIZE)[0, 1]
    assert abs(np.interp(middle, np.arange(SIZE) + 0.5, out) - 0.5 * linear(0.9)) < 0.03


def test_upper_layer_is_blended() -> None:
    """A further layer shows through at its opacity, even where the first layer is nearer to the eye."""
    items = [square(20.0, 10.0, plain(1.0)), square(10.0, -10.0, plain(0.0, 0.0, 1.0, layer=1))]
    renderer = Renderer(SIZE, CAMERA, items, look=BLACK, layer_opacity=0.25)
    out = renderer.draw()
    top = int(out[32, 47, 0])
    np.testing.assert_allclose(out[32, 32], [0.75 * top, 0, 0.25 * top], atol=1.0)


def test_normals_follow_the_points() -> None:
    """Brightness comes from the points of this frame: a square turned away from the key light is darker."""
    item = square(20.0, 0.0, Material(colour=(0.8, 0.8, 0.8)))
    renderer = Renderer(SIZE, CAMERA, [item], look=Look(Lighting(), BLACK.background))
    turn = np.radians(50.0)
    lit, dark = (
        item.points * (np.cos(turn), 1.0, 1.0) + item.points[:, :1] * (0.0, 0.0, s * np.sin(turn)) for s in (1, -1)
    )
    bright = renderer.draw([lit])[32, 32].astype(int)
    assert (bright > renderer.draw([dark])[32, 32] + 25).all()


def test_bones_carry_items() -> None:
    """An item with a bone is drawn where the pose puts it."""
    item = DrawItem(square(6.0, 0.0, WHITE).points, square(6.0, 0.0, WHITE).triangles, WHITE, bone=1)
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[1, :3, 3] = (16.0, -8.0, 0.0)
    out = Renderer(SIZE, CAMERA, [item], look=BLACK).draw(None, pose)
    assert out[40, 48].min() > 200 and out[32, 32].max() == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_no_picture_from_broken_points(bad: float) -> None:
    """Positions that are not finite raise an error that names item and vertex."""
    item = square(10.0, 0.0, WHITE)
    renderer = Renderer(SIZE, CAMERA, [item, item])
    points = item.points.copy()
    points[2, 1] = bad
    with pytest.raises(RunError, match="vertex 2 of item 1"):
        renderer.draw([None, points])
    renderer.draw([None, item.points])


def test_wrong_requests_are_refused() -> None:
    """Sizes, shapes and indices that do not fit raise `UserError` and say what is wrong."""
    item = square(10.0, 0.0, WHITE)
    with pytest.raises(UserError, match="4 vertices"):
        Renderer(SIZE, CAMERA, [item]).draw([np.zeros((3, 3))])
    with pytest.raises(UserError, match="2 x 2"):
        Renderer(2, CAMERA, [item])
    with pytest.raises(UserError, match="nothing to draw"):
        Renderer(SIZE, CAMERA, [])
    with pytest.raises(UserError, match="index 9"):
        DrawItem(item.points, np.array([[0, 1, 9]]), WHITE)
    with pytest.raises(UserError, match="uv"):
        DrawItem(item.points, item.triangles, plain(1.0, texture=Texture.of(np.zeros((2, 2, 3), np.uint8))))


def test_key_light_throws_a_soft_shadow() -> None:
    """A plate before a wall darkens the wall away from the light, not towards it, softly, and only if asked to."""
    grey = Material(colour=(0.7, 0.7, 0.7), specular=0.0, casts=True)
    items = [square(120.0, -40.0, grey), square(8.0, 0.0, grey)]
    lamp = Lighting(lights=(Light((-0.6, 0.0, 0.8), (0.7, 0.7, 0.7)),))
    row = {}
    for shadow in (True, False):
        look = Look(lamp, BLACK.background, shadow)
        row[shadow] = linear(Renderer(SIZE, CAMERA, items, look=look).draw()[SIZE // 2, :, 0] / 255.0)
    part = row[True] / row[False]
    shade = 32 + int(40 * 0.6 / 0.8)
    assert part[shade] < 0.75
    np.testing.assert_allclose(part[:24], 1.0, atol=0.02)
    assert (np.abs(np.diff(part[shade - 20 :])) < 0.2).all()


def test_shadow_reaches_the_rim_of_what_it_falls_on() -> None:
    """A shadow is as dark near the outline of a wall, behind which nothing is, as in its middle."""
    grey = Material(colour=(0.7, 0.7, 0.7), specular=0.0, casts=True)
    items = [square(28.0, -20.0, grey), square(20.0, 20.0, grey, x=-26.0)]
    lamp = Lighting(lights=(Light((-0.5, 0.0, 0.8), (0.7, 0.7, 0.7)),))
    out = {}
    for shadow in (True, False):
        out[shadow] = linear(Renderer(SIZE, CAMERA, items, look=Look(lamp, BLACK.background, shadow)).draw() / 255.0)
    column = slice(32 - 4, 32 + 8)  # shaded, and not hidden by the plate
    part = out[True][:, column, 0] / np.maximum(out[False][:, column, 0], 1e-3)
    assert part[32].max() < 0.6
    assert part[32 + 18].max() < part[32].max() + 0.1


def test_shadow_follows_what_throws_it() -> None:
    """Moving only the plate moves its shadow; a frame in which nothing moves is the same picture."""
    grey = Material(colour=(0.7, 0.7, 0.7), specular=0.0, casts=True)
    items = [square(120.0, -40.0, grey), square(8.0, 0.0, grey)]
    renderer = Renderer(SIZE, CAMERA, items, look=Look(Lighting(), BLACK.background))
    first = renderer.draw().copy()
    away = renderer.draw({1: items[1].points + np.array([0.0, -14.0, 0.0])}).copy()
    np.testing.assert_array_equal(away, renderer.draw())
    assert (np.abs(away.astype(int) - first).max(axis=2) > 8).sum() > 100
    np.testing.assert_array_equal(first, renderer.draw({1: items[1].points}))


def test_lying_surfaces_throw_no_shadow_on_themselves() -> None:
    """A lit ball that casts shadows looks as one that does not, but for a few pixels at its very rim."""
    points, quads = ball((0.0, 0.0, 0.0), 28.0, 48)
    look = Look(Lighting(), BLACK.background)
    one, two = (
        picture(DrawItem(points, quads, Material(specular=0.0, casts=casts)), look=look).astype(int)
        for casts in (True, False)
    )
    change = np.abs(one - two).max(axis=2)
    assert (change > 12).mean() < 0.005 and change.mean() < 0.5
