"""Plans carried out on the skull: pieces, poses, what rides on them, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from faceanim.face.face import Face
from faceanim.face.library import load_face
from faceanim.ground.errors import UserError
from faceanim.surgery import cut
from faceanim.surgery.operation import Operation, bite, deepest, moved, operate, place_of, rotation_vector, samples
from faceanim.surgery.plan import load_plan, parse_plan, plan_names

BLOCK = """
title = "block"
[[piece]]
name = "block"
bone = "jaw"
planes = [{{ point = [0.0, -75.0, 80.0], normal = [0.0, -1.0, 0.0] }}]
{extra}
"""


@pytest.fixture(scope="module")
def face() -> Face:
    """Return the coarse face; its skull is that of the others."""
    loaded: Face = load_face("default", "coarse")
    return loaded


def _operation(face: Face, extra: str) -> Operation:
    return operate(face, parse_plan(BLOCK.format(extra=extra), "test"))


@pytest.mark.slow
@pytest.mark.parametrize("name", plan_names())
def test_every_built_in_plan_cuts_soundly(face: Face, name: str) -> None:
    """Pieces and rest are closed, volumes add up to 1e-6, and each piece is a middling part of its bone."""
    operation = operate(face, load_plan(name))
    for parent, whole in enumerate((face.cranium, face.jaw_mesh)):
        made = [m for m, p in zip(operation.bones, operation.parents, strict=True) if p == parent]
        assert all(cut.is_closed(m) for m in made)
        assert sum(cut.volume(m) for m in made) == pytest.approx(cut.volume(whole), rel=1e-6)
    for fragment in operation.fragments:
        assert 1e3 < cut.volume(fragment.mesh) < 2e5
        assert len(cut.parts(fragment.mesh)) == 1
        assert operation.walls(2).any() and not operation.walls(2).all()


def test_the_upper_teeth_go_with_the_upper_jaw(face: Face) -> None:
    """All of them; chin and lower teeth part company; the tongue goes with the body of the mandible."""
    upper = {p.name: p.bone for p in operate(face, load_plan("le_fort_1")).parts}
    assert upper["teeth_upper"] == upper["gums_upper"] == 2 and upper["teeth_lower"] == 1 and upper["eye_left"] == 0
    assert {p.name: p.bone for p in operate(face, load_plan("genioplasty")).parts}["teeth_lower"] == 1
    lower = {p.name: p.bone for p in operate(face, load_plan("mandible_advance")).parts}
    assert lower["teeth_lower"] == lower["tongue"] == 2
    assert sum(len(p.triangles) for p in operate(face, load_plan("le_fort_1")).parts) == sum(
        len(p.triangles) for p in face.parts
    )


def test_moves_follow_one_another(face: Face) -> None:
    """A turn about a landmark keeps it in place; a later shift is not turned; half-way is half the turn and shift."""
    turn = '[[piece.move]]\naxis = [0.0, 1.0, 0.0]\ndegrees = 10.0\nabout = "menton"\n'
    shift = "[[piece.move]]\ntranslation = [0.0, -2.0, 1.0]\n"
    chin = face.skull.landmarks["menton"]
    pose = _operation(face, turn).poses()[2]
    np.testing.assert_allclose(moved(chin[None], pose)[0], chin, atol=1e-9)
    both = _operation(face, turn + shift).fragments[0]
    np.testing.assert_allclose(moved(chin[None], both.pose())[0], chin + np.array([0.0, -2.0, 1.0]), atol=1e-9)
    np.testing.assert_allclose(rotation_vector(both.pose()[:3, :3]), [0.0, np.radians(10.0), 0.0], atol=1e-12)
    np.testing.assert_allclose(rotation_vector(both.pose(0.5)[:3, :3]), [0.0, np.radians(5.0), 0.0], atol=1e-12)
    np.testing.assert_allclose(both.pose(0.0), np.eye(4), atol=1e-12)
    middle = moved(both.centre[None], both.pose(0.5))[0]
    np.testing.assert_allclose(middle, both.centre + 0.5 * both.shift, atol=1e-9)


def test_a_turn_about_the_centroid_keeps_it(face: Face) -> None:
    """Also after a shift: the centroid is where the piece then is."""
    extra = "[[piece.move]]\ntranslation = [0.0, -4.0, 0.0]\n[[piece.move]]\naxis = [0.0, 1.0, 0.0]\ndegrees = 5.0\n"
    fragment = _operation(face, extra).fragments[0]
    np.testing.assert_allclose(fragment.shift, [0.0, -4.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(fragment.centre, cut.centroid(fragment.mesh))


def test_a_pair_is_mirrored(face: Face) -> None:
    """Left and right piece and their movements are mirror images."""
    text = """
title = "cheekbones"
[[piece]]
name = "malar"
bone = "cranium"
mirrored = true
boxes = [{ min = [38.0, -35.0, 55.0], max = [80.0, 0.0, 110.0] }]
[[piece.move]]
translation = [3.0, 0.0, 2.0]
[[piece.move]]
axis = [0.0, 1.0, 0.0]
degrees = 4.0
"""
    operation = operate(face, parse_plan(text, "test"))
    left, right = operation.fragments
    assert (left.name, right.name) == ("malar_left", "malar_right")
    flip = np.array([-1.0, 1.0, 1.0])
    assert cut.volume(left.mesh) == pytest.approx(cut.volume(right.mesh), rel=1e-3)
    np.testing.assert_allclose(right.centre, flip * left.centre, atol=0.05)
    np.testing.assert_allclose(right.shift, flip * left.shift, atol=1e-9)
    np.testing.assert_allclose(right.turn, -flip * left.turn, atol=1e-9)


def test_what_cannot_be_done_is_refused(face: Face) -> None:
    """Through other bone, too far, to an unknown place, or cutting nothing: the message says where and how much."""
    with pytest.raises(UserError, match=r"would go \d+\.\d mm into the rest of the jaw at x .*overlap"):
        _operation(face, "[[piece.move]]\ntranslation = [0.0, 6.0, 0.0]")
    with pytest.raises(UserError, match=r"carried 9\d mm; at most 60"):
        _operation(face, "[[piece.move]]\ntranslation = [0.0, -90.0, 0.0]")
    with pytest.raises(UserError, match=r"unknown landmark 'mentom'.*menton"):
        _operation(face, '[[piece.move]]\naxis = [1.0, 0.0, 0.0]\ndegrees = 2.0\nabout = "mentom"')
    plan = parse_plan(BLOCK.format(extra="").replace("-75.0", "-175.0"), "test")
    with pytest.raises(UserError, match="piece 'block' of the jaw: plane 1 leaves nothing"):
        operate(face, plan)
    plan = parse_plan(BLOCK.format(extra="").replace("-75.0", "175.0"), "test")
    with pytest.raises(UserError, match="whole bone"):
        operate(face, plan)


def test_overlap_may_be_allowed(face: Face) -> None:
    """The depth found is about that of the move, and an `overlap` above it lets it pass."""
    with pytest.raises(UserError):
        _operation(face, "[[piece.move]]\ntranslation = [0.0, 3.0, 0.0]")
    operation = _operation(face, "overlap = 3.5\n[[piece.move]]\ntranslation = [0.0, 3.0, 0.0]")
    depth, where, other = deepest(operation, 2, 1.0)
    assert depth == pytest.approx(3.0, abs=0.3) and other == 1
    assert -76.0 < where[1] < -71.0
    assert deepest(operation, 2, 0.0)[0] == pytest.approx(0.0, abs=1e-6)


def test_samples_lie_on_the_surface_and_near_each_other(face: Face) -> None:
    """Their number goes with the area."""
    jaw = face.jaw_mesh
    probes = samples(jaw)
    assert len(probes) > 0.25 * jaw.areas.sum()
    assert (probes >= jaw.points.min(axis=0)).all() and (probes <= jaw.points.max(axis=0)).all()


def test_the_bite_changes_as_the_teeth_go(face: Face) -> None:
    """The upper jaw 6 mm forward: so much more overjet; the chin alone: none."""
    operation = operate(face, load_plan("le_fort_1"))
    before, after = bite(operation, operation.poses(0.0)), bite(operation, operation.poses())
    assert 0.0 < before["overjet"] < 6.0 and 0.0 < before["overbite"] < 6.0
    assert after["overjet"] - before["overjet"] == pytest.approx(6.0)
    assert after["overbite"] == pytest.approx(before["overbite"])
    chin = operate(face, load_plan("genioplasty"))
    assert bite(chin, chin.poses()) == pytest.approx(before)


def test_places(face: Face) -> None:
    """Numbers, bone before skin, skin where no bone has that name."""
    np.testing.assert_array_equal(place_of(face, [1.0, 2.0, 3.0]), [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(place_of(face, "nasion"), face.skull.landmarks["nasion"])
    np.testing.assert_array_equal(place_of(face, "incisor_upper"), face.skull.incisor_upper)
    np.testing.assert_array_equal(place_of(face, "pronasale"), face.mesh.points[face.landmarks["pronasale"]])
