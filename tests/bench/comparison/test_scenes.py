"""Scenes: loads that come smoothly and stay, probes that every density has, references known by what they are made from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faceanim.bench.comparison import scenes
from faceanim.bench.comparison.candidates import KINDS, candidates
from faceanim.bench.comparison.reference import key_of, packed, reference, unpacked
from faceanim.bench.comparison.scenes import SCENES, scene_named
from faceanim.body.control import Control
from faceanim.ground.errors import UserError

PLAIN = [name for name in SCENES if not name.startswith("face")]


@pytest.mark.parametrize("name", PLAIN)
def test_probes_are_vertices_at_every_density(name: str) -> None:
    """Each probe rests at the same place on the coarse and the default mesh, and bones hold none of them."""
    scene = SCENES[name]
    for density in ("coarse", "default"):
        body, vertex = scene.stage(density).body, scene.probe_vertices(density)
        np.testing.assert_allclose(body.surface.points[vertex], scene.probes, atol=1e-9)
        assert not body.pinned[vertex].any()


@pytest.mark.parametrize("name", sorted(SCENES))
def test_the_load_rises_smoothly_and_stays(name: str) -> None:
    """From nothing to all of it without a jump; a release has none from the beginning on."""
    scene = SCENES[name]
    shares = [scene.share(t) for t in np.linspace(0.0, scene.duration, 400)]
    if scene.release:
        assert max(shares) == 0.0
    else:
        assert shares[0] == 0.0 and shares[-1] == 1.0
        assert (np.diff(shares) >= 0.0).all() and np.diff(shares).max() < 0.02


@pytest.mark.parametrize("name", PLAIN)
def test_a_control_fits_its_body(name: str) -> None:
    """At every share; no share asks for nothing."""
    stage = SCENES[name].stage("coarse")
    for share in (0.0, 0.5, 1.0):
        stage.ask(share).reject_unfit(stage.body)
    nothing, rest = stage.ask(0.0), Control.rest(stage.body)
    np.testing.assert_allclose(nothing.bone_pose, rest.bone_pose, atol=1e-12)
    assert not nothing.gravity.any() and not nothing.activation.any()


def test_a_patch_of_skin_is_one_body_for_springs_and_solids() -> None:
    """Its surface is the top of its volume, held at the rim by the same shares of both bones."""
    body = SCENES["skin-pull"].stage("coarse").body
    assert body.solid is not None
    nodes = body.solid.skin.node[:, 0]
    np.testing.assert_allclose(body.solid.mesh.points[nodes], body.surface.points, atol=1e-12)
    held = body.solid.held[nodes]
    np.testing.assert_array_equal(held, body.pinned)
    np.testing.assert_allclose(body.solid.bone_weight[nodes][held], body.attachment.bone_weight[held], atol=1e-12)
    assert (body.surface.normals_by_area[:, 2] > 0.0).all()
    assert body.muscles.weight.sum() == pytest.approx(1.0)


def test_expressions_are_scenes_too() -> None:
    """`face-anger@0.5` is half of anger; bad names and intensities are refused with the list."""
    assert scene_named("face-anger@0.5").about == "Anger at 0.5 intensity."
    for name in ("face-anger@2", "face-anger@x", "face-anger@0"):
        with pytest.raises(UserError, match="intensity"):
            scene_named(name)
    with pytest.raises(UserError, match="bar-bend"):
        scene_named("bar-bent")


def test_references_are_known_by_what_they_are_made_from() -> None:
    """Another duration, level or name is another reference; the same scene is the same one."""
    scene = SCENES["bar-bend"]
    same = replace(scene)
    assert key_of(scene) == key_of(same)
    for changes in ({"duration": 0.9}, {"name": "x"}, {"levels": (scene.levels[0], scenes.Level("fine", 2, 8))}):
        assert key_of(replace(scene, **changes)) != key_of(scene)


def test_a_reference_survives_its_file() -> None:
    """Packed and unpacked again it is the same to half a unit of 1/4096 mm, and again exactly."""
    found = reference(SCENES["bar-tension"])
    again = unpacked(packed(found, "k"))
    np.testing.assert_allclose(again.motion, found.motion, atol=0.51 / 4096)
    twice = unpacked(packed(again, "k"))
    np.testing.assert_array_equal(twice.balance, again.balance)
    assert twice.text == found.text


def test_candidates_cover_every_backend_and_filters_are_checked() -> None:
    """All registered backends take part in the full comparison; filters that leave nothing say so."""
    everything = candidates("face-smile")
    assert {one.backend for one in everything} == set(KINDS)
    assert len({one.label for one in everything}) == len(everything)
    quick = candidates("face-smile", quick=True)
    assert {one.label for one in quick} <= {one.label for one in everything}
    with pytest.raises(UserError, match="mass_spring"):
        candidates("bar-bend", backends=("mass_sprung",))
    with pytest.raises(UserError, match="coarse"):
        candidates("bar-bend", densities=("thick",))
    with pytest.raises(UserError, match="nothing is left"):
        candidates("bar-bend", quick=True, backends=("octree_mass_spring",), densities=("fine",))


def test_every_candidate_has_sound_options() -> None:
    """Each setting is one that its backend knows and takes."""
    for scene in ("face-smile", "bar-bend"):
        for one in candidates(scene):
            options = one.options()
            assert all(getattr(options, name) == value for name, value in one.settings.items())
