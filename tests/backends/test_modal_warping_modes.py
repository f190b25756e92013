"""Modes: frequencies, normalisation, rotations, held nodes, the cache, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bars import bar, jawed_bar, solver_of
from bodies import held_sheet
from scipy.sparse.linalg import spsolve

from faceanim.backends.modal_warping.build import compute_modes, muscle_forces, rotation_matrix
from faceanim.backends.modal_warping.options import Options
from faceanim.backends.modal_warping.solver import SolverModalWarping
from faceanim.body.assembly import mass_matrix, stiffness_matrix
from faceanim.body.solid import solid_body
from faceanim.geometry.shapes import box_tets
from faceanim.ground.errors import UserError
from faceanim.ground.notes import listening
from faceanim.tissue.material import Material


@pytest.mark.parametrize(
    ("cells", "young", "hertz"),
    [
        ((10, 2, 2), 1.5e5, (0.4993, 0.5861, 2.592, 2.686, 2.903, 3.130, 6.140, 6.673)),
        pytest.param(
            (20, 4, 4), 2e5, (0.4860, 0.5195, 2.363, 2.607, 2.749, 3.570, 6.211, 6.490), marks=pytest.mark.slow
        ),
    ],
)
def test_frequencies_of_the_bar(cells: tuple[int, int, int], young: float, hertz: tuple[float, ...]) -> None:
    """Section 5: the first eight, to 1e-3, with the consistent mass and the Kuhn split."""
    modes = solver_of(bar(cells, young), 8).modes
    np.testing.assert_allclose(modes.frequencies, hertz, rtol=1e-3)


@pytest.mark.parametrize("mass", ["consistent", "lumped"])
@pytest.mark.parametrize("cells", [(3, 1, 1), (10, 2, 2)])
def test_modes_are_normalised_by_mass(cells: tuple[int, int, int], mass: str) -> None:
    """Phi^T M Phi = I to 1e-12, Phi^T K Phi = Lambda, and held nodes have rows of zeros, dense and sparse."""
    body = bar(cells)
    assert body.solid is not None
    modes = solver_of(body, 12, mass=mass).modes
    phi, m, k = modes.shapes(), mass_matrix(body.solid, lumped=mass == "lumped"), stiffness_matrix(body.solid)
    np.testing.assert_allclose(phi.T @ (m @ phi), np.eye(12), atol=1e-12)
    np.testing.assert_allclose(phi.T @ (k @ phi), np.diag(modes.squared), atol=1e-9 * modes.squared.max())
    assert (np.diff(modes.squared) >= 0.0).all()
    assert (modes.basis[body.solid.held][:, :3, :12] == 0.0).all()


@pytest.mark.parametrize("average", ["plain", "volume"])
def test_rotation_of_a_rigid_turn_is_its_axis(average: str) -> None:
    """Eq. 7: W gives the axis of an infinitesimal rotation exactly, so it averages and does not sum."""
    mesh = box_tets((4, 2, 2), (1.0, 0.2, 0.2), split="kuhn")
    axis = np.array([0.3, -0.7, 0.2])
    turned = rotation_matrix(mesh, average) @ np.cross(axis, mesh.points).ravel()
    np.testing.assert_allclose(turned.reshape(-1, 3), np.tile(axis, (len(mesh.points), 1)), atol=1e-14)
    valence = np.bincount(mesh.tets.ravel())
    assert valence.min() < 4 < 20 < valence.max()


def test_rotations_of_held_nodes_are_kept() -> None:
    """Neighbours of a held node move, so its row of Psi is not zero."""
    body = bar()
    assert body.solid is not None
    modes = solver_of(body, 4).modes
    assert np.abs(modes.rotations().reshape(-1, 3, 4)[body.solid.held]).max() > 0.0


def test_plain_and_volume_averages_agree_on_a_regular_bar() -> None:
    """All elements of a regular box have one volume, hence the two averages are one."""
    body = bar((4, 2, 2))
    plain, volume = (solver_of(body, 6, rotation_average=a).modes.basis for a in ("plain", "volume"))
    np.testing.assert_allclose(plain, volume, atol=1e-10)


def test_modes_come_back_from_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second build reads the same numbers; another material or more modes do not; progress is told."""
    monkeypatch.setenv("FACEANIM_CACHE", str(tmp_path))
    body = bar((4, 1, 1))
    assert body.solid is not None
    said: list[str] = []
    with listening(lambda what, done, total: said.append(what)):
        first = compute_modes(body.solid, Options(modes=5))
        assert any("vibration" in what for what in said)
        said.clear()
        second = compute_modes(body.solid, Options(modes=5))
    assert not said
    assert first.basis.tobytes() == second.basis.tobytes()
    stiffer = bar((4, 1, 1), 3e5)
    assert stiffer.solid is not None
    np.testing.assert_allclose(compute_modes(stiffer.solid, Options(modes=5)).squared, 2.0 * first.squared, rtol=1e-9)
    assert compute_modes(body.solid, Options(modes=6)).count == 6


def test_static_position_constraints_remove_freedoms() -> None:
    """Nodes in `held` do not move in any mode, and the frequencies rise."""
    body = bar((6, 1, 1))
    free, fixed = solver_of(body, 6), solver_of(body, 6, held=(24, 25, 0))
    assert (fixed.modes.basis[[24, 25]][:, :3, :6] == 0.0).all()
    assert (fixed.modes.squared > free.modes.squared).all()
    with pytest.raises(UserError, match="node 999 is outside"):
        solver_of(body, 6, held=(999,))


def test_a_lift_of_one_bone_is_the_rigid_motion() -> None:
    """If one bone holds all, its fields are the infinitesimal rigid motions, and they store no energy."""
    body = bar((4, 1, 1))
    modes = solver_of(body, 4).modes
    assert body.solid is not None
    x = body.solid.mesh.points
    for axis, unit in enumerate(np.eye(3)):
        np.testing.assert_allclose(modes.basis[:, :3, 4 + axis], np.cross(unit, x), atol=1e-10)
        np.testing.assert_allclose(modes.basis[:, 3:, 4 + axis], np.tile(unit, (len(x), 1)), atol=1e-10)
        np.testing.assert_allclose(modes.basis[:, :3, 7 + axis], np.tile(unit, (len(x), 1)), atol=1e-10)
    assert np.abs(modes.lift_stiffness).max() < 1e-8 * modes.squared[0]


def test_the_bone_that_stands_still_comes_last() -> None:
    """Fields of a jaw come before those of the cranium, which are then skipped."""
    assert solver_of(jawed_bar(), 4).modes.bone.tolist() == [1, 0]


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"modes": 0}, "modes = 0"),
        ({"modes": 2.5}, "modes = 2.5"),
        ({"variant": "warpd"}, "warped"),
        ({"integrator": "euler"}, "integrator"),
        ({"mass": "full"}, "mass"),
        ({"precision": "half"}, "precision"),
        ({"rotation_average": "none"}, "rotation average"),
        ({"held": (-1,)}, "held"),
        ({"static_tolerance": 0.0}, "static_tolerance"),
        ({"static_most": 0}, "static_most"),
    ],
)
def test_wrong_options_are_refused(changes: dict, match: str) -> None:
    """The message names the field."""
    with pytest.raises(UserError, match=match):
        Options(**changes)


def test_more_modes_than_freedoms_are_refused() -> None:
    """The message says how many there are; exactly as many are allowed."""
    body = bar((1, 1, 1))
    with pytest.raises(UserError, match="only 12 freedoms"):
        solver_of(body, 13)
    assert solver_of(body, 12).modes.count == 12


def test_bodies_that_cannot_vibrate_in_place_are_refused() -> None:
    """Free bodies, bodies held along a line, and bodies without a volume."""
    mesh = box_tets((4, 2, 2), (1.0, 0.2, 0.2))
    material = Material("rubber", 1000.0, 1e5, 0.3)
    with pytest.raises(UserError, match="free"):
        SolverModalWarping(solid_body(mesh, material, np.zeros(len(mesh.points), bool)), Options(modes=4, cache=False))
    line = np.flatnonzero((mesh.points[:, 0] < 1e-9) & (mesh.points[:, 1] < 1e-9))
    with pytest.raises(UserError, match="one line"):
        SolverModalWarping(solid_body(mesh, material, line), Options(modes=4, cache=False))
    with pytest.raises(UserError, match="volume"):
        SolverModalWarping(held_sheet(), Options(modes=4))


def test_the_answer_to_a_muscle_is_exact_with_few_modes() -> None:
    """With its static answer among them, few modes give a weak pull's displacement as full statics do; without, not."""
    body = jawed_bar()
    solid = body.solid
    assert solid is not None
    pull, free = muscle_forces(body, solid)[:, 0], np.repeat(~solid.held, 3)
    stiffness = stiffness_matrix(solid)
    exact = np.zeros(len(free))
    exact[free] = spsolve(stiffness[free][:, free].tocsc(), pull[free])
    error = []
    for own in (True, False):
        modes = solver_of(body, 4, "linear", muscle_modes=own).modes
        answer = modes.shapes() @ ((modes.shapes().T @ pull) / modes.squared)
        error.append(np.linalg.norm(answer - exact) / np.linalg.norm(exact))
        np.testing.assert_allclose(modes.shapes().T @ (modes.mass @ modes.shapes()), np.eye(modes.count), atol=1e-9)
    assert error[0] < 1e-9 < 0.02 < error[1]
