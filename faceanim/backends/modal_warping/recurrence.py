"""One time step of uncoupled oscillators q'' + c q' + k q = f as a linear map of (q, q', f)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from faceanim.ground.arrays import Floats


@dataclass(frozen=True, eq=False)
class Recurrence:
    """q = a q0 + b q0' + g f and q' = c q0 + d q0' + e f, each (m,); `g` is the gamma of Eq. 19."""

    a: Floats
    b: Floats
    g: Floats
    c: Floats
    d: Floats
    e: Floats


def make_recurrence(integrator: str, k: Floats, c: Floats, h: float) -> Recurrence:
    """Return the step of length `h` [s] for stiffness `k` [1/s^2] and damping `c` [1/s], (m,) each, and unit mass.

    integrator : "semi_implicit" (Eq. 19: backward Euler with the force of the beginning), "exact" for a constant force,
    "trapezoid"
    """
    if integrator == "semi_implicit":
        d = 1.0 + h * c + h * h * k
        alpha, beta, gamma = 1.0 - h * h * k / d, h / d, h * h / d
        return Recurrence(alpha, beta, gamma, -h * k / d, 1.0 / d, h / d)
    if integrator == "trapezoid":
        d = 1.0 + 0.25 * h * h * k + 0.5 * h * c
        rate, own, push = -h * k / d, (1.0 - 0.25 * h * h * k - 0.5 * h * c) / d, h / d
        return Recurrence(1.0 + 0.5 * h * rate, 0.5 * h * (1.0 + own), 0.5 * h * push, rate, own, push)
    flow = np.zeros((len(k), 3, 3))
    flow[:, 0, 1] = h
    flow[:, 1] = np.stack([-h * k, -h * c, np.full_like(k, h)], axis=1)
    e = expm(flow)
    return Recurrence(e[:, 0, 0], e[:, 0, 1], e[:, 0, 2], e[:, 1, 0], e[:, 1, 1], e[:, 1, 2])
