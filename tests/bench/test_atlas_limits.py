"""Predicted limits of stability against what is measured and against eigenvalues of the whole step."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pytest

from faceanim.bench.atlas import bodies as atlas_bodies
from faceanim.bench.atlas import limits as atlas_limits
from faceanim.bench.atlas.bodies import Tune
from faceanim.bench.atlas.limits import Linearised, Mode
from faceanim.bench.atlas.maps import ACTIVE, QUICK, answer, time_trial, warmed
from faceanim.bench.atlas.schemes import TIME, Contender, contender
from faceanim.bench.atlas.trials import LEAST_STEPS, settling_steps, slowest_rate
from faceanim.ground.errors import DivergenceError, UserError


@lru_cache(maxsize=1)
def skin() -> Linearised:
    """The skin of the maps, linearised about its answer."""
    body = atlas_bodies.skin()
    control = atlas_bodies.pull(body, ACTIVE)
    return atlas_limits.linearised(body, who("newton").make(body).solve_static(control).q, control)


def who(scheme: str) -> Contender:
    """Return a scheme of the mass-spring backend as the maps try it."""
    return contender("mass_spring", scheme, TIME["mass_spring"][scheme])


def ring(n: int, k: float, mass: float, drag: float) -> Linearised:
    """Return n masses in a ring of equal springs, three independent directions."""
    one = 2.0 * np.eye(n) - np.roll(np.eye(n), 1, axis=0) - np.roll(np.eye(n), -1, axis=0) + 1e-6 * np.eye(n)
    bound = np.full(3 * n, k * (2.0 + 1e-6))
    return Linearised(k * np.kron(one, np.eye(3)), np.full(3 * n, mass), drag, bound, bound)


@pytest.mark.parametrize("drag", [0.0, 50.0])
@pytest.mark.parametrize("dt", [1e-3, 1e-2, 1e-1])
def test_the_closed_form_is_exact_for_linear_springs(dt: float, drag: float) -> None:
    """On a ring of equal springs the step of Eqs. 18-19 grows exactly from where the characteristic polynomial says."""
    chain = ring(12, 30.0, 1e-3, drag)
    limit = atlas_limits.paper_limit(atlas_limits.modes(chain), dt, drag)
    assert atlas_limits.paper_growth(chain, dt, 0.99 * limit) < 1.0
    assert atlas_limits.paper_growth(chain, dt, 1.01 * limit) > 1.0


def test_the_largest_growth_is_one_plus_the_root_of_two() -> None:
    """Neighbours extrapolated, a mode of eigenvalue 2 k: |mu| tends to 1 + sqrt 2 as dt^2 k / m grows (CORE 5, ii)."""
    worst = np.abs(Mode(2.0, 1.0, 1.0).roots(1e6, 0.0)).max()
    assert worst == pytest.approx(1.0 + math.sqrt(2.0), rel=1e-6)
    assert np.abs(Mode(2.0, 1.0, 1.0).roots(1e-3, 0.0)).max() <= 1.0 + 1e-9


@pytest.mark.parametrize("dt", [1e-3, 1e-2, 1e-1])
def test_the_closed_form_holds_on_skin(dt: float) -> None:
    """Where masses and stiffness differ from vertex to vertex it is within 2 % of the eigenvalues of the whole step."""
    limit = atlas_limits.paper_limit(atlas_limits.modes(skin()), dt, skin().drag)
    assert atlas_limits.paper_growth(skin(), dt, 0.98 * limit) < 1.0
    assert atlas_limits.paper_growth(skin(), dt, 1.02 * limit) > 1.0
    assert atlas_limits.grown_limit(skin(), dt, secant=False) == pytest.approx(limit, rel=0.02)


def test_secant_denominators_make_it_worse() -> None:
    """Secant sums are smaller than the bounds, most of all in compression: the printed scheme fails at smaller steps."""
    assert (skin().secant < skin().bound).all()
    tangent = atlas_limits.paper_limit(atlas_limits.modes(skin()), 0.01, skin().drag)
    assert atlas_limits.grown_limit(skin(), 0.01, secant=True) < 0.3 * tangent


def test_the_bounds_hold_what_present_neighbours_need() -> None:
    """Stiffness bounds of at least half the largest eigenvalue: the semi-implicit scheme is stable for every step."""
    assert atlas_limits.least_bound(skin()) >= 1.0
    found = atlas_limits.modes(skin())
    for factor in (1e-2, 1.0, 1e3, 1e9):
        assert atlas_limits.largest_root(found, 0.1, skin().drag, factor, ahead=False) < 1.0
    assert atlas_limits.largest_root([Mode(2.5, 1.0, 1.0)], 1e3, 0.0, 1.0, ahead=False) > 1.0


@pytest.mark.parametrize("dt", [1e-3, 1e-2])
@pytest.mark.parametrize("scheme", ["explicit, undivided", "paper"])
def test_measured_boundaries_lie_where_predicted(scheme: str, dt: float) -> None:
    """Just below the limit the skin stays, just above it runs away: within one cell of the usual grid (x 3.2)."""
    if scheme == "paper":
        limit = atlas_limits.grown_limit(skin(), dt, secant=True)
    else:
        limit = atlas_limits.explicit_limit(atlas_limits.largest_square(skin()), skin().drag, dt)
    warmed(who(scheme), atlas_bodies.skin())
    outcome = {}
    for share in (0.6, 1.8):
        goal = answer(who(scheme), atlas_bodies.skin(tune=Tune(stiffness=share * limit)), ACTIVE)
        try:
            outcome[share] = time_trial(who(scheme), goal, dt, QUICK).outcome
        except DivergenceError:
            outcome[share] = "not finite"
    assert outcome[0.6] in ("converged", "bounded but wrong")
    assert outcome[1.8] in ("not finite", "inverted")


def test_the_explicit_limit_without_drag_is_two_over_omega() -> None:
    """dt w < 2; the exact drag only lengthens it."""
    assert math.sqrt(atlas_limits.explicit_limit(1e6, 0.0, 1e-3)) * 1e3 * 1e-3 == pytest.approx(2.0)
    assert atlas_limits.explicit_limit(1e6, 100.0, 1e-3) > atlas_limits.explicit_limit(1e6, 0.0, 1e-3)


def test_a_denominator_vanishes_only_in_compression() -> None:
    """A negative secant sum s makes m (1 + dt D) + dt^2 f s zero at the limit, none does without (CORE 5, i)."""
    sound = ring(4, 30.0, 1e-3, 5.0)
    assert atlas_limits.secant_limit(sound, 0.01) == math.inf
    pressed = Linearised(sound.stiffness, sound.mass, 5.0, sound.bound, np.where(np.arange(12) < 3, -8.0, 60.0))
    limit = atlas_limits.secant_limit(pressed, 0.01)
    assert 1e-3 * (1.0 + 0.01 * 5.0) - 1e-4 * limit * 8.0 == pytest.approx(0.0, abs=1e-15)
    with pytest.raises(UserError, match="secant"):
        atlas_limits.modes(pressed, secant=True)


@pytest.mark.parametrize(("degrees", "lost"), [(30, 0.022), (60, 0.086), (90, 0.187), (120, 0.318), (180, 0.637)])
def test_warping_loses_length_as_its_closed_form_says(degrees: float, lost: float) -> None:
    """Pure bending: the chord is cos instead of sinc of half the turn (Choi & Ko; measured on an imposed
    mode but for 180 degrees, 2 / pi of the length)."""
    assert atlas_limits.length_loss(math.radians(degrees)) == pytest.approx(lost, rel=0.035)
    assert math.degrees(atlas_limits.turn_of_loss(0.05)) == pytest.approx(44.72, abs=0.1)


def test_the_safe_box_is_beta_cells_in_one_step() -> None:
    """The force moves the lightest free node by beta h in a step; proportional to beta; a corner moved by h / 6 against
    its three neighbours is where the Jacobian may vanish (1 - 6 beta)."""
    solver = contender("octree_mass_spring", "", {"levels": 1}).make(atlas_bodies.block(4))
    rig = solver.rig(solver.base)
    force = atlas_limits.safe_force(solver, 1.0 / 6.0)
    mass = rig.model.mass[rig.inverse_mass > 0].min()
    assert force * solver.substep**2 / mass == pytest.approx(rig.model.side.min() / 6.0)
    assert atlas_limits.safe_force(solver, 0.49) / force == pytest.approx(0.49 * 6.0)
    cell = rig.model.tables.cells.corner[0][None, :]
    x, side = rig.model.points.copy(), float(rig.model.side.min())
    corner = min(cell[0], key=lambda i: x[i].sum())
    near = [i for i in cell[0] if abs(np.abs(x[i] - x[corner]).sum() - side) < 1e-9]
    for beta, sound in ((0.99 / 6.0, True), (1.01 / 6.0, False)):
        y = x.copy()
        y[corner] += beta * side
        y[near] -= beta * side
        edges = np.stack([y[i] - y[corner] for i in near])
        assert (np.linalg.det(edges) * np.sign(np.linalg.det(x[near] - x[corner])) > 0.0) == sound


def test_settling_follows_the_slowest_vibration() -> None:
    """Underdamped D / 2, overdamped w^2 / D; never fewer than the least number of steps."""
    assert slowest_rate(1e4, 20.0) == 10.0
    assert slowest_rate(100.0, 1000.0) == pytest.approx(0.1, rel=1e-3)
    assert settling_steps(atlas_bodies.skin(), 1.0) == LEAST_STEPS
