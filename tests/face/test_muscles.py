"""Muscles: zones that share a force, whatever the mesh, and files that say what is wrong with them."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from faceanim.body.body import PULL_ALONG
from faceanim.face.muscles import (
    LinearMuscle,
    SheetMuscle,
    SphincterMuscle,
    Terrain,
    build_muscles,
    mirrored,
    parse_muscles,
)
from faceanim.geometry.surface import TriMesh
from faceanim.ground.errors import AssetError

LINEAR = LinearMuscle(origin=(10.0, 40.0, -5.0), insertion=(20.0, 5.0, 0.0), force=100.0, radius=15.0)
SHEET = SheetMuscle(
    origin=(15.0, 40.0, 0.0), insertion=(15.0, 10.0, 0.0), force=80.0, half_width=12.0, length=15.0, galea=0.5
)
RING = SphincterMuscle(centre=(0.0, 0.0, 0.0), axes=(20.0, 10.0), force=50.0, width=0.6)


def terrain(step: float) -> Terrain:
    """A flat square of skin, 120 mm wide, symmetric about x = 0."""
    line = np.arange(-60.0, 60.0 + step / 2, step)
    x, y = np.meshgrid(line, line, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    m = len(line)
    i = (np.arange(m - 1)[:, None] * m + np.arange(m - 1)).ravel()
    triangles = np.concatenate([np.stack([i, i + m, i + m + 1], 1), np.stack([i, i + m + 1, i + 1], 1)])
    mesh = TriMesh(points, triangles)
    side = np.where(points[:, 1] >= 0, 1, -1).astype(np.int32)
    return Terrain(mesh.points, mesh.vertex_normals, mesh.vertex_areas, side, {}, ("cranium", "jaw"))


def total_force(table: dict, step: float) -> np.ndarray:
    """The sum of all fibre forces on undeformed skin at full activation, (3,) [mN]."""
    ground = terrain(step)
    fibres = build_muscles(table, ground)
    d = fibres.point - ground.points[fibres.node]
    length = np.sqrt((d**2).sum(axis=1, keepdims=True) + fibres.softening[:, None] ** 2)
    pull = np.where(fibres.kind[:, None] == PULL_ALONG, fibres.point, d / length)
    return (fibres.max_force[fibres.muscle] * fibres.weight) @ pull


@pytest.mark.parametrize("muscle", [LINEAR, RING])
def test_weights_of_a_muscle_sum_to_one(muscle):
    """The whole force is shared over the zone."""
    fibres = build_muscles({"m": muscle}, terrain(3.0))
    for k in range(len(fibres.names)):
        assert fibres.weight[fibres.muscle == k].sum() == pytest.approx(1.0, abs=1e-12)


def test_force_does_not_depend_on_the_mesh():
    """Four times as many vertices feel the same total force (the weights carry the area)."""
    table = {"m": LinearMuscle((10.0, 40.0, -5.0), (20.0, 5.0, 0.0), 100.0, 15.0, paired=False)}
    assert total_force(table, 1.5) == pytest.approx(total_force(table, 3.0), abs=0.6)


def test_paired_muscles_mirror_each_other():
    """Left and right pull with mirrored forces: nothing sideways remains."""
    assert abs(total_force({"m": LINEAR}, 3.0)[0]) < 1e-10


def test_galea_draws_the_scalp_back():
    """A sheet from the galea pulls its origin end towards the insertion with the given share of the force."""
    one = SheetMuscle(SHEET.origin, SHEET.insertion, 80.0, 12.0, 15.0, galea=0.5, paired=False)
    assert total_force({"m": one}, 3.0) == pytest.approx([0.0, 80.0 * 0.5, 0.0], abs=1e-9)


def test_side_confines_a_zone_to_one_lip():
    """A muscle of the upper lip pulls nothing below the mouth line."""
    muscle = LinearMuscle((10.0, 40.0, -5.0), (10.0, 2.0, 0.0), 100.0, 20.0, side="upper")
    fibres = build_muscles({"m": muscle}, terrain(3.0))
    assert (terrain(3.0).points[fibres.node, 1] >= 0).all()


@pytest.mark.parametrize("muscle", [LINEAR, SHEET])
def test_fibres_pull_towards_where_they_bend(muscle):
    """With a via the pull goes there and not to the origin; the twin's via is mirrored."""
    bent = msgspec.structs.replace(muscle, via=(50.0, 5.0, -4.0), paired=False)
    if isinstance(bent, SheetMuscle):
        bent = msgspec.structs.replace(bent, galea=0.0)
    x, y, _ = total_force({"m": bent}, 3.0)
    assert x > 0.8 * muscle.force
    assert abs(y) < 0.2 * muscle.force
    assert mirrored(bent).via == (-50.0, 5.0, -4.0)


def test_a_muscle_that_misses_the_skin_is_named():
    """An insertion far off the skin is an error that names the muscle."""
    with pytest.raises(AssetError, match="'lost_left'"):
        build_muscles({"lost": LinearMuscle((0, 0, 500.0), (0, 0, 400.0), 1.0, 5.0)}, terrain(3.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[a]\nkind = 'linear'", "origin"),
        ("[a]\nkind = 'spiral'", "spiral"),
        ("[a]\nkind = 'lid'\nforce = -2.0\nreach = 3.0", "'a'"),
        ("[a]\nkind = 'lid'\nforce = 2.0\nreach = 3.0\ncolour = 1", "colour"),
        ("[a\n", "muscles.toml"),
    ],
)
def test_broken_muscle_files_say_where(text, message):
    """Missing fields, unknown kinds, unknown fields, negative forces and bad TOML are named."""
    with pytest.raises(AssetError, match=message):
        parse_muscles(text, "muscles.toml")
