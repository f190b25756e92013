"""Mixed elements: flesh and shell move as one, agree with solid skin, and are the other models where that is asked."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from bodies import bridge
from layered import DEPTH, SIDE, SKIN, layered_body

from faceanim.backends import make_solver
from faceanim.backends.finite_elements.options import Options as Solid
from faceanim.backends.mixed_fem.options import MODELS, Options
from faceanim.backends.mixed_fem.tissues import beyond_limit, largest_stretch
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.face.skull import rotation
from faceanim.ground.errors import RunError, UserError


@cache
def slab(published: bool = False) -> Body:
    return layered_body(published=published)


def solver(body: Body | None = None, **options: Any) -> Any:
    return make_solver("mixed_fem", slab() if body is None else body, Options(**options))


def moved(body: Body, shift: tuple[float, float, float], activation: float = 0.0, both: bool = False) -> Control:
    control = Control.rest(body)
    control.activation[:] = activation
    control.bone_pose[1:, :3, 3] = shift
    if both:
        control.bone_pose[0, :3, 3] = shift
    return control


def surface(made: Any, state: Any) -> np.ndarray:
    out = np.empty_like(made.body.surface.points)
    made.surface(state, out)
    return out


def test_the_layer_becomes_a_shell_of_its_thickness() -> None:
    """Every triangle of the layer has a shell half-way between its sides; the flesh has lost the layer's elements."""
    made = solver()
    shells = made.skin.shells
    np.testing.assert_allclose([s.thickness for s in shells.sheets], SKIN)
    np.testing.assert_allclose(shells.middle(made.elements.points[made.skin.rows])[:, 2], -SKIN / 2, atol=1e-12)
    assert shells.area.sum() == pytest.approx(SIDE**2)
    assert made.skin.flesh.volumes.sum() == pytest.approx(SIDE**2 * (DEPTH - SKIN))
    np.testing.assert_allclose(made.nodes(made.rest()), made.solid.mesh.points, atol=1e-12)


def test_mass_is_kept() -> None:
    """The rows of positions weigh what the solid weighs."""
    made = solver()
    assert made.node_mass.sum() == pytest.approx(made.solid.node_mass.sum(), rel=1e-12)


def test_energy_and_forces_agree() -> None:
    """Forces of elements, shell and muscles through the shell's arms are minus the gradient of the whole energy."""
    made = solver()
    made._apply(moved(made.body, (0.0, 0.0, 0.0), 0.7))
    search = made._newton(())
    random = np.random.default_rng(3)
    x = made.elements.points + 0.05 * random.normal(size=made.elements.points.shape)
    zero = np.zeros_like(x)
    total, _ = search.forces(x)
    way = random.normal(size=x.shape)
    h = 1e-5
    slope = (search.energy(x + h * way, zero) - search.energy(x - h * way, zero)) / (2 * h)
    assert -float((total * way).sum()) == pytest.approx(slope, rel=1e-6)


def test_forces_on_the_surface_do_work() -> None:
    """Dead forces on the skin, too, are minus the gradient of their energy, moments included."""
    made = solver()
    control = Control.rest(made.body)
    control.force = np.random.default_rng(1).normal(size=made.body.surface.points.shape)
    made._apply(control)
    x = made.elements.points + 0.1 * np.random.default_rng(2).normal(size=made.elements.points.shape)
    way = np.random.default_rng(4).normal(size=x.shape)
    h = 1e-5
    slope = (made.pulls.energy(x + h * way) - made.pulls.energy(x - h * way)) / (2 * h)
    assert -float((made.pulls.forces(x) * way).sum()) == pytest.approx(slope, rel=1e-7)


def test_a_rigid_move_of_all_bones_is_free() -> None:
    """Bones that all turn by 25 degrees and shift carry the flesh with them: no energy, skin where they put it."""
    made = solver()
    control = Control.rest(made.body)
    turn, shift = rotation(np.array([0.3, 1.0, -0.2]), np.radians(25.0)), np.array([4.0, -3.0, 2.0])
    control.bone_pose[:, :3, :3], control.bone_pose[:, :3, 3] = turn, shift
    state = made.solve_static(control)
    np.testing.assert_allclose(surface(made, state), made.body.surface.points @ turn.T + shift, atol=1e-5)
    assert made.energy(state, control).elastic < 1e-6


def test_a_shell_on_flesh_is_as_stiff_as_solid_skin() -> None:
    """Half of the base is moved by 3 mm: the skin goes where quadratic solid skin goes, 0.1 mm off in the mean."""
    body = slab()
    control = moved(body, (2.0, 1.0, 2.0))
    mixed = solver()
    top = body.surface.points[:, 2] > -1e-9
    here = surface(mixed, mixed.solve_static(control))[top]
    judge = make_solver("finite_elements", body, Solid(order=2))
    there = surface(judge, judge.solve_static(control))[top]
    assert np.linalg.norm(there - body.surface.points[top], axis=1).max() > 2.0
    away = np.linalg.norm(here - there, axis=1)
    assert away.mean() < 0.12 and away.max() < 0.3


def test_the_linear_model_is_linear() -> None:
    """Twice the movement gives twice the displacement, in one Newton step."""
    made = solver(model="linear")
    body = made.body
    once = surface(made, made.solve_static(moved(body, (0.0, 0.0, 1.0)))) - body.surface.points
    twice = surface(made, made.solve_static(moved(body, (0.0, 0.0, 2.0)))) - body.surface.points
    np.testing.assert_allclose(twice, 2.0 * once, atol=1e-7)
    assert made.static_report.load_steps == 1


def test_one_tissue_has_the_mean_moduli() -> None:
    """The homogeneous models take the volume's mean shear and bulk modulus, mass is kept."""
    made = solver(model="nonlinear")
    solid = made.solid
    share = np.bincount(solid.region, solid.mesh.volumes) / solid.mesh.volumes.sum()
    for name in ("shear_modulus", "bulk_modulus"):
        mean = share @ np.array([getattr(m, name) for m in solid.materials])
        np.testing.assert_allclose([getattr(m, name) for m in made.materials], mean, rtol=1e-9)
    assert [m.density for m in made.materials] == [m.density for m in solid.materials]


@pytest.mark.parametrize("model", sorted(MODELS))
def test_all_models_follow_the_bone(model: str) -> None:
    """Each model finds a balance in which the skin over the moved bone goes along; at small strain all go nearly alike."""
    made = solver(model=model)
    state = made.solve_static(moved(made.body, (0.0, 0.0, 0.5)))
    over = (made.body.surface.points[:, 2] > -1e-9) & (made.body.surface.points[:, 0] > 10.0)
    lift = (surface(made, state) - made.body.surface.points)[over, 2]
    assert 0.3 < lift.mean() < 0.55


@pytest.mark.slow
def test_published_constants_are_unstable_and_said_so() -> None:
    """Under the printed Mooney-Rivlin constants the limits are told before a run, and what goes beyond them after it."""
    made = solver(slab(published=True), law="mooney_rivlin", shell=False)
    assert [line.split(":")[0] for line in made.notices] == ["skin", "fat", "muscle"]
    assert "1.0186" in made.notices[1]
    try:
        made.solve_static(moved(made.body, (0.0, 0.0, 1.0)))
        assert made.stretch_beyond["fat"] > 0.0
    except RunError:
        assert made.static_report.fraction < 1.0
    stable = solver(slab(published=True), law="tension")
    assert stable.notices == []
    stable.solve_static(moved(stable.body, (0.0, 0.0, 4.0)))
    assert stable.static_report.converged and stable.stretch_beyond["fat"] > 0.3


def test_the_published_tissue_can_be_asked_for() -> None:
    """`tissue` = "craniofacial" gives skin, fat and muscle the shear moduli of the paper's table."""
    made = solver(tissue="craniofacial")
    np.testing.assert_allclose([m.shear_modulus for m in made.materials], [70.143, 11.776, 41.230], rtol=1e-4)


def test_stretches_are_those_of_the_movement() -> None:
    """A slab that is pulled to 1.2 times its length everywhere has that stretch in every element."""
    mesh = slab().solid.mesh  # type: ignore[union-attr]
    stretch = largest_stretch(mesh, mesh.points * [1.2, 1.0, 1.0])
    np.testing.assert_allclose(stretch, 1.2, rtol=1e-9)
    made = solver(slab(published=True))
    assert beyond_limit(stretch, made.solid.region, made.materials) == {"skin": 1.0, "fat": 1.0, "muscle": 1.0}


def test_what_does_not_converge_keeps_the_last_balance() -> None:
    """An impossible movement ends in an error that says how far it came; the state reached is kept."""
    made = solver(most=4, least_step=0.25)
    with pytest.raises(RunError, match=r"no equilibrium beyond \d"):
        made.solve_static(moved(made.body, (0.0, 0.0, -60.0)))
    assert made.last_static is not None and np.isfinite(made.last_static.q).all()
    assert 0.0 <= made.static_report.fraction < 1.0


def test_a_body_without_a_layer_is_all_tetrahedra() -> None:
    """It is said that no shell was made."""
    made = make_solver("mixed_fem", bridge())
    assert made.shell is None and "no skin layer" in made.notices[0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"model": "best"}, "unknown mixed_fem: model 'best'"),
        ({"law": "hooke"}, "unknown mixed_fem: law"),
        ({"tissue": "bone"}, "unknown mixed_fem: tissue"),
        ({"step": 0.0}, "step = 0.0 must be positive"),
        ({"step": float("nan")}, "step = nan"),
        ({"tolerance": 2.0}, "tolerance = 2.0"),
        ({"most": 0}, "most = 0"),
        ({"least_step": 0.0}, "least_step"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], words: str) -> None:
    """The message names field, value and rule."""
    with pytest.raises(UserError, match=words):
        Options(**options)


def test_averaged_pressure_needs_a_law_that_has_one() -> None:
    """The mass tensor's law cannot be split."""
    with pytest.raises(UserError, match="knows no pressure"):
        solver(model="mass_tensor", pressure=True)
