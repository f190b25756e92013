"""Contact of two sheets of skin: forces from an energy, action and reaction, balance, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from touching import pressed_slabs, two_slabs

from faceanim.elements.contact import settle
from faceanim.elements.sheet_contact import NamedSheets, SheetPenalty, coupled, opposed, sheet_table
from faceanim.elements.tetrahedra import Elements
from faceanim.geometry.embedding import Embedding, embed
from faceanim.geometry.surface import TriMesh
from faceanim.ground.errors import UserError
from faceanim.tissue.material import Material


def shaken(one: int = 3, other: int = 4, room: bool = True):  # type: ignore[no-untyped-def]
    """Return two slabs pushed 0.25 mm into the gap between them, with every node shaken."""
    elements, contact = pressed_slabs(one, other, room=room)
    x = elements.points + np.random.default_rng(0).normal(size=elements.points.shape) * 0.02
    x[elements.points[:, 2] > 5.15, 2] -= 0.25
    return elements, contact, x


def test_forces_are_the_derivative_of_the_energy() -> None:
    """Live and frozen, central differences of the energy give minus the forces."""
    _, contact, x = shaken()
    rng = np.random.default_rng(1)
    assert contact.report(x).active > 8
    for frozen in (False, True):
        if frozen:
            contact.freeze(x)
        force = contact.forces(x)
        for _ in range(4):
            way = rng.normal(size=x.shape)
            slope = (contact.energy(x + 1e-6 * way) - contact.energy(x - 1e-6 * way)) / 2e-6
            assert slope == pytest.approx(-(force * way).sum(), rel=1e-5)
    contact.thaw()
    assert np.abs(contact.forces(x) - force).max() < 1e-9 * np.abs(force).max()


def test_action_is_reaction() -> None:
    """What one slab gets the other gives, to rounding: no resultant force and no moment."""
    elements, contact, x = shaken()
    force = contact.forces(x)
    below = elements.points[:, 2] < 5.15
    size = np.abs(force).sum()
    assert np.linalg.norm(force[below].sum(axis=0)) > 0.5 * np.abs(force[below][:, 2]).sum()
    assert np.abs(force.sum(axis=0)).max() < 1e-12 * size
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-11 * size * 10.0


def test_action_is_reaction_for_embedded_skin() -> None:
    """The same for a skin that the nodes carry, and the energy is still one of the nodes."""
    mesh, surface, _, pair = two_slabs(3, 4)
    middle = np.where(surface.points[:, 2:] > 5.15, [[5.0, 5.0, 7.8]], [[5.0, 5.0, 2.5]])
    skin_surface = TriMesh(middle + 0.97 * (surface.points - middle), surface.triangles)
    skin = embed(mesh, skin_surface.points)
    elements = Elements(mesh, Material("flesh", 1e-6, 15.0, 0.3), coupled=coupled(skin_surface, [pair], skin))
    contact = SheetPenalty(elements, skin_surface, skin, [pair], 100.0)
    x = elements.points + np.random.default_rng(0).normal(size=elements.points.shape) * 0.02
    x[elements.points[:, 2] > 5.15, 2] -= 0.45
    force = contact.forces(x)
    way = np.random.default_rng(1).normal(size=x.shape)
    slope = (contact.energy(x + 1e-6 * way) - contact.energy(x - 1e-6 * way)) / 2e-6
    assert slope == pytest.approx(-(force * way).sum(), rel=1e-5)
    assert np.abs(force.sum(axis=0)).max() < 1e-12 * np.abs(force).sum()
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-10 * np.abs(force).sum()


def test_tangent_is_exact_where_there_is_room_and_a_bound_where_not() -> None:
    """Frozen, k A j j^T is the Hessian; without room for it, the tangent exceeds it by a non-negative matrix."""
    for room in (True, False):
        elements, contact, x = shaken(room=room)
        contact.freeze(x)
        values = np.zeros(len(elements.indices))
        contact.add_tangent(x, values)
        tangent = elements.matrix(values).toarray()
        assert np.abs(tangent - tangent.T).max() < 1e-9 * np.abs(tangent).max()
        rng = np.random.default_rng(3)
        for _ in range(3):
            way = rng.normal(size=x.shape)
            change = -(contact.forces(x + 1e-7 * way) - contact.forces(x - 1e-7 * way)).ravel() / 2e-7
            if room:
                assert np.abs(tangent @ way.ravel() - change).max() < 1e-5 * np.abs(change).max()
            else:
                assert way.ravel() @ tangent @ way.ravel() > way.ravel() @ change
        assert np.linalg.eigvalsh(tangent).min() > -1e-8 * np.abs(tangent).max()


def squeezed(one: int, other: int, way: float = 1.3, **options):  # type: ignore[no-untyped-def]
    """Return two slabs on smooth floors and walls pressed together by `way`, the contact and how the search went."""
    elements, contact = pressed_slabs(one, other)
    x = elements.points
    fixed = np.zeros(x.shape, dtype=bool)
    top = x[:, 2] > x[:, 2].max() - 1e-9
    fixed[top | (x[:, 2] < 1e-9), 2] = True
    fixed[:, :2] = (x[:, :2] < 1e-9) | (x[:, :2] > 10.0 - 1e-9)
    values = x.copy()
    values[top, 2] -= way
    there, report = settle(elements, (contact,), fixed=fixed, values=values, **options)
    return elements, contact, there, report


@pytest.mark.parametrize(("one", "other", "uneven"), [(4, 4, 2e-3), (4, 5, 0.03)])
def test_pressed_slabs_find_a_balance(one: int, other: int, uneven: float) -> None:
    """Contact patch test: each slab is squeezed by (1.3 - 0.2) / 10, evenly for like meshes, within 3 % for unlike ones."""
    elements, contact, x, report = squeezed(one, other)
    assert report.converged and report.valid
    touch = contact.report(x)
    assert touch.through == 0.0 and 0.0 < touch.deepest < 0.05
    stretch = np.einsum("eai,eaj->eij", x[elements.mesh.tets], elements.mesh.gradients)[:, 2, 2]
    assert np.average(stretch, weights=elements.mesh.volumes) == pytest.approx(1.0 - 0.11, abs=2e-3)
    assert np.abs(stretch - 0.89).max() < uneven
    assert np.abs(contact.forces(x).sum(axis=0)).max() < 1e-10 * touch.pressed


def test_slabs_apart_do_not_feel_each_other() -> None:
    """At rest, 0.3 mm apart with a gap of 0.1 mm, nothing acts."""
    elements, contact = pressed_slabs(3, 4)
    assert contact.energy(elements.points) == 0.0
    assert not contact.forces(elements.points).any()
    assert contact.report(elements.points).active == 0


def test_sheets_that_touch_at_rest_stay_at_rest() -> None:
    """Nearer than the gap at rest, vertices keep that distance: no force there, and one as soon as they come nearer."""
    mesh, surface, skin, pair = two_slabs(3, 4, gap=0.04)
    elements = Elements(mesh, Material("flesh", 1e-6, 15.0, 0.3))
    contact = SheetPenalty(elements, surface, skin, [pair], 100.0)
    x = elements.points.copy()
    assert contact.energy(x) == 0.0 and contact.report(x).active == 0
    x[x[:, 2] > 5.02, 2] -= 0.01
    assert contact.report(x).deepest == pytest.approx(0.01, abs=1e-9)
    assert contact.report(x).through == 0.0


def test_no_pairs_are_no_contact() -> None:
    """A body without sheets that face each other may still have the term."""
    mesh, surface, skin, _ = two_slabs(2, 2)
    elements = Elements(mesh, Material("flesh", 1e-6, 15.0, 0.3))
    assert coupled(surface, [], skin).shape == (0, 2)
    contact = SheetPenalty(elements, surface, skin, [], 10.0)
    values = np.zeros(len(elements.indices))
    contact.add_tangent(elements.points, values)
    assert contact.energy(elements.points) == 0.0 and not contact.forces(elements.points).any() and not values.any()


def test_reach_limits_what_is_coupled() -> None:
    """Fewer pairs of nodes are asked for when only candidates near at rest count."""
    _, surface, skin, pair = two_slabs(4, 5)
    near, everything = coupled(surface, [pair], skin, 0.5), coupled(surface, [pair], skin)
    assert 0 < len(near) < len(everything)
    assert set(map(tuple, near.tolist())) <= set(map(tuple, everything.tolist()))


def test_bad_input_is_named() -> None:
    """Stiffness, carriers, gaps, sides and lists that do not fit are refused."""
    mesh, surface, skin, pair = two_slabs(2, 2)
    elements = Elements(mesh, Material("flesh", 1e-6, 15.0, 0.3))
    for stiffness in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(UserError, match="stiffness = "):
            SheetPenalty(elements, surface, skin, [pair], stiffness)
    with pytest.raises(UserError, match="carried points"):
        SheetPenalty(elements, surface, Embedding.of_nodes(np.arange(3, dtype=np.int32)), [pair], 1.0)
    with pytest.raises(UserError, match="gap = -1"):
        opposed(surface, pair.node[:9], pair.node[9:], gap=-1.0)
    with pytest.raises(UserError, match="separate vertices"):
        opposed(surface, pair.node, pair.node, gap=0.1)
    with pytest.raises(UserError, match="start must run"):
        sheet_table(surface, [NamedSheets("x", pair.node, pair.start[:-1], pair.triangle, 0.1)])
    with pytest.raises(UserError, match=r"pair\.triangle"):
        sheet_table(surface, [NamedSheets("x", pair.node, pair.start, pair.triangle + 99999, 0.1)])
