"""Motion of the bar after a pulse against a neo-Hookean reference (section 5, Fig. 6), and the order of the steps."""

from __future__ import annotations

import numpy as np
import pytest
from bars import bar, displaced, hanging, mass_norm, solver_of
from neo_hookean import NeoHookean

from faceanim.body.control import Control


@pytest.mark.slow
@pytest.mark.parametrize(("g", "warped", "linear"), [(1.96, 0.036, 0.049), (9.8, 0.182, 0.240), (19.6, 0.431, 0.553)])
def test_free_swing_after_a_pulse(g: float, warped: float, linear: float) -> None:
    """Fig. 6: gravity during 0.1 s, then free; error over space and 4 s, undamped, trapezoid rule, dt = .01."""
    body = bar()
    assert body.solid is not None
    exact = NeoHookean(body.solid)
    truth = exact.swing(np.array([0.0, -g, 0.0]), 0.1, 0.01, 400)
    size = np.sqrt(sum(mass_norm(exact.mass, u) ** 2 for u in truth))
    for variant, expected in (("warped", warped), ("linear", linear)):
        solver = solver_of(body, 30, variant, integrator="trapezoid")
        state, error = solver.rest(), 0.0
        for k, u in enumerate(truth):
            solver.step(state, state, hanging(body, g if k < 10 else 0.0), 0.01)
            error += mass_norm(exact.mass, displaced(solver, state) - u) ** 2
        assert np.sqrt(error) / size == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(("integrator", "order"), [("semi_implicit", 1.0), ("trapezoid", 2.0)])
def test_order_of_the_steps(integrator: str, order: float) -> None:
    """A free swing converges to the exact one at first and second order in the step."""
    body = bar(stiffness_damping=0.01)
    exact = solver_of(body, 3, integrator="exact")
    solver = solver_of(body, 3, integrator=integrator)
    start, errors = exact.solve_static(hanging(body, 5.0)), []
    for count in (200, 400):
        truth, state = start.copy(), start.copy()
        for _ in range(count):
            exact.step(truth, truth, Control.rest(body), 1.0 / count)
            solver.step(state, state, Control.rest(body), 1.0 / count)
        errors.append(np.linalg.norm(state.q - truth.q))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


def test_the_period_does_not_depend_on_the_amplitude() -> None:
    """T8: without load every mode swings at its own frequency, however far."""
    body = bar()
    solver = solver_of(body, 1, integrator="exact")
    period = 1.0 / solver.modes.frequencies[0]
    for scale in (0.01, 1.0, 20.0):
        state = solver.rest()
        state.q[0] = scale
        for _ in range(10):
            solver.step(state, state, Control.rest(body), period / 10.0)
        assert state.q[0] == pytest.approx(scale, rel=1e-9)
