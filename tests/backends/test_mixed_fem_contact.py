"""Contact in mixed elements: a bone that flesh does not grow on pushes it, and no more than that."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from layered import DEPTH, SIDE, layered_body

from faceanim.backends import make_solver
from faceanim.backends.mixed_fem.flesh import Flesh
from faceanim.backends.mixed_fem.options import Options
from faceanim.body.body import Body, Bone
from faceanim.body.control import Control
from faceanim.face.face import Face
from faceanim.face.skull import rotation
from faceanim.geometry.shapes import sphere
from faceanim.geometry.surface import TriMesh
from faceanim.ground.errors import UserError

RADIUS, GAP, WAY = 14.0, 0.05, 3.0


@cache
def cushion(bonded: bool = False) -> Body:
    """A slab whose lower rim the cranium holds, over a ball, the jaw; `bonded`: the ball holds what is near it."""
    body = layered_body(7)
    solid = body.solid
    assert solid is not None
    points = solid.mesh.points
    floor = points[:, 2] < -DEPTH + 1e-9
    rim = np.abs(points[:, :2]).max(axis=1) > SIDE / 2 - 1e-9
    weight = np.zeros((len(points), 2))
    weight[floor & rim, 0] = 1.0
    if bonded:
        weight[floor & (np.linalg.norm(points[:, :2], axis=1) < 8.0), 1] = 1.0
    ball = sphere(RADIUS, 4)
    under = TriMesh(ball.points + np.array([0.0, 0.0, -DEPTH - RADIUS - GAP]), ball.triangles)
    with_bone = replace(solid, bone_weight=weight)
    return replace(body, bones=(Bone("cranium"), Bone("jaw", surface=under)), volume=lambda: with_bone)


@cache
def made(contact: str, shell: bool = True, bonded: bool = False) -> Any:
    return make_solver("mixed_fem", cushion(bonded), Options(contact=contact, shell=shell))


def pushed(body: Body, way: float = WAY, along: float = 0.0) -> Control:
    control = Control.rest(body)
    control.bone_pose[1, :3, 3] = [along, 0.0, way]
    return control


def skin(solver: Any, state: Any) -> np.ndarray:
    out = np.empty_like(solver.body.surface.points)
    solver.surface(state, out)
    return out


@pytest.mark.parametrize("shell", [True, False])
def test_a_bone_pushes_flesh_that_does_not_grow_on_it(shell: bool) -> None:
    """A ball 3 mm into the slab lifts it, and no node is 0.05 mm in it."""
    solver = made("slide", shell)
    assert solver.contact_report(solver.rest()).touching == 0
    state = solver.solve_static(pushed(solver.body))
    report = solver.contact_report(state)
    assert report.touching > 3 and report.errors == 0
    assert 0.0 < report.deepest < 0.05
    lift = (skin(solver, state) - solver.body.surface.points)[:, 2].max()
    assert 0.6 * WAY < lift < WAY


def test_without_contact_the_bone_goes_through() -> None:
    """The film that is the default does not know of a bone that holds nothing."""
    solver = made("film")
    state = solver.solve_static(pushed(solver.body))
    np.testing.assert_allclose(skin(solver, state), solver.body.surface.points, atol=1e-9)
    assert solver.contact_report(state) is None


def test_sliding_has_no_friction_and_sticking_has() -> None:
    """A ball that goes sideways under the slab drags flesh that is bonded or sticks more than flesh that slides."""
    drag = {}
    for name, solver in (("slide", made("slide")), ("stick", made("stick")), ("bonded", made("film", bonded=True))):
        first = solver.solve_static(pushed(solver.body, 1.5))
        second = solver.solve_static(pushed(solver.body, 1.5, 1.5), first)
        under = np.linalg.norm(solver.solid.mesh.points - [0.0, 0.0, -DEPTH], axis=1) < 4.0
        drag[name] = (solver.nodes(second) - solver.nodes(first))[under, 0].mean()
    assert drag["bonded"] == pytest.approx(1.5)
    assert drag["slide"] < drag["stick"] + 1e-9
    assert drag["slide"] < 0.5 * drag["bonded"]


def test_sticking_takes_nodes_out_of_the_bone() -> None:
    """Imposed displacements leave no node in the bone; in steps of 1 mm the skin is lifted nearly as by sliding.

    In a single step of 3 mm nodes on the ball's flank leave it sideways and the skin stays lower.
    """
    slide = made("slide")
    top = slide.body.surface.points[:, 2] > -1e-9
    one = skin(slide, slide.solve_static(pushed(slide.body)))[top]
    away = []
    for step in (3.0, 1.0):
        stick = make_solver("mixed_fem", slide.body, Options(contact="stick", step=step))
        state = stick.solve_static(pushed(stick.body))
        assert stick.contact_report(state).deepest < 0.05
        away.append(np.linalg.norm(one - skin(stick, state)[top], axis=1).max())
    assert away[1] < 0.15 * WAY < away[0]
    with pytest.raises(UserError, match="no steps in time"):
        stick.step(state, state, pushed(stick.body), 0.01)


@pytest.mark.parametrize("contact", ["slide", "stick"])
def test_a_rigid_move_of_all_bones_is_free(contact: str) -> None:
    """Bones and flesh that turn and shift together do not push each other."""
    solver = made(contact)
    control = Control.rest(solver.body)
    turn, shift = rotation(np.array([0.3, 1.0, -0.2]), np.radians(25.0)), np.array([4.0, -3.0, 2.0])
    control.bone_pose[:, :3, :3], control.bone_pose[:, :3, 3] = turn, shift
    state = solver.solve_static(control)
    np.testing.assert_allclose(skin(solver, state), solver.body.surface.points @ turn.T + shift, atol=1e-5)
    assert solver.contact_report(state).touching == 0
    assert solver.energy(state, control).elastic < 1e-6


def test_bones_move_no_farther_than_their_field_knows() -> None:
    """A way of 5 mm is gone in at least two parts; the poses are read from the state, also half-way through a turn."""
    solver = made("slide")
    state = solver.solve_static(pushed(solver.body, 5.0))
    assert solver.static_report.load_steps >= 2
    flesh: Flesh = solver.flesh
    np.testing.assert_allclose(flesh.poses(state.q)[0, :3, 3], [0.0, 0.0, 5.0], atol=1e-12)
    control = Control.rest(solver.body)
    control.bone_pose[1, :3, :3] = rotation(np.array([0.0, 0.0, 1.0]), 0.4)
    half = 0.5 * (solver.rest().q + solver._placed(control.bone_pose, solver.rest().q))
    pose = flesh.poses(half)[0]
    np.testing.assert_allclose(pose[:3, :3], rotation(np.array([0.0, 0.0, 1.0]), 0.2), atol=1e-12)


def test_a_step_in_time_pushes_too() -> None:
    """While the ball moves up, the flesh goes along, never 0.1 mm in it."""
    solver = made("slide", False)
    state = solver.rest()
    for k in range(4):
        solver.step(state, state, pushed(solver.body, 0.4 * (k + 1)), 0.02)
        assert solver.contact_report(state).deepest < 0.1
    assert (skin(solver, state) - solver.body.surface.points)[:, 2].max() > 0.5


@pytest.mark.parametrize("shell", [True, False])
def test_the_film_is_taken_out_and_its_held_nodes_are_kept(shell: bool) -> None:
    """Elements of the material "gap" go; nodes that only they have still go with their bone, mass is kept."""
    body = cushion()
    solid = body.solid
    assert solid is not None
    middle = solid.mesh.points[solid.mesh.tets].mean(axis=1)
    film = (middle[:, 2] < -DEPTH + 4.0) & (np.abs(middle[:, :2]).max(axis=1) < 8.0)
    names = [*solid.materials, replace(solid.materials[-1], name="gap")]
    weight = solid.bone_weight.copy()
    weight[(solid.mesh.points[:, 2] < -DEPTH + 1e-9) & (weight[:, 0] == 0.0), 1] = 1.0
    filmed = replace(solid, materials=tuple(names), region=np.where(film, 3, solid.region).astype(np.int32),
                     bone_weight=weight)  # fmt: skip
    solver = make_solver("mixed_fem", replace(body, volume=lambda: filmed), Options(contact="slide", shell=shell))
    assert len(solver.flesh.mesh.tets) == (~film & ((solid.region != 0) | (not shell))).sum()
    assert solver.node_mass.sum() == pytest.approx(solid.node_mass.sum())
    np.testing.assert_allclose(solver.nodes(solver.rest()), solid.mesh.points, atol=1e-12)
    lost = np.setdiff1d(np.unique(solid.mesh.tets[film]), np.unique(solid.mesh.tets[~film]))
    assert len(lost)
    there = solver.nodes(solver.solve_static(pushed(solver.body, 0.5)))
    np.testing.assert_allclose((there - solid.mesh.points)[lost], np.tile([0.0, 0.0, 0.5], (len(lost), 1)), atol=1e-12)


def test_bad_input_is_refused() -> None:
    """An unknown way to touch, and a body without bones to touch."""
    with pytest.raises(UserError, match="unknown mixed_fem: contact 'glue'"):
        Options(contact="glue")
    with pytest.raises(UserError, match="no bone of this body has one"):
        make_solver("mixed_fem", layered_body(3), Options(contact="slide"))


@pytest.mark.slow
def test_a_jaw_in_motion_touches_the_coarse_face() -> None:
    """With the jaw 2 mm forward, free flesh stays out of bones and teeth, and the lips stay out of each other."""
    body = Face.from_assets("default", "coarse").body()
    solver = make_solver("mixed_fem", body, Options(contact="slide"))
    assert solver.energy(solver.rest(), Control.rest(body)).elastic < 1e-9
    control = Control.rest(body)
    control.bone_pose[1, 2, 3] = 2.0
    report = solver.contact_report(solver.solve_static(control))
    assert report.bones == 2 and report.nodes > 50
    assert report.deepest < 0.05 and report.errors == 0 and report.through < 0.1
