"""The skin after an operation: what goes with which bone, and the balance between."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faceanim.backends import BACKENDS
from faceanim.backends.finite_elements.options import Options
from faceanim.face import attach
from faceanim.face.face import Face
from faceanim.face.library import load_face
from faceanim.ground.errors import RunError
from faceanim.surgery import distance_map, files
from faceanim.surgery.operation import Operation, moved, operate
from faceanim.surgery.plan import load_plan, parse_plan, plan_names
from faceanim.surgery.predict import Prediction, predict, surgical_body

STILL = """
title = "a cut without a move"
[[piece]]
name = "maxilla"
bone = "cranium"
keep = "largest"
planes = [
    { point = [0.0, -28.0, 90.0], normal = [0.0, -1.0, 0.0] }, { point = [0.0, -28.0, 50.0], normal = [0.0, 0.0, 1.0] },
]
"""


@pytest.fixture(scope="module")
def face() -> Face:
    """Return the coarse face."""
    loaded: Face = load_face("default", "coarse")
    return loaded


@pytest.fixture(scope="module")
def advance(face: Face) -> Operation:
    """Return the upper jaw moved forward."""
    return operate(face, load_plan("le_fort_1"))


@pytest.fixture(scope="module")
def quick(advance: Operation) -> Prediction:
    """Return the linear preview of it."""
    return predict(advance.face, advance, options=Options(law="linear"), steps=1)


def test_the_body_knows_all_bones(face: Face, advance: Operation) -> None:
    """Weights are shares of three bones; what a cut takes from the cranium the piece gets; scalp and ears stay."""
    body, whole = surgical_body(advance), face.body()
    assert [b.name for b in body.bones] == ["cranium", "jaw", "maxilla"]
    solid, old = body.solid, whole.solid
    assert solid is not None and old is not None
    np.testing.assert_array_equal(solid.held, old.held)
    np.testing.assert_allclose(solid.bone_weight.sum(axis=1), old.bone_weight.sum(axis=1), atol=1e-12)
    np.testing.assert_allclose(solid.bone_weight[:, 1], old.bone_weight[:, 1], atol=0.07)
    assert 20 <= (solid.bone_weight[:, 2] > 1.0 - 1e-12).sum() < 0.5 * solid.held.sum()
    skin = body.attachment.bone_weight
    np.testing.assert_allclose(skin[:, [0, 2]].sum(axis=1), whole.attachment.bone_weight[:, 0], atol=1e-12)
    stays = np.isin(face.region, (attach.SCALP, attach.EAR))
    assert not body.attachment.bone_weight[stays, 2].any()
    assert body.bone_contact is not None and set(body.bone_contact.bone) == {0, 1, 2}
    assert surgical_body(advance, contact=False).bone_contact is None
    assert 2 in body.muscles.bone and body.muscles.names == whole.muscles.names


def test_skin_at_rest_is_carried_to_its_place(face: Face, advance: Operation) -> None:
    """With all bones at rest the nodes put every skin vertex where it was; with all moved alike, so does the skin."""
    solid = surgical_body(advance, contact=False).solid
    old = face.body().solid
    assert solid is not None and old is not None
    before = old.skin.apply(old.mesh.points)
    np.testing.assert_allclose(solid.skin.apply(solid.mesh.points), before, atol=1e-9)
    pose = advance.poses(1.0)[2]
    np.testing.assert_allclose(solid.skin.apply(moved(solid.mesh.points, pose)), moved(before, pose), atol=1e-9)


def test_a_cut_without_a_move_moves_nothing(face: Face) -> None:
    """Rest stays rest."""
    found = predict(face, parse_plan(STILL, "test"))
    assert found.fraction == 1.0 and found.steps == 1
    assert np.abs(found.points - face.mesh.points).max() < 1e-6


def test_held_nodes_go_with_their_piece_and_the_skin_follows(advance: Operation, quick: Prediction) -> None:
    """Exactly on the piece; the upper lip comes forward by most of the way, forehead and chin stay."""
    solid, nodes = quick.body.solid, quick.nodes
    assert solid is not None and nodes is not None
    on = solid.bone_weight[:, 2] > 1.0 - 1e-12
    assert on.sum() >= 20
    np.testing.assert_allclose(nodes[on], solid.mesh.points[on] + [0.0, 0.0, 6.0], atol=1e-9)
    way = quick.points - advance.face.mesh.points
    marks = advance.face.landmarks
    assert 2.0 < way[marks["labrale_superius"], 2] < 6.5
    assert np.abs(way[[marks["glabella"], marks["pogonion"]]]).max() < 0.3
    mirrored = way[advance.face.mirror] * [-1.0, 1.0, 1.0]
    assert np.abs(way - mirrored).max() < 0.05 * np.abs(way).max()


def test_the_movement_map_agrees_with_the_movement(advance: Operation, quick: Prediction) -> None:
    """Nothing is farther from the old skin than it has gone, and the lips have come forward."""
    face = advance.face
    after = type(face.mesh)(quick.points, face.mesh.triangles)
    distance = distance_map.compare(after, face.mesh)
    way = np.linalg.norm(quick.points - face.mesh.points, axis=1)
    regions = distance_map.face_regions(face)
    assert (np.abs(distance) <= way + 1e-6)[regions["face"]].all()
    rows = distance_map.table(distance, after, regions, way > distance_map.MOVED)
    assert rows["lips, moved"].signed_mean > 1.0 and rows["forehead"].max < 0.3


def test_strains_of_known_movements(advance: Operation, quick: Prediction) -> None:
    """None in a turned body; those of a stretch along x in a stretched one; an inverted element is seen."""
    solid = quick.body.solid
    assert solid is not None
    turned = files.strains(solid, moved(solid.mesh.points, advance.poses()[2]))
    assert np.abs(turned["volume_ratio"] - 1.0).max() < 1e-9 and turned["von_mises_strain"].max() < 1e-6
    stretched = files.strains(solid, solid.mesh.points * [2.0, 1.0, 1.0])
    np.testing.assert_allclose(stretched["largest_stretch"], 2.0)
    np.testing.assert_allclose(stretched["von_mises_strain"], 2.0 / 3.0 * np.log(2.0))
    assert (files.strains(solid, solid.mesh.points * [-1.0, 1.0, 1.0])["least_stretch"] < 0.0).all()


def test_a_failure_keeps_what_was_reached(face: Face, advance: Operation, monkeypatch: pytest.MonkeyPatch) -> None:
    """One of three steps and half of the next: half the way, the skin of that place, and words that say so."""
    monkeypatch.setitem(BACKENDS, "halting", "halting:SolverHalting")
    told: list[tuple[int, int]] = []
    found = predict(face, advance, backend="halting", steps=3, heard=lambda *t: told.append(t))
    assert found.fraction == pytest.approx(0.5) and told == [(0, 3), (1, 3)]
    assert found.failure is not None and "50.0%" in found.failure and "--steps" in found.failure
    solid, nodes = found.body.solid, found.nodes
    assert solid is not None and nodes is not None
    on = solid.bone_weight[:, 2] > 1.0 - 1e-12
    assert on.sum() >= 20
    np.testing.assert_allclose(nodes[on], solid.mesh.points[on] + [0.0, 0.0, 3.0], atol=1e-9)
    np.testing.assert_allclose(found.points, solid.skin.apply(nodes))
    with pytest.raises(RunError, match="no balance"):
        found.raise_failure()


def test_a_solver_given_too_few_steps_fails_in_words(face: Face, advance: Operation) -> None:
    """One Newton step at 1e-9 is too little for any nonlinear balance; the skin is then that of rest."""
    options = Options(most=1, least_step=1.0)
    found = predict(face, advance, options=options)
    assert found.failure is not None and found.fraction == 0.0
    assert np.isfinite(found.points).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", plan_names())
def test_every_built_in_plan_finds_its_balance(name: str) -> None:
    """On the default face: all the way, no inverted element, symmetric, and no skin outruns the bone by a fifth."""
    face: Face = load_face()
    found = predict(face, load_plan(name))
    found.raise_failure()
    solid, nodes = found.body.solid, found.nodes
    assert solid is not None and nodes is not None
    assert files.strains(solid, nodes)["volume_ratio"].min() > 0.0
    way = found.points - face.mesh.points
    travel = found.operation.travel
    assert 0.5 * travel < np.linalg.norm(way, axis=1).max() < 1.2 * travel
    assert np.abs(way - way[face.mirror] * [-1.0, 1.0, 1.0]).max() < 0.05 * travel
    assert found.seconds["solve"] < 60.0


@pytest.mark.slow
def test_steps_do_not_change_the_balance(face: Face, advance: Operation) -> None:
    """One load step or four lead to the same skin."""
    one, four = (predict(face, advance, steps=k) for k in (1, 4))
    assert np.abs(one.points - four.points).max() < 0.01


@pytest.mark.slow
def test_contact_grids_are_those_of_bones_with_teeth(advance: Operation) -> None:
    """Teeth lie inside the grid of the bone that carries them and of no other."""
    body = surgical_body(advance)
    teeth = advance.teeth(2)[-1].points
    assert body.bones[2].grid is not None and body.bones[1].grid is not None
    assert np.median(body.bones[2].grid.sample(teeth)) < 0.6
    assert replace(body).bones[1].grid.sample(teeth).min() > -2.0  # type: ignore[union-attr]
