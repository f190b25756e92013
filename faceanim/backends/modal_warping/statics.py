"""The equilibrium Lambda q = g(q): by descent where the force has an energy, else by an accelerated fixed point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigvals
from scipy.optimize import minimize

from faceanim.ground.arrays import Floats

MEMORY = 8
"""How many steps the accelerated fixed point remembers."""
STAGES = (0.25, 0.5, 0.75)
"""Shares of the load under which a search from rest pauses, lest it end on a branch wound by a turn."""


@dataclass(eq=False)
class Balance:
    """The equilibrium problem in y = Lambda^(1/2) q, in which a linear body has the unit matrix as its stiffness.

    force : q (m,) -> generalised force (m,)   energy : q -> potential of the loads, None if the force has none
    evaluations : how often the force was asked for   share : of the load that acts
    """

    squared: Floats
    force: Callable[[Floats], Floats]
    energy: Callable[[Floats], float] | None = None
    evaluations: int = 0
    share: float = 1.0

    def __post_init__(self) -> None:
        self.root = np.sqrt(self.squared)

    def image(self, y: Floats) -> Floats:
        """Return Lambda^(-1/2) g(q): y itself at equilibrium."""
        self.evaluations += 1
        return np.asarray(self.share * self.force(y / self.root) / self.root)

    def slope(self, y: Floats) -> Floats:
        """Return the derivative of y - image(y), (m, m), by differences."""
        size = 1e-6 * max(float(np.linalg.norm(y)), 1e-9)
        base = self.image(y)
        columns = [(self.image(y + size * unit) - base) / size for unit in np.eye(len(y))]
        return np.eye(len(y)) - np.stack(columns, axis=1)


def _residual(y: Floats, image: Floats) -> float:
    scale = max(float(np.linalg.norm(image)), float(np.linalg.norm(y)), 1e-300)
    return float(np.linalg.norm(image - y)) / scale


def _descend(balance: Balance, y: Floats, most: int) -> Floats:
    """Minimise the energy from `y`."""
    energy = balance.energy
    assert energy is not None

    def value(y: Floats) -> tuple[float, Floats]:
        image = balance.image(y)
        return 0.5 * float(y @ y) + energy(y / balance.root), y - image

    scale = max(value(y)[0] ** 2, 1e-300) ** 0.5
    found = minimize(
        value, y, jac=True, method="L-BFGS-B", options={"maxfun": most, "ftol": 1e-15, "gtol": 1e-9 * scale**0.5}
    )
    return np.asarray(found.x)


def _accelerate(balance: Balance, y: Floats, tolerance: float, most: int) -> Floats:
    """Iterate y <- image(y), mixed over the last steps so that the linear part of the residual vanishes (Anderson)."""
    ys: list[Floats] = []
    rs: list[Floats] = []
    best, least = y, np.inf
    while balance.evaluations < most:
        image = balance.image(y)
        r = image - y
        error = _residual(y, image)
        if error < least:
            best, least = y, error
        if error < tolerance or error > 1e3 * least or not np.isfinite(error):
            break
        ys.append(y)
        rs.append(r)
        del ys[:-MEMORY], rs[:-MEMORY]
        if len(rs) == 1:
            y = y + 0.5 * r
            continue
        dr, dy = np.diff(rs, axis=0).T, np.diff(ys, axis=0).T
        share = np.linalg.lstsq(dr, r, rcond=1e-10)[0]
        y = y + 0.7 * r - (dy + 0.7 * dr) @ share
    return best


def _polish(balance: Balance, y: Floats, tolerance: float, most: int) -> tuple[Floats, float]:
    """Newton steps on the residual, halved until it falls; return the amplitudes and the relative residual."""
    image = balance.image(y)
    error = _residual(y, image)
    for _ in range(30):
        if error < tolerance or balance.evaluations > most or not np.isfinite(error):
            break
        move = np.linalg.lstsq(balance.slope(y), image - y, rcond=None)[0]
        for halving in range(8):
            trial = y + 0.5**halving * move
            trial_image = balance.image(trial)
            if np.linalg.norm(trial_image - trial) < np.linalg.norm(image - y):
                break
        else:
            break
        y, image = trial, trial_image
        error = _residual(y, image)
    return y, error


def equilibrium(balance: Balance, q: Floats, tolerance: float, most: int) -> tuple[Floats, float]:
    """Return the amplitudes (m,) of the equilibrium near `q`, and how far the relative residual fell."""
    y = q * balance.root
    if balance.energy is not None:
        y = _descend(balance, y, most)
    else:
        for balance.share in () if y.any() else STAGES:
            y = _accelerate(balance, y, 1e-2, most // 4)
        balance.share = 1.0
        y = _accelerate(balance, y, tolerance, most // 2)
    y, error = _polish(balance, y, tolerance, most)
    return y / balance.root, error


def growth_rate(balance: Balance, q: Floats, damping: Floats) -> float:
    """Return the largest growth rate of small motions about an equilibrium [1/s]: positive = it oscillates by itself.

    damping : (m,) [1/s]
    """
    m = len(q)
    stiffness = balance.root[:, None] * balance.slope(q * balance.root) * balance.root[None, :]
    flow = np.block([[np.zeros((m, m)), np.eye(m)], [-stiffness, -np.diag(damping)]])
    return float(eigvals(flow).real.max())
