"""Trial fields: displacements that satisfy Navier's equation exactly inside, whatever their coefficients.

A family of m fields is sampled as `Sample`; stresses are per shear modulus, and lambda * div u is had in closed form,
which stays finite up to and at nu = 1/2, so that nothing locks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError


class Sample(NamedTuple):
    """m fields at n points.

    u : (n, 3, m) displacement   gradient : (n, 3, 3, m), d u_a / d x_b   pressure : (n, m), lambda div u / G
    """

    u: Floats
    gradient: Floats
    pressure: Floats

    def stress(self) -> Floats:
        """Return the stresses per shear modulus, (n, 3, 3, m)."""
        out = self.gradient + self.gradient.transpose(0, 2, 1, 3)
        for a in range(3):
            out[:, a, a] += self.pressure
        return out

    def traction(self, normals: Floats) -> Floats:
        """Return the tractions per shear modulus on faces of `normals` (n, 3), (n, 3, m) (paper Eq. 4)."""
        out = np.einsum("nabm,nb->nam", self.gradient, normals)
        out += np.einsum("nbam,nb->nam", self.gradient, normals)
        out += normals[:, :, None] * self.pressure[:, None, :]
        return out


class Fields(Protocol):
    """A family of `count` fields for one Poisson's ratio."""

    @property
    def count(self) -> int: ...

    def displacement(self, points: Floats) -> Floats: ...

    def sample(self, points: Floats) -> Sample: ...


def reject_poisson(nu: float, *, half: bool = False) -> None:
    """Raise `UserError` unless -1 < nu < 1/2; with `half`, 1/2 itself is allowed."""
    if not (-1.0 < nu < 0.5 or (half and nu == 0.5)):
        raise UserError(
            f"poisson_ratio = {nu} must be above -1 and below 0.5; take 0.499999 for flesh that keeps its volume"
        )


@dataclass(frozen=True)
class PaperFields:
    """The 36 `terms` fields of the paper (Eq. 5 and 7): Galerkin vectors of sines, cosines and exponentials.

    Column 36 (i - 1) + 12 m + 4 f + c : wave number i pi / length, component m of the vector, family f (exponentials
    along z, x, y), c one of e^{+}, e^{-}, s e^{+}, s e^{-}. Not complete: it holds neither rigid motions nor uniform
    strains.
    low, high : corners of the body; exponentials are then scaled to at most 1 there (None = as printed)
    """

    terms: int
    poisson_ratio: float
    length: float = 1.0
    low: tuple[float, float, float] | None = None
    high: tuple[float, float, float] | None = None
    galerkin: float | None = None
    """H; None = -1 / (2 (1 - nu)), the only value that satisfies Navier's equation."""

    def __post_init__(self) -> None:
        reject_poisson(self.poisson_ratio, half=True)
        if self.terms < 1 or not self.length > 0:
            raise UserError(f"paper fields: terms = {self.terms} must be at least 1, length = {self.length} positive")

    @property
    def count(self) -> int:
        return 36 * self.terms

    def displacement(self, points: Floats) -> Floats:
        """Return the displacements alone at `points` (n, 3), (n, 3, m)."""
        return self.sample(points).u

    def _potentials(self, points: Floats) -> tuple[Floats, Floats]:
        """Return second (n, 3, 3, 12 k) and third (n, 3, 3, 3, 12 k) derivatives of the scalar potentials."""
        n, k = len(points), self.terms
        wave = np.asarray(np.arange(1, k + 1) * (np.pi / self.length), dtype=np.float64)
        second = np.zeros((n, 3, 3, k, 3, 4))
        third = np.zeros((n, 3, 3, 3, k, 3, 4))
        for family, (p, q, s) in enumerate(((0, 1, 2), (1, 2, 0), (2, 0, 1))):
            order = np.arange(4)[:, None, None]
            angle = 0.5 * np.pi * order
            sine = wave**order * np.sin(points[:, p, None] * wave + angle)
            cosine = wave**order * np.cos(points[:, q, None] * wave + angle)
            rise = self._exponentials(points[:, s], wave, s)
            factor = {p: sine[..., None], q: cosine[..., None], s: rise}
            for index in np.ndindex(3, 3):
                times = [index.count(axis) for axis in range(3)]
                second[(slice(None), *index, slice(None), family)] = _product(factor, times)
            for index3 in np.ndindex(3, 3, 3):
                times = [index3.count(axis) for axis in range(3)]
                third[(slice(None), *index3, slice(None), family)] = _product(factor, times)
        return second.reshape(n, 3, 3, 12 * k), third.reshape(n, 3, 3, 3, 12 * k)

    def _exponentials(self, t: Floats, wave: Floats, axis: int) -> Floats:
        """Return e^{+}, e^{-}, t e^{+}, t e^{-} and three derivatives, (4, n, k, 4)."""
        out = np.empty((4, len(t), len(wave), 4))
        for c, sign in enumerate((1.0, -1.0)):
            a = sign * np.sqrt(2.0) * wave
            corner = self.high if sign > 0 else self.low
            shift = 0.0 if corner is None else corner[axis]
            e = np.exp((t[:, None] - shift) * a)
            for m in range(4):
                out[m, :, :, c] = a**m * e
                out[m, :, :, 2 + c] = (a**m * t[:, None] + (m * a ** (m - 1) if m else 0.0)) * e
        return out

    def sample(self, points: Floats) -> Sample:
        """Return the fields at `points` (n, 3)."""
        nu, n = self.poisson_ratio, len(points)
        h = -0.5 / (1.0 - nu) if self.galerkin is None else self.galerkin
        second, third = self._potentials(points)
        laplace, slope = np.einsum("naap->np", second), np.einsum("naabp->nbp", third)
        eye = np.eye(3)
        # (n, i, j, p): component i of the field whose vector has the potential p as its component j
        u = h * second + eye[None, :, :, None] * laplace[:, None, None]
        grad = h * third.transpose(0, 1, 3, 2, 4) + np.einsum("ij,nbp->nibjp", eye, slope)
        pressure = nu / (1.0 - nu) * slope
        k, m = self.terms, self.count
        return Sample(
            u.reshape(n, 3, 3, k, 12).transpose(0, 1, 3, 2, 4).reshape(n, 3, m),
            grad.reshape(n, 3, 3, 3, k, 12).transpose(0, 1, 2, 4, 3, 5).reshape(n, 3, 3, m),
            pressure.reshape(n, 3, k, 12).transpose(0, 2, 1, 3).reshape(n, m),
        )


def _product(factor: dict[int, Floats], times: Sequence[int]) -> Floats:
    return np.asarray(factor[0][times[0]] * factor[1][times[1]] * factor[2][times[2]])


@dataclass(frozen=True)
class NavierPolynomials:
    """Every polynomial of at most `degree` that solves Navier's equation, 3 (degree + 1)^2 of them.

    A harmonic vector h, homogeneous of degree d, makes the field h + c_d r^2 grad div h with
    c_d = -1 / (2 (d - 1) + (4 d - 2) (1 - 2 nu)); counting shows that these are all. Degree 1: the 12 fields a + B x.
    """

    degree: int
    poisson_ratio: float

    def __post_init__(self) -> None:
        reject_poisson(self.poisson_ratio)
        if self.degree < 0:
            raise UserError(f"navier polynomials: degree = {self.degree} must not be negative")

    @property
    def count(self) -> int:
        return int(3 * (self.degree + 1) ** 2)

    def _factors(self) -> tuple[Floats, Floats]:
        """Return c_d and lambda div u / (G div h) of every harmonic, 2 x (k,)."""
        degree, nu = harmonic_slopes(self.degree)[0], self.poisson_ratio
        kappa = 2.0 * (degree - 1.0) + (4.0 * degree - 2.0) * (1.0 - 2.0 * nu)
        kappa[degree < 2] = 1.0
        swell = np.where(degree < 2, 2.0 * nu / (1.0 - 2.0 * nu), 2.0 * nu * (4.0 * degree - 2.0) / kappa)
        return np.where(degree < 2, 0.0, -1.0 / kappa), swell

    def displacement(self, points: Floats) -> Floats:
        """Return the displacements alone at `points` (n, 3), (n, 3, m)."""
        value, _, second = self._derivatives(points)
        return self._displacement(points, value, second)

    def _derivatives(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the harmonics (n, k), their slopes (n, 3, k) and second derivatives (n, 3, 3, k)."""
        slopes = harmonic_slopes(self.degree)[1]
        value = harmonics(points, self.degree)
        first = np.stack([value @ slope for slope in slopes], axis=1)
        return value, first, np.stack([first @ slope for slope in slopes], axis=1)

    def _displacement(self, points: Floats, value: Floats, second: Floats) -> Floats:
        c, _ = self._factors()
        u = (c * (points**2).sum(axis=1)[:, None, None, None]) * second  # (n, i, m, k)
        for a in range(3):
            u[:, a, a] += value
        return np.ascontiguousarray(u.transpose(0, 1, 3, 2)).reshape(len(points), 3, -1)

    def sample(self, points: Floats) -> Sample:
        """Return the fields at `points` (n, 3); column 3 h + m is harmonic h put into component m."""
        (c, swell), n = self._factors(), len(points)
        value, first, second = self._derivatives(points)
        third = np.stack([second @ slope for slope in harmonic_slopes(self.degree)[1]], axis=1)
        r2 = (points**2).sum(axis=1)[:, None, None, None, None]
        grad = c * (r2 * third + 2.0 * points[:, :, None, None, None] * second[:, None])  # (n, b, i, m, k)
        for a in range(3):
            grad[:, :, a, a] += first
        return Sample(
            self._displacement(points, value, second),
            np.ascontiguousarray(grad.transpose(0, 2, 1, 4, 3)).reshape(n, 3, 3, -1),
            np.ascontiguousarray((swell * first).transpose(0, 2, 1)).reshape(n, -1),
        )


def harmonics(points: Floats, degree: int) -> Floats:
    """Return the real solid harmonics up to `degree` at `points` (n, 3), (n, (degree + 1)^2).

    Order: degree by degree, Re R_l^0..l, then Im R_l^1..l. R_l^m carries the factor 1 / (l + m)!, which makes its
    derivatives harmonics again with factors 1 and 1/2.
    """
    x, y, z = points.T
    r2, w = (points**2).sum(axis=1), x + 1j * y
    table: dict[tuple[int, int], np.ndarray] = {(0, 0): np.ones(len(points), dtype=complex)}
    for l in range(1, degree + 1):
        table[l, l] = -w / (2.0 * l) * table[l - 1, l - 1]
        for m in range(l):
            below = table[l - 2, m] if m <= l - 2 else 0.0
            table[l, m] = ((2 * l - 1) * z * table[l - 1, m] - r2 * below) / ((l + m) * (l - m))
    columns = []
    for l in range(degree + 1):
        columns += [table[l, m].real for m in range(l + 1)] + [table[l, m].imag for m in range(1, l + 1)]
    return np.stack(columns, axis=1)


@lru_cache(maxsize=8)
def harmonic_slopes(degree: int) -> tuple[Floats, tuple[Floats, Floats, Floats]]:
    """Return the degree of every harmonic (k,) and matrices (k, k): harmonics @ matrix[a] are their d / dx_a."""
    size = (degree + 1) ** 2
    degrees = np.zeros(size)
    slopes = np.zeros((3, size, size))
    for l in range(degree + 1):
        degrees[l * l : (l + 1) ** 2] = l
        for m in range(l + 1):
            down = _combination(l - 1, m - 1)
            up, level = _combination(l - 1, m + 1), _combination(l - 1, m)
            # d/dx + i d/dy and d/dx - i d/dy lower the degree and move the order by one
            for part, weight in (("re", 1.0 + 0j), ("im", -1j)):
                if part == "im" and m == 0:
                    continue
                column = l * l + m + (l if part == "im" else 0)
                for axis, mix in ((0, 0.5 * (up - down)), (1, -0.5j * (up + down)), (2, level)):
                    slopes[axis, : len(mix), column] += (weight * mix).real
    return degrees, (slopes[0], slopes[1], slopes[2])


def _combination(l: int, m: int) -> np.ndarray:
    """Return R_l^m as a complex combination of the real harmonics up to degree l."""
    out = np.zeros((max(l, 0) + 1) ** 2, dtype=complex)
    if l < 0 or abs(m) > l:
        return out
    sign = 1.0 if m >= 0 else (-1.0) ** m
    out[l * l + abs(m)] = sign
    if m:
        out[l * l + l + abs(m)] = sign * (1j if m > 0 else -1j)
    return out


@dataclass(frozen=True)
class JoinedFields:
    """Several families as one."""

    parts: tuple[Fields, ...]

    @property
    def count(self) -> int:
        return sum(part.count for part in self.parts)

    def displacement(self, points: Floats) -> Floats:
        """Return the displacements alone at `points` (n, 3), (n, 3, m)."""
        return np.concatenate([part.displacement(points) for part in self.parts], axis=-1)

    def sample(self, points: Floats) -> Sample:
        """Return the fields at `points` (n, 3)."""
        samples = [part.sample(points) for part in self.parts]
        return Sample(*(np.concatenate(arrays, axis=-1) for arrays in zip(*samples, strict=True)))
