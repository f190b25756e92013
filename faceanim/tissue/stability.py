"""Where an incompressible hyperelastic law stays stable: a numeric scan along the modes that a test machine can drive.

W(I1, I2) [kPa] with the principal stretches l1 l2 l3 = 1. Three measures are scanned, none of them by a formula:
ellipticity  every wave has a real speed: a . (N . A . N) a > 0 for all directions N and all a that keep the volume
drucker      the stress rises with the strain in every direction: the Hessian of W in the two free logarithmic strains is
             positive definite (the test of Abaqus, for an unloaded third direction)
slope        the nominal stress rises along the mode itself, dP/dl > 0
sign         where the nominal stress changes its sign: tension that pushes

Bonet & Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2008, chapter 6; ellipticity: Zee & Sternberg,
Ordinary and strong ellipticity in the equilibrium theory of incompressible hyperelastic solids, 1983.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from faceanim.ground.arrays import Bools, Floats
from faceanim.ground.errors import UserError, unknown_name
from faceanim.kernels.tension import tension_curvature, tension_slope
from faceanim.tissue.material import Material

LAWS = ("neo_hookean", "mooney_rivlin", "tension")
MODES = {"uniaxial": (1.0, -0.5, -0.5), "equibiaxial": (1.0, 1.0, -2.0), "planar": (1.0, 0.0, -1.0)}
"""Mode -> the exponents of the stretch l that give the three principal stretches."""
SHARE = {"uniaxial": 1.0, "equibiaxial": 0.5, "planar": 1.0}
"""Mode -> nominal stress over dW/dl: in equibiaxial tension two directions share the work."""
FARTHEST = 3.0
"""Stretches from 1 / FARTHEST to FARTHEST are scanned."""
STEPS = 300
ROUNDS = 40
"""Halvings by which a limit is refined."""
DIRECTIONS = 100
"""Wave directions that are tried."""

Slopes = Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]


@dataclass(frozen=True)
class Limits:
    """The stretch at which each measure first fails on the way from rest: inf or 0 where it does not, see `stability`."""

    ellipticity: float
    drucker: float
    slope: float
    sign: float


@dataclass(frozen=True)
class Stability:
    """How far a law is stable.

    ellipticity : the least largest principal stretch at which the law loses its ellipticity in any mode [-], inf = never
    tension, compression : mode -> its limits
    """

    law: str
    ellipticity: float
    tension: dict[str, Limits]
    compression: dict[str, Limits]

    @property
    def stable(self) -> bool:
        """Whether no measure failed anywhere in the range that was scanned."""
        fine = [Limits(math.inf, math.inf, math.inf, math.inf)] * 3 + [Limits(0.0, 0.0, 0.0, 0.0)] * 3
        return [*self.tension.values(), *self.compression.values()] == fine


def stability(material: Material, law: str = "mooney_rivlin") -> Stability:
    """Return where `law`, taken as incompressible, is stable for the constants of `material`.

    law : "neo_hookean", "mooney_rivlin" or "tension"   `UserError` for another one
    """
    slopes = _slopes(material, law)
    tension = {mode: _limits(slopes, mode, 1.0) for mode in MODES}
    compression = {mode: _limits(slopes, mode, -1.0) for mode in MODES}
    largest = [_largest(mode, found[mode].ellipticity) for found in (tension, compression) for mode in MODES]
    return Stability(law, min(largest), tension, compression)


def nominal_stress(material: Material, law: str, mode: str, stretch: float) -> float:
    """Return the nominal stress [kPa] of the incompressible law at the stretch l of a mode.

    2 (l - l^-2)(W1 + W2 / l) uniaxial, 2 (l - l^-5)(W1 + W2 l^2) equibiaxial, 2 (l - l^-3)(W1 + W2) planar
    Raises `UserError` for an unknown law or mode and a stretch that is not positive.
    """
    if mode not in MODES:
        raise unknown_name("mode of deformation", mode, MODES)
    if not (math.isfinite(stretch) and stretch > 0):
        raise UserError(f"stretch = {stretch} must be finite and positive")
    return float(_stress(_slopes(material, law), mode, np.array([math.log(stretch)]))[0])


def _slopes(material: Material, law: str) -> Slopes:
    """Return (I1, I2) -> dW/dI1, dW/dI2, d2W/dI1^2 [kPa]."""
    c10, c01 = material.c10, material.c01
    if law not in LAWS:
        raise unknown_name("law to be examined", law, LAWS)
    if law == "tension":
        if c01 > 0:
            raise UserError(f"material {material.name!r}: the law 'tension' needs mooney <= 0, not {material.mooney}")
        slope, curvature = np.vectorize(tension_slope, otypes=[float]), np.vectorize(tension_curvature, otypes=[float])
        return lambda I1, I2: (slope(I1 - 3.0, c10, c01), 0.0 * I2, curvature(I1 - 3.0, c10, c01))
    first, second = (c10, c01) if law == "mooney_rivlin" else (c10 + c01, 0.0)
    return lambda I1, I2: (first + 0.0 * I1, second + 0.0 * I2, 0.0 * I1)


def _stretches(mode: str, strain: Floats) -> Floats:
    return np.exp(strain[:, None] * np.array(MODES[mode]))


def _invariants(stretch: Floats) -> tuple[Floats, Floats]:
    square = stretch**2
    return square.sum(axis=1), (1.0 / square).sum(axis=1)


def _stress(slopes: Slopes, mode: str, strain: Floats) -> Floats:
    """Return the nominal stress along a mode at the logarithmic strains `strain` (k,)."""
    stretch = _stretches(mode, strain)
    W1, W2, _ = slopes(*_invariants(stretch))
    power = np.array(MODES[mode])
    rate = 2.0 * ((W1[:, None] * stretch**2 - W2[:, None] / stretch**2) * power).sum(axis=1)
    return np.asarray(SHARE[mode] * rate / np.exp(strain))


def _limits(slopes: Slopes, mode: str, way: float) -> Limits:
    none = math.inf if way > 0 else 0.0
    found = [_first_failure(holds, slopes, mode, way) for holds in (_elliptic, _drucker, _rising, _signed)]
    return Limits(*(none if strain is None else math.exp(way * strain) for strain in found))


def _first_failure(holds: Callable[..., Bools], slopes: Slopes, mode: str, way: float) -> float | None:
    """Return the logarithmic strain at which `holds` first fails on the way from rest, None if it does not."""
    grid = np.linspace(0.0, math.log(FARTHEST), STEPS + 1)
    failed = np.flatnonzero(~holds(slopes, mode, way * grid[1:]))
    if not len(failed):
        return None
    low, high = float(grid[failed[0]]), float(grid[failed[0] + 1])
    for _ in range(ROUNDS):
        middle = 0.5 * (low + high)
        if holds(slopes, mode, way * np.array([middle]))[0]:
            low = middle
        else:
            high = middle
    return high


def _largest(mode: str, stretch: float) -> float:
    """Return the largest principal stretch at the stretch of a mode; inf where there is none."""
    if stretch in (0.0, math.inf):
        return math.inf
    return float(_stretches(mode, np.array([math.log(stretch)])).max())


def _signed(slopes: Slopes, mode: str, strain: Floats) -> Bools:
    return np.asarray(_stress(slopes, mode, strain) * strain > 0.0)


def _rising(slopes: Slopes, mode: str, strain: Floats) -> Bools:
    h = 1e-5
    return np.asarray(_stress(slopes, mode, strain + h) > _stress(slopes, mode, strain - h))


def _drucker(slopes: Slopes, mode: str, strain: Floats) -> Bools:
    """Return where the Hessian of W in the logarithmic strains (e1, e2), e3 = -e1 - e2, is positive definite."""
    square = _stretches(mode, strain) ** 2
    W1, W2, W11 = slopes(square.sum(axis=1), (1.0 / square).sum(axis=1))
    along = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]])
    bend = 4.0 * (W1[:, None] * square + W2[:, None] / square)
    rise = 2.0 * square @ along
    H = np.einsum("ki,ia,ib->kab", bend, along, along) + np.einsum("k,ka,kb->kab", W11, rise, rise)
    return np.asarray((H[:, 0, 0] > 0.0) & (np.linalg.det(H) > 0.0))


def _elliptic(slopes: Slopes, mode: str, strain: Floats) -> Bools:
    """Return where a . (N . A . N) a > 0 for all a that keep the volume, N the waves of `_directions`."""
    stretch = _stretches(mode, strain)
    W1, W2, W11 = (w[:, None, None, None] for w in slopes(*_invariants(stretch)))
    carried = _directions() * stretch[:, None, :]
    normal = _directions() / stretch[:, None, :]
    a = _across(normal / np.linalg.norm(normal, axis=2)[:, :, None])
    inner = np.einsum("kdai,kdbi->kdab", a, a)
    along = np.einsum("kdai,kdi->kda", a, carried)
    outer = along[:, :, :, None] * along[:, :, None, :]
    # along h = a (x) N: I1'' = 2 h : h, I1' = 2 F : h
    Q = 2.0 * W1 * inner + 4.0 * W11 * outer + W2 * _second(a, inner, outer, carried, stretch)
    determinant = Q[..., 0, 0] * Q[..., 1, 1] - Q[..., 0, 1] * Q[..., 1, 0]
    return np.asarray(((determinant > 0.0) & (Q[..., 0, 0] > 0.0)).all(axis=1))


def _second(a: Floats, inner: Floats, outer: Floats, carried: Floats, stretch: Floats) -> Floats:
    """Return the second derivative of I2 along h = a (x) N, (k, d, 2, 2), from a . a, (F : h)(F : h) and F N.

    I2 = (I1^2 - C : C) / 2 gives (2 F : h)^2 + 2 I1 h : h - |h^T F + F^T h|^2 - 2 C : h^T h.
    """
    I1 = (stretch**2).sum(axis=1)[:, None, None, None]
    turned = a * stretch[:, None, None, :]
    # h^T F + F^T h = N (x) F^T a + F^T a (x) N
    change = 2.0 * (np.einsum("kdai,kdbi->kdab", turned, turned) + outer)
    length = (carried**2).sum(axis=2)[:, :, None, None]
    return np.asarray(4.0 * outer + 2.0 * (I1 - length) * inner - change)


def _directions() -> Floats:
    """Return unit vectors spread over the sphere, with the axes and their diagonals."""
    k = np.arange(DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * k / DIRECTIONS, math.pi * (1.0 + math.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    spread = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    signs = np.array(
        [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, -1, 0], [1, 0, -1], [0, 1, -1]]
    )
    return np.concatenate([spread, signs / np.linalg.norm(signs, axis=1)[:, None]])


def _across(normal: Floats) -> Floats:
    """Return two orthogonal unit vectors across each of `normal` (..., 3), (..., 2, 3)."""
    axis = np.eye(3)[np.abs(normal).argmin(axis=-1)]
    first = np.cross(normal, axis)
    first /= np.linalg.norm(first, axis=-1)[..., None]
    return np.stack([first, np.cross(normal, first)], axis=-2)
