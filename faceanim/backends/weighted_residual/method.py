"""The weighted residual method: coefficients of exact fields from what is prescribed on the boundary."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import linalg

from faceanim.backends.weighted_residual.boundary import Boundary
from faceanim.backends.weighted_residual.fields import (
    Fields,
    JoinedFields,
    NavierPolynomials,
    PaperFields,
    Sample,
    reject_poisson,
)
from faceanim.backends.weighted_residual.options import Options
from faceanim.ground.arrays import Bools, Floats, floats
from faceanim.ground.errors import UserError

EMPTY = 1e-9
"""Fields whose trace is below this share of the largest are left out before scaling would blow up their round-off."""

DEPENDENT = 1e-14
"""Combinations of fields whose squared trace is below this share of the largest are left out as round-off."""


def make_fields(options: Options, poisson_ratio: float, low: Floats, high: Floats) -> Fields:
    """Return the trial fields that `options` names, for a body between `low` and `high` (3,) in units of its length."""
    if options.basis == "navier":
        return NavierPolynomials(options.degree, poisson_ratio)
    corners = [(float(c[0]), float(c[1]), float(c[2])) for c in (low, high)]
    paper = PaperFields(options.terms, poisson_ratio, 1.0, corners[0], corners[1])
    return paper if options.basis == "paper" else JoinedFields((paper, NavierPolynomials(1, poisson_ratio)))


class WeightedResidual:
    """A body of one linear elastic material, factorised: loads may then change for the price of one small product.

    Lengths are scaled by the body's largest dimension and stresses by E, so that results do not depend on units.
    Coefficients belong to the fields that `sample` returns: those of `fields`, with Nitsche made orthonormal.
    origin : (3,) [mm] of the fields' coordinates (None = centre of the box around the points)
    size : l [mm] in the weight of displacements (None = `Boundary.thickness`)
    coat : optional (m, m) quadratic form in the fields, e.g. of an elastic skin (see `surface_form`)
    Raises `UserError` for a Poisson's ratio of 0.5 or more, or displacements that leave a rigid motion free.
    """

    def __init__(
        self, boundary: Boundary, young_modulus: float, poisson_ratio: float, options: Options | None = None, *,
        fields: Fields | None = None, origin: Any = None, size: float | None = None,
        coat: Callable[[WeightedResidual, Sample], Floats] | None = None,
    ) -> None:  # fmt: skip
        self.options = Options() if options is None else options
        reject_poisson(poisson_ratio)
        if not (np.isfinite(young_modulus) and young_modulus > 0):
            raise UserError(f"young_modulus = {young_modulus} kPa must be positive and finite")
        boundary.reject_floating()
        self.boundary, self.young, self.poisson = boundary, float(young_modulus), float(poisson_ratio)
        low, high = boundary.points.min(axis=0), boundary.points.max(axis=0)
        self.length = boundary.extent
        self.size = boundary.thickness if size is None else float(size)
        if not self.size > 0:
            raise UserError(
                f"boundary: its points enclose no volume (size {self.size:.3g} mm); turn the normals outward"
            )
        self.origin = 0.5 * (low + high) if origin is None else floats("origin", origin, 3)
        ends = (low - self.origin) / self.length, (high - self.origin) / self.length
        self.fields = make_fields(self.options, self.poisson, *ends) if fields is None else fields
        self.turn: Floats | None = None
        self._unit = np.where(boundary.prescribed, 1.0 / self.length, 1.0 / self.young).ravel()
        self._factorise(coat)

    def sample(self, points: Floats) -> Sample:
        """Return the fields that the coefficients belong to at `points` (n, 3) [mm], in scaled units."""
        sample = self._raw(points)
        return sample if self.turn is None else Sample(*(part @ self.turn for part in sample))

    def shapes(self, points: Floats) -> Floats:
        """Return the displacements of the same fields alone, (n, 3, r)."""
        u = self.fields.displacement((points - self.origin) / self.length)
        return u if self.turn is None else u @ self.turn

    def _raw(self, points: Floats) -> Sample:
        return self.fields.sample((points - self.origin) / self.length)

    def _factorise(self, coat: Any) -> None:
        sample = self._raw(self.boundary.points)
        m = self.fields.count
        self._u = sample.u.reshape(-1, m)
        self._t = (0.5 / (1.0 + self.poisson)) * sample.traction(self.boundary.normals).reshape(-1, m)
        if self.options.method == "nitsche":
            self._nitsche(None if coat is None else coat(self, sample))
        else:
            self._collocate()

    def _nitsche(self, coat: Floats | None) -> None:
        """Set up the energy-consistent system K c = Q values and its pseudo-inverse.

        The fields are first made orthonormal in their traces u and t, which keeps half of the digits that the normal
        equations of nearly dependent fields would lose; `inverse` belongs to the fields as they are sampled.
        """
        given = self.boundary.prescribed.ravel()
        weight = np.repeat(self.boundary.weights, 3) / self.length**2
        self.penalty = self.options.gamma * self.length / self.size
        turn, u, t = self._orthonormal(np.sqrt(weight * self.penalty), np.sqrt(weight / self.penalty))
        w_given, w_free = np.where(given, weight, 0.0)[:, None], np.where(given, 0.0, weight)[:, None]
        # rows where a traction is given test it by u, rows where a displacement is given by beta u - t
        test = w_free * u + w_given * (self.penalty * u - t)
        k = u.T @ (w_free * t) - t.T @ (w_given * u) + self.penalty * (u.T @ (w_given * u))
        self.asymmetry = float(np.abs(k - k.T).max() / np.abs(k).max())
        extra = 0.0 if coat is None else turn.T @ coat @ turn
        self.matrix = 0.5 * (k + k.T) + extra
        scale = 1.0 / np.sqrt(np.maximum(np.abs(np.diag(self.matrix)), 1e-300))
        value, vector = linalg.eigh(scale[:, None] * self.matrix * scale)
        self.least_eigenvalue = float(value.min() / value.max())
        good = np.abs(value) > self.options.cut_off * value.max()
        vector = scale[:, None] * vector[:, good]
        self.inverse = (vector / value[good]) @ vector.T
        # quadrature that is not exact leaves K a little unsymmetric; as it stands it still reproduces its own fields
        operator = linalg.solve(k + extra, test.T) if good.all() else self.inverse @ test.T
        self.operator = operator * self._unit
        self.turn, self._u, self._t = turn, u, t

    def _orthonormal(self, by_u: Floats, by_t: Floats) -> tuple[Floats, Floats, Floats]:
        """Return a change of fields (m, r) that makes the weighted traces orthonormal, and those traces, 2 x (3n, r)."""
        rows = np.concatenate([by_u[:, None] * self._u, by_t[:, None] * self._t])
        trace = np.linalg.norm(rows[: len(by_u)], axis=0)
        keep = trace > EMPTY * trace.max()
        scale = np.where(keep, 1.0 / np.maximum(np.linalg.norm(rows, axis=0), 1e-300), 0.0)
        turn, rows = np.diag(scale), rows * scale
        for _ in range(2):  # the second time around repairs what round-off left in the first
            square, vector = linalg.eigh(rows.T @ rows)
            good = square > DEPENDENT * square[-1]
            change = vector[:, good] / np.sqrt(square[good])
            turn, rows = turn @ change, rows @ change
        n = len(by_u)
        return turn, rows[:n] / by_u[:, None], rows[n:] / by_t[:, None]

    def _collocate(self) -> None:
        """Set up the least squares fit of Eq. 8 to 12 and its pseudo-inverse."""
        given = self.boundary.prescribed.ravel()
        row = np.where(given, self.options.displacement_weight * self.length / self.size, 1.0)
        matrix = np.where(given[:, None], self._u, self._t) * row[:, None]
        norm = np.linalg.norm(matrix, axis=0)
        scale = 1.0 / np.maximum(norm, 1e-300)
        scaled = matrix * scale
        if self.options.solver == "normal_equations":
            factor = linalg.lu_factor(matrix.T @ matrix)
            inverse = linalg.lu_solve(factor, matrix.T)
        elif self.options.solver == "svd":
            inverse = scale[:, None] * np.linalg.pinv(scaled, rcond=1e-13)
        else:
            q, r = linalg.qr(scaled, mode="economic")
            inverse = scale[:, None] * linalg.solve_triangular(r, q.T)
        self._rows = scaled
        self.operator = inverse * row * self._unit
        self.turn = None

    @property
    def condition(self) -> float:
        """Condition number of the scaled columns of the collocation matrix [-]."""
        return float(np.linalg.cond(self._rows))

    def resolve(self, values: Floats) -> Floats:
        """Return the coefficients (m,) for other boundary `values` (n, 3): one product."""
        return np.asarray(self.operator @ np.ravel(values))

    def block(self, points: Bools) -> Floats:
        """Return the part (m, 3 k) of the operator for the k `points` (mask or indices) whose values will change."""
        part = self.operator.reshape(len(self.operator), -1, 3)[:, points]
        return np.ascontiguousarray(part.reshape(len(self.operator), -1))

    def solve(self) -> Floats:
        """Return the coefficients (m,) for the values that the boundary carries."""
        return self.resolve(self.boundary.values)

    def point_loads(self, points: Floats) -> Floats:
        """Return the operator (m, 3 k) from forces (k, 3) [mN] at `points` (k, 3) to coefficients; Nitsche only."""
        if self.options.method != "nitsche":
            raise UserError("point loads have an answer with method 'nitsche' only; collocation sees tractions")
        u = self.shapes(points).reshape(-1, len(self.inverse))
        return np.asarray(self.inverse @ u.T) / (self.young * self.length**2)

    def displacement(self, points: Floats, coefficients: Floats) -> Floats:
        """Return the displacement at `points` (n, 3), (n, 3) [mm]."""
        return np.asarray(self.length * (self.shapes(points) @ coefficients))

    def strain(self, points: Floats, coefficients: Floats) -> Floats:
        """Return the strain tensor at `points` (n, 3), (n, 3, 3) [-]."""
        gradient = self.sample(points).gradient @ coefficients
        return np.asarray(0.5 * (gradient + gradient.transpose(0, 2, 1)))

    def stress(self, points: Floats, coefficients: Floats) -> Floats:
        """Return the stress tensor at `points` (n, 3), (n, 3, 3) [kPa]."""
        sample = self.sample(points)
        gradient, pressure = sample.gradient @ coefficients, sample.pressure @ coefficients
        out = gradient + gradient.transpose(0, 2, 1) + pressure[:, None, None] * np.eye(3)
        return np.asarray(self.young * (0.5 / (1.0 + self.poisson)) * out)

    def residual(self, coefficients: Floats, values: Floats | None = None) -> Floats:
        """Return what is missing at the boundary, (n, 3): displacement [mm] or traction [kPa] (Eq. 9)."""
        given = self.boundary.prescribed
        got = np.where(given.ravel(), self._u @ coefficients, self._t @ coefficients) / self._unit
        return np.asarray(got.reshape(-1, 3) - (self.boundary.values if values is None else values))

    def reaction(self, coefficients: Floats, points: Bools, values: Floats | None = None) -> Floats:
        """Return the force of the supports on `points` (n,) bool, (3,) [mN]: the consistent flux t(u) - beta (u - ubar).

        The bare integral of t(u) may be far off where displacements are right; components with given tractions count
        with t(u). Nitsche only.
        """
        bar = (self.boundary.values if values is None else values) / self.length
        flux = (self._t @ coefficients).reshape(-1, 3)
        gap = (self._u @ coefficients).reshape(-1, 3) - bar
        flux = np.where(self.boundary.prescribed, flux - self.penalty * gap, 0.0)
        return np.asarray(self.young * (self.boundary.weights[points] @ flux[points]))
