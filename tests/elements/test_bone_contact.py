"""Contact of flesh with bone: forces from an energy, no friction, action and reaction, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from touching import YOUNG, ball_below, block_bone, penalty, sides, slab, up

from faceanim.elements.contact import (
    BonePenalty,
    BoneTouch,
    follow,
    imposed,
    near_bones,
    node_areas,
    penalty_stiffness,
    pose_between,
    settle,
    steps_needed,
)
from faceanim.elements.newton import newton
from faceanim.ground.errors import DivergenceError, UserError


def pushed(seed: int = 0):  # type: ignore[no-untyped-def]
    """Return a slab with a ball 1.5 mm in it, and shaken positions."""
    elements = slab((6, 6, 2))
    contact = penalty(elements, sides(elements), [ball_below(elements.mesh)])
    contact.move(up(1.5))
    return elements, contact, elements.points + np.random.default_rng(seed).normal(size=elements.points.shape) * 0.05


def test_forces_are_the_derivative_of_the_energy() -> None:
    """Central differences of the energy give minus the forces, also where lattice cells of the field meet."""
    _, contact, x = pushed()
    force = contact.forces(x)
    assert contact.report(x).active > 3
    rng = np.random.default_rng(1)
    for _ in range(5):
        way = rng.normal(size=x.shape)
        step = 1e-6
        slope = (contact.energy(x + step * way) - contact.energy(x - step * way)) / (2.0 * step)
        assert slope == pytest.approx(-(force * way).sum(), rel=1e-6)


def test_tangent_is_that_of_the_force_but_for_the_curvature() -> None:
    """k grad d grad d^T: positive, and off the derivative of the force by at most depth over radius."""
    elements, contact, x = pushed()
    values = np.zeros(len(elements.indices))
    contact.add_tangent(x, values)
    matrix = elements.matrix(values)
    assert np.linalg.eigvalsh(matrix.toarray()).min() > -1e-9
    way = np.random.default_rng(2).normal(size=x.shape)
    step = 1e-6
    change = -(contact.forces(x + step * way) - contact.forces(x - step * way)) / (2.0 * step)
    off = np.abs(matrix @ way.ravel() - change.ravel()).max() / np.abs(change).max()
    assert 0.0 < off < 2.0 * contact.report(x).deepest / 18.0 * 5.0


def test_force_is_along_the_normal_and_balanced_by_the_bone() -> None:
    """No friction: every force points away from the ball's centre; what the flesh gets the bone gives."""
    _, contact, x = pushed()
    force = contact.forces(x)
    centre = np.array([20.0, 20.0, -20.05 + 1.5])
    on = np.linalg.norm(force, axis=1) > 0.0
    away = x[on] - centre
    sine = (
        np.linalg.norm(np.cross(force[on], away), axis=1)
        / np.linalg.norm(force[on], axis=1)
        / np.linalg.norm(away, axis=1)
    )
    assert sine.max() < 0.02
    assert ((force[on] * away).sum(axis=1) > 0.0).all()
    assert np.abs(contact.report(x).force[0] + force.sum(axis=0)).max() < 1e-10 * np.abs(force).sum()


def test_apart_there_is_nothing() -> None:
    """Flesh that does not touch has neither energy nor force nor stiffness, and stays where it is."""
    elements = slab((4, 4, 2))
    contact = penalty(elements, sides(elements), [ball_below(elements.mesh)])
    values = np.zeros(len(elements.indices))
    contact.add_tangent(elements.points, values)
    assert contact.energy(elements.points) == 0.0
    assert not contact.forces(elements.points).any() and not values.any()
    assert contact.report(elements.points)[:3] == (0.0, 0, 0)


def test_a_buried_node_has_infinite_energy() -> None:
    """Behind the envelope no depth is known: the search for a balance must cut its step, and says when it cannot."""
    elements, contact, _ = pushed()
    contact.move(up(9.0))
    assert contact.energy(elements.points) == np.inf
    assert contact.report(elements.points).buried > 0
    assert np.isfinite(contact.forces(elements.points)).all()
    _, report = newton(elements, fixed=sides(elements), terms=(contact,))
    assert not report.converged


def test_allowance_makes_rest_stay_at_rest() -> None:
    """Flesh that is in a bone at rest is allowed that depth: no force until it goes deeper."""
    elements = slab((4, 4, 2))
    bone = ball_below(elements.mesh, gap=-0.4)
    contact = penalty(elements, sides(elements), [bone])
    assert contact.touch.allowance.max() == pytest.approx(0.4, abs=0.02)
    assert contact.energy(elements.points) == 0.0
    contact.move(up(0.5))
    assert contact.energy(elements.points) > 0.0


def test_candidates_are_free_boundary_nodes_within_reach() -> None:
    """Held nodes, inner nodes and those farther than the reach take no part; areas add up to those of their faces."""
    elements = slab((6, 6, 2))
    held = sides(elements)
    bone = ball_below(elements.mesh)
    touch = near_bones(elements.mesh, held, [bone], reach=2.0, young=YOUNG)
    assert len(touch.node) and not held[touch.node].any()
    assert np.isin(touch.node, elements.mesh.boundary_nodes).all()
    depth = bone.exact(elements.points)
    boundary = np.isin(np.arange(len(depth)), elements.mesh.boundary_nodes)
    assert np.array_equal(np.sort(touch.node), np.flatnonzero(boundary & ~held & (depth > -2.0)))
    quadratic = slab((3, 3, 1), order=2)
    for body in (elements, quadratic):
        faces = body.face_nodes(body.mesh.boundary_triangles)
        area = node_areas(body.points, faces)
        assert area.sum() == pytest.approx(2.0 * (40.0 * 40.0 + 2.0 * 40.0 * 12.0))
        load = body.traction(body.mesh.boundary_triangles, (0.0, 0.0, 1.0))
        assert np.abs(load[:, 2] - area).max() < 1e-9 * area.max()


def test_stiffness_is_modulus_over_edge() -> None:
    """50 E / h with the stiffest element at a node, whatever its softer neighbours."""
    elements = slab((4, 4, 2))
    faces = elements.mesh.boundary_triangles
    young = np.where(np.arange(len(elements.mesh.tets)) % 2, 5.0, YOUNG)
    got = penalty_stiffness(elements.mesh, YOUNG, faces, len(elements.points))
    assert np.abs(got[elements.mesh.boundary_nodes] / (50.0 * YOUNG / 11.4) - 1.0).max() < 0.6
    assert (penalty_stiffness(elements.mesh, young, faces, len(elements.points)) <= got).all()
    assert np.allclose(penalty_stiffness(elements.mesh, YOUNG, faces, len(elements.points), 10.0), got / 5.0)


def test_a_flat_punch_presses_evenly() -> None:
    """Patch test: a plane bone on a slab between smooth walls gives the uniform state, each node its area's share."""
    for order, cells in ((1, (4, 4, 2)), (2, (2, 2, 1))):
        elements = slab(cells, poisson=0.0, order=order)
        x = elements.points
        fixed = np.zeros(x.shape, dtype=bool)
        fixed[x[:, 2] > 11.99, 2] = True
        fixed[:, :2] = sides(elements)[:, None]
        bone = block_bone((-10.0, -10.0, -12.5), (50.0, 50.0, -0.5))
        contact = penalty(elements, np.zeros(len(x), dtype=bool), [bone])
        contact.touch.stiffness[:] = 100.0
        contact = BonePenalty(elements, contact.touch, [bone])
        contact.move(up(2.0))
        there, report = newton(elements, fixed=fixed, terms=(contact,))
        assert report.converged
        force = contact.forces(there)[contact.touch.node, 2]
        pressure = force[contact.touch.area > 0.0] / contact.touch.area[contact.touch.area > 0.0]
        assert np.ptp(pressure) < 1e-7 * pressure.mean()
        stretch = (there - x)[:, 2] / (12.0 - x[:, 2] + 1e-300)
        assert np.ptp(stretch[x[:, 2] < 11.0]) < 1e-8


def test_imposed_moves_points_out_along_the_normal() -> None:
    """du = d n: points in a ball end on it; those outside stay; a buried one moves only if a direction is known."""
    elements = slab((4, 4, 2))
    bone = ball_below(elements.mesh)
    centre = np.array([20.0, 20.0, -20.05])
    ray = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    points = centre + ray * np.array([[18.0], [19.0], [20.5], [3.0]])
    out = imposed(points, bone)
    assert out.chosen.tolist() == [0, 1] and out.buried.tolist() == [3]
    assert np.abs(bone.exact(points[out.chosen] + out.move)).max() < 1e-9
    assert np.abs(out.move - ray[:2] * [[2.0], [1.0]]).max() < 0.1  # its facets lean by 0.04
    paper = imposed(points, bone, reading="linear")
    assert 1e-4 < np.abs(bone.exact(points[:2] + paper.move)).max() < 0.03
    known = imposed(points, bone, last=np.tile([0.0, 0.0, -1.0], (4, 1)))
    assert known.chosen.tolist() == [0, 1, 3]
    assert known.move[2, 2] == pytest.approx(bone.thickness)
    with pytest.raises(UserError, match="sweeps = 0"):
        imposed(points, bone, sweeps=0)


def test_ways_are_cut_into_steps_that_the_field_can_follow() -> None:
    """No point of a bone moves farther in a step than the field allows; halfway poses are rigid and at the ends exact."""
    bone = block_bone((-5.0, -5.0, -5.0), (5.0, 5.0, 5.0))
    start, goal = np.eye(4)[None], up(12.0)
    assert steps_needed([bone], start, goal) == 4
    turn = np.eye(4)[None].copy()
    turn[0, :3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    count = steps_needed([bone], start, turn)
    last = start
    for k in range(1, count + 1):
        now = pose_between(start, turn, k / count)
        way = bone.surface.points @ (now - last)[0, :3, :3].T
        assert np.linalg.norm(way, axis=1).max() <= bone.step
        last = now
    assert np.abs(last - turn).max() < 1e-12


def test_bad_input_is_named() -> None:
    """Wrong shapes, indices, numbers and poses are refused with their names."""
    elements = slab((4, 4, 2))
    held, bone = sides(elements), ball_below(elements.mesh)
    for change, match in (
        ({"reach": 0.0}, "reach = 0"), ({"factor": -1.0}, "factor = -1"), ({"held": held[:5]}, "held has shape"),
        ({"among": [99999]}, "among"),
    ):  # fmt: skip
        options = {"held": held, "reach": 3.0, "young": YOUNG, **change}
        with pytest.raises(UserError, match=match):
            near_bones(elements.mesh, options.pop("held"), [bone], **options)  # type: ignore[arg-type]
    one, nothing = np.ones(1), np.zeros(1, np.int32)
    with pytest.raises(UserError, match="area"):
        BoneTouch(nothing, nothing, np.ones(2), one, one)
    with pytest.raises(UserError, match="stiffness must hold finite"):
        BoneTouch(nothing, nothing, one, one * np.nan, one)
    with pytest.raises(UserError, match=r"touch\.bone"):
        BonePenalty(elements, BoneTouch(nothing, nothing + 3, one, one, one), [bone])
    contact = penalty(elements, held, [bone])
    with pytest.raises(UserError, match="bone 0 is not rigid"):
        contact.move(up(1.0) * 1.1)
    with pytest.raises(UserError, match="shape"):
        contact.move(np.eye(4))
    with pytest.raises(UserError, match="steps = 0"):
        follow(elements, contact, up(1.0), fixed=held, steps=0)
    with pytest.raises(UserError, match="fixed must be bool"):
        follow(elements, contact, up(1.0), fixed=held[:3])


@pytest.mark.slow
def test_an_impossible_way_is_an_error() -> None:
    """A bone that goes right through held flesh leaves no balance, and that is said, not returned."""
    elements = slab((4, 4, 1), size=(20.0, 20.0, 3.0))
    held = elements.points[:, 2] > 2.99
    contact = penalty(elements, held, [block_bone((-5.0, -5.0, -20.5), (25.0, 25.0, -0.5))])
    with pytest.raises(DivergenceError, match="cannot follow the bones beyond"):
        follow(elements, contact, up(8.0), fixed=held, most=15)


def test_settling_without_sheets_is_one_search() -> None:
    """`settle` with nothing to find again is `newton`."""
    elements, contact, _ = pushed()
    contact.move(up(0.5))
    one, _ = settle(elements, (), fixed=sides(elements), terms=(contact,))
    other, _ = newton(elements, fixed=sides(elements), terms=(contact,))
    assert np.array_equal(one, other)
