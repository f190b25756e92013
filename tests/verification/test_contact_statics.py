"""A bone pushed into flesh: how deep it stays, bonded, sliding and imposed, and what steps and stiffness do."""

from __future__ import annotations

import numpy as np
import pytest
from touching import ball_below, block_bone, penalty, sides, slab, up

from faceanim.elements.contact import follow
from faceanim.elements.newton import newton

WAY = 5.0


def pushed(**options):  # type: ignore[no-untyped-def]
    """Return a slab held at its sides after a ball of radius 20 has come 5 mm into it, the contact and the way there."""
    elements = slab()
    held = sides(elements)
    contact = penalty(elements, held, [ball_below(elements.mesh)], options.pop("factor", 50.0))
    return elements, contact, follow(elements, contact, up(WAY), fixed=held, **options)


@pytest.fixture(scope="module")
def sliding():  # type: ignore[no-untyped-def]
    """The ball pushed in, with the penalty."""
    return pushed()


def test_penetration_stays_below_a_twentieth_of_a_millimetre(sliding) -> None:  # type: ignore[no-untyped-def]
    """At 50 E / h no node is 0.05 mm in the bone, by the exact distance to its triangles; no element is inverted."""
    _, contact, done = sliding
    assert done.reports[-1].converged and done.reports[-1].valid
    assert len(done.touches) >= 2  # 5 mm in steps below 3 mm
    touch = done.touches[-1]
    assert touch.active > 15 and 0.0 < touch.deepest < 0.05
    exact = contact.bones[0].exact(done.x[contact.touch.node], contact.poses[0])
    assert exact.max() < 0.05


def test_softer_penalty_goes_deeper() -> None:
    """Depth is pressure over stiffness: a fifth of the stiffness gives nearly five times the depth, beyond 0.05 mm."""
    deep = [pushed(factor=factor)[2].touches[-1].deepest for factor in (50.0, 10.0)]
    assert 4.0 < deep[1] / deep[0] < 5.2
    assert deep[1] > 0.05


def test_action_is_reaction(sliding) -> None:  # type: ignore[no-untyped-def]
    """The push of the bone is what the held nodes take up, and has no part across by symmetry."""
    elements, _, done = sliding
    force = done.touches[-1].force[0]
    held = sides(elements)
    support = elements.forces(done.x)[held].sum(axis=0)
    assert np.abs(support + force).max() < 1e-6 * abs(force[2])
    assert np.abs(force[:2]).max() < 1e-6 * abs(force[2])


def test_the_order_of_steps_does_not_matter(sliding) -> None:  # type: ignore[no-untyped-def]
    """Without friction the balance does not depend on the way: more, smaller steps end in the same place."""
    _, _, done = sliding
    _, _, finer = pushed(steps=6)
    assert len(finer.touches) == 6
    assert np.abs(finer.x - done.x).max() < 1e-6


def test_energy_falls_when_the_step_is_halved_back(sliding) -> None:  # type: ignore[no-untyped-def]
    """The energy that the bone's way has stored falls with the way: 5, 2.5, 1.25 mm; contact is a small part of it."""
    total = []
    for way in (WAY, WAY / 2.0, WAY / 4.0):
        elements, contact, done = pushed() if way != WAY else sliding
        if way != WAY:
            held = sides(elements)
            contact.move(up(0.0))
            done = follow(elements, contact, up(way), fixed=held)
        contact.move(up(way))
        total.append(elements.energy(done.x) + contact.energy(done.x))
        assert contact.energy(done.x) < 0.05 * total[-1]
    assert total[0] > 2.5 * total[1] > 6.0 * total[2] > 0.0


def test_bonded_sliding_and_imposed_differ_along_the_bone(sliding) -> None:  # type: ignore[no-untyped-def]
    """Imposed nodes end on the bone but stick where they met it; sliding flesh takes less force; bonded takes most."""
    elements, _, done = sliding
    _, other, stuck = pushed(impose=True)
    node = other.touch.node[np.flatnonzero(stuck.stuck[other.touch.node].all(axis=1))]
    assert len(node) > 15
    off = other.bones[0].exact(stuck.x[node], other.poses[0])
    assert np.abs(off).max() < 1e-6
    held = sides(elements)
    apart = np.linalg.norm(stuck.x - done.x, axis=1)
    assert 0.3 < apart.max() < 4.0
    bonded = held.copy()
    bonded[node] = True
    values = elements.points.copy()
    values[node, 2] += WAY
    x, report = newton(elements, fixed=bonded, values=values)
    assert report.converged
    energy = {"sliding": elements.energy(done.x), "imposed": elements.energy(stuck.x), "bonded": elements.energy(x)}
    assert energy["sliding"] < energy["imposed"] < energy["bonded"]


def test_flesh_slides_along_a_plane_bone() -> None:
    """Pushed up 1 mm and then along, a plane bone moves no flesh sideways; imposed on, it leaves it where it met it."""
    elements = slab((6, 6, 2))
    held = elements.points[:, 2] > 11.99
    bone = block_bone((-20.0, -20.0, -20.5), (60.0, 60.0, -0.5))
    contact = penalty(elements, held, [bone])
    first = follow(elements, contact, up(1.5), fixed=held)
    along = up(1.5)
    along[0, 0, 3] = 4.0
    second = follow(elements, contact, along, fixed=held, start=first.x)
    assert np.abs(second.x - first.x).max() < 1e-6
    assert abs(second.touches[-1].force[0, 0]) < 1e-9 * abs(second.touches[-1].force[0, 2])


@pytest.mark.slow
def test_quadratic_flesh_touches_as_well(sliding) -> None:  # type: ignore[no-untyped-def]
    """Quadratic elements, loaded at their mid-edge nodes, find the push within the meshes' difference."""
    _, _, done = sliding
    elements = slab((6, 6, 2), order=2)
    held = sides(elements)
    contact = penalty(elements, held, [ball_below(elements.mesh)])
    fine = follow(elements, contact, up(WAY), fixed=held)
    assert fine.touches[-1].deepest < 0.05
    assert abs(fine.touches[-1].force[0, 2] / done.touches[-1].force[0, 2] - 1.0) < 0.3
