"""Limits that theory predicts, to be drawn over the measured maps.

Explicit: dt < 2 / w_max. The scheme of Zhang, Prakash & Sung (Eqs. 18-19): each mode of the linearised step obeys a
quadratic, whose roots leave the unit circle (`Mode`); its secant stiffness makes denominators vanish in compression.
With neighbours at their present place the scheme is stable for every step if the stiffness bounds are at least half of
the largest eigenvalue. Lattices: the safe box beta h m / dt^2 and dt_crit. Warping: sinc and cosine of half the turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import eigh, eigvals

from faceanim.backends.mass_spring import kernels
from faceanim.backends.mass_spring.build import Tables
from faceanim.backends.mass_spring.load import Load
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError


@dataclass(frozen=True, eq=False)
class Linearised:
    """A skin's free vertices linearised: symmetric `stiffness` (3m, 3m) [mN/mm], `mass` (3m,) [kg], drag [1/s],
    the schemes' stiffness bounds (3m,) and secant sums (3m,) [mN/mm]."""

    stiffness: Floats
    mass: Floats
    drag: float
    bound: Floats
    secant: Floats

    @property
    def own(self) -> Floats:
        """The part of the stiffness that joins each vertex with itself, (3m, 3m)."""
        node = np.arange(len(self.mass)) // 3
        return np.where(node[:, None] == node[None, :], self.stiffness, 0.0)


def linearised(body: Body, x: Floats, control: Control, step: float = 1e-5) -> Linearised:
    """Return the skin `body` linearised about the positions `x` (n, 3) [mm], by central differences of its forces."""
    free = np.flatnonzero(~body.pinned).astype(np.int32)
    load = Load(Tables(body).patch(free))
    load.apply(control)
    nodes, m = load.patch.nodes, len(free)
    load.x[:] = x[nodes]
    bound = load.forces(load.x)[:m, 3].copy()
    columns = np.zeros((3 * m, 3 * m))
    for c in range(3 * m):
        here = load.x.copy()
        here[c // 3, c % 3] += step
        ahead = load.forces(here)[:m, :3].ravel().copy()
        here[c // 3, c % 3] -= 2.0 * step
        columns[:, c] = (load.forces(here)[:m, :3].ravel() - ahead) / (2.0 * step)
    return Linearised(0.5 * (columns + columns.T), np.repeat(load.patch.mass[:m], 3), body.damping,
                      np.repeat(bound, 3), np.repeat(_secants(load, m), 3))  # fmt: skip


def _secants(load: Load, m: int) -> Floats:
    load.moment.shift[:] = load.x - load.moment.anchor
    scene = load.patch.scene
    return np.array([kernels.vertex_force(i, *load.x[i], load.x, scene, load.moment)[4] for i in range(m)])


def explicit_limit(square: float, drag: float, dt: float) -> float:
    """Return by how much stiffness may be multiplied for leapfrog with exact drag at `dt` [s].

    square : w_max^2 [1/s^2]. Stable where dt tanh(drag dt / 2) w^2 < 2 drag; without drag dt w < 2.
    """
    gain = 0.5 * dt * dt if drag <= 0.0 else dt * math.tanh(0.5 * drag * dt) / drag
    return 2.0 / (gain * square)


def largest_square(skin: Linearised) -> float:
    """Return w_max^2 [1/s^2] of the skin."""
    return float(eigh(skin.stiffness, np.diag(skin.mass), eigvals_only=True)[-1])


@dataclass(frozen=True)
class Mode:
    """A mode of the pencil (stiffness, bounds): eigenvalue over bound [-], the share of the bound that the vertex's own
    stiffness makes up [-], bound over mass [1/s^2]."""

    ratio: float
    own: float
    square: float

    def roots(self, dt: float, drag: float, factor: float = 1.0) -> np.ndarray:
        """Return both roots of mu^2 - (1 + g - b) mu + g = 0, the characteristic polynomial of Eqs. 18-19 [-].

        g = (1 - dt^2 k (ratio - own)) / c, b = dt^2 k ratio / c, c = 1 + dt drag + dt^2 k, k = factor * square.
        With own = 1, as for linear springs, and ratio = 2 it tends to 1 + sqrt 2 for large steps.
        """
        stiff = dt * dt * factor * self.square
        c = 1.0 + dt * drag + stiff
        g, b = (1.0 - stiff * (self.ratio - self.own)) / c, stiff * self.ratio / c
        return np.asarray(np.roots([1.0, -(1.0 + g - b), g]))

    def limit(self, dt: float, drag: float) -> float:
        """Return by how much stiffness may be multiplied at `dt` [s] until a root leaves the unit circle, inf = never.

        b < 2 (1 + g) and g > -1, solved for the factor.
        """
        first, second = 3.0 * self.ratio - 2.0 - 2.0 * self.own, self.ratio - self.own - 1.0
        k = dt * dt * self.square
        bends = (4.0 + 2.0 * dt * drag) / (k * first) if first > 0.0 else math.inf
        swings = (2.0 + dt * drag) / (k * second) if second > 0.0 else math.inf
        return min(bends, swings)


def modes(skin: Linearised, *, secant: bool = False) -> list[Mode]:
    """Return the modes of the stiffness against what the denominators hold: stiffness bounds, or the secant sums.

    Raises `UserError` where a secant sum is not positive: then there is no such pencil.
    """
    held = skin.secant if secant else skin.bound
    if not (held > 0.0).all():
        raise UserError("the secant stiffness of a vertex is not positive; see `secant_limit`")
    value, vector = eigh(skin.stiffness, np.diag(held))
    own = np.einsum("im,ij,jm->m", vector, skin.own, vector)
    mass = np.einsum("im,i,im->m", vector, skin.mass, vector)
    return [Mode(float(r), float(s), float(1.0 / w)) for r, s, w in zip(value, own, mass)]


def largest_root(found: list[Mode], dt: float, drag: float, factor: float, *, ahead: bool) -> float:
    """Return the largest |mu| of all modes: how fast the slowest of them dies, or the worst grows.

    ahead : neighbours extrapolated as in Eqs. 18-19, else at their present place: mu^2 - (1 + a - b) mu + a = 0
    """
    ratio, own, square = (np.array([getattr(m, name) for m in found]) for name in ("ratio", "own", "square"))
    stiff = dt * dt * factor * square
    c = 1.0 + dt * drag + stiff
    last, b = (1.0 - stiff * (ratio - own) if ahead else 1.0) / c, stiff * ratio / c
    half = 0.5 * (1.0 + last - b)
    spread = np.sqrt(half**2 - last + 0j)
    return float(max(np.abs(half + spread).max(), np.abs(half - spread).max()))


def lag_limit(found: list[Mode], dt: float, drag: float, steps: Callable[[float], int], left: float, *, ahead: bool
              ) -> float:  # fmt: skip
    """Return by how much stiffness may be multiplied until more than `left` of the slowest mode remains.

    steps(factor) : after so many steps of `dt` [s], by which the true motion has died; 0 where every factor is too much
    """
    for factor in np.geomspace(1e4, 1e-5, 271):
        if largest_root(found, dt, drag, factor, ahead=ahead) ** steps(factor) < left:
            return float(factor)
    return 0.0


def paper_limit(found: list[Mode], dt: float, drag: float) -> float:
    """Return by how much stiffness may be multiplied for the scheme with extrapolated neighbours at `dt` [s]."""
    return min(mode.limit(dt, drag) for mode in found)


def paper_growth(skin: Linearised, dt: float, factor: float = 1.0, *, secant: bool = False) -> float:
    """Return the largest growth per step of Eqs. 18-19 on the whole skin: the spectral radius of the linearised step."""
    c = skin.mass * (1.0 + dt * skin.drag) + dt * dt * factor * (skin.secant if secant else skin.bound)
    others = skin.stiffness - skin.own
    carry = (np.diag(skin.mass) - dt * dt * factor * others) / c[:, None]
    force = dt * dt * factor * skin.stiffness / c[:, None]
    whole = np.block([[carry, -force], [carry, np.eye(len(c)) - force]])
    return float(np.abs(eigvals(whole)).max())


def grown_limit(skin: Linearised, dt: float, *, secant: bool) -> float:
    """Return by how much stiffness may be multiplied at `dt` [s] by the eigenvalues of the whole step.

    With secant sums that differ much from vertex to vertex the modes no longer stand for the step, this does.
    """
    high = 3.0 * paper_limit(modes(skin, secant=secant), dt, skin.drag)
    low, shares = high / 100.0, 10
    for _ in range(shares):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if paper_growth(skin, dt, middle, secant=secant) <= 1.0 + 1e-9 else (low, middle)
    return low


def secant_limit(skin: Linearised, dt: float) -> float:
    """Return by how much stiffness may be multiplied at `dt` [s] until a denominator of Eq. 18 vanishes, inf = never."""
    worst = float((-skin.secant / skin.mass).max())
    return (1.0 + dt * skin.drag) / (dt * dt * worst) if worst > 0.0 else math.inf


def least_bound(skin: Linearised) -> float:
    """Return the least multiple of half the largest eigenvalue that the bounds hold: the scheme with present neighbours
    is stable for every step where it is at least 1."""
    return 2.0 / max(mode.ratio for mode in modes(skin))


def safe_force(solver: Any, beta: float) -> float:
    """Return the force [mN] on its lightest free node that moves it by `beta` cells in one step: beta h m / dt^2."""
    rig = solver.rig(solver.base)
    free = rig.inverse_mass > 0.0
    return float(beta * rig.model.side.min() * rig.model.mass[free].min() / solver.substep**2)


def length_loss(turn: float) -> float:
    """Return by how much of its length the tip of a warped bar misses that of a bent one: |sinc - cos| of `turn` / 2.

    turn : [rad] between both ends, the bending mode imposed (pure bending)
    """
    return abs(np.sinc(0.5 * turn / np.pi) - math.cos(0.5 * turn))


def turn_of_loss(tolerance: float) -> float:
    """Return the turn [rad] at which warping loses `tolerance` of the length."""
    low, high = 0.0, math.pi
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if length_loss(middle) < tolerance else (low, middle)
    return low
