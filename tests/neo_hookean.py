"""A reference for verification: the equilibrium and the motion of a compressible neo-Hookean solid, by Newton's method.

psi = mu / 2 (|F|^2 - 3) - mu ln J + lambda / 2 (ln J)^2, linear tetrahedra, sparse direct solves.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from faceanim.body.assembly import mass_matrix
from faceanim.body.solid import Solid


class NeoHookean:
    """The solid with its free freedoms; displacements are (n, 3)."""

    def __init__(self, solid: Solid) -> None:
        self.solid, mesh = solid, solid.mesh
        self.g, self.volume, self.tets = mesh.gradients, mesh.volumes, mesh.tets
        self.lame, self.shear = solid.lame()
        self.free = np.flatnonzero(np.repeat(~solid.held, 3))
        rows = (3 * mesh.tets[:, :, None] + np.arange(3)).reshape(-1, 12)
        self.rows, self.i, self.j = rows, np.repeat(rows, 12, axis=1).ravel(), np.tile(rows, (1, 12)).ravel()
        self.mass = mass_matrix(solid, lumped=False)

    def deformation(self, u: np.ndarray) -> np.ndarray:
        return np.eye(3) + np.einsum("eai,eaj->eij", u[self.tets], self.g)

    def energy(self, u: np.ndarray) -> float:
        f = self.deformation(u)
        j = np.linalg.det(f)
        if j.min() <= 0.0:
            return np.inf
        log = np.log(j)
        psi = 0.5 * self.shear * ((f**2).sum(axis=(1, 2)) - 3.0) - self.shear * log + 0.5 * self.lame * log**2
        return float(self.volume @ psi)

    def force(self, u: np.ndarray) -> np.ndarray:
        """Return the elastic forces, minus the gradient of the energy, (3n,)."""
        f = self.deformation(u)
        inverse = np.linalg.inv(f).transpose(0, 2, 1)
        log = np.log(np.linalg.det(f))
        stress = self.shear[:, None, None] * (f - inverse) + (self.lame * log)[:, None, None] * inverse
        parts = -np.einsum("e,eij,eaj->eai", self.volume, stress, self.g)
        return np.bincount(self.rows.ravel(), parts.ravel(), 3 * len(u))

    def stiffness(self, u: np.ndarray) -> sparse.csc_matrix:
        f = self.deformation(u)
        inverse = np.linalg.inv(f).transpose(0, 2, 1)
        log = np.log(np.linalg.det(f))
        b = np.einsum("eij,eaj->eai", inverse, self.g)
        dots = np.einsum("eai,ebi->eab", self.g, self.g)
        block = np.einsum("e,eab,ij->eaibj", self.volume * self.shear, dots, np.eye(3))
        block += np.einsum("e,eai,ebj->eaibj", self.volume * self.lame, b, b)
        block += np.einsum("e,eaj,ebi->eaibj", self.volume * (self.shear - self.lame * log), b, b)
        size = 3 * len(u)
        return sparse.coo_matrix((block.ravel(), (self.i, self.j)), shape=(size, size)).tocsc()

    def minimise(self, load: np.ndarray, u: np.ndarray, inertia: tuple[float, np.ndarray] | None = None) -> np.ndarray:
        """Return the displacements near `u` that minimise the energy minus load . u (+ a/2 |u - b|_M^2)."""
        weight, aim = inertia or (0.0, u)
        u = u.copy()

        def value(u: np.ndarray) -> float:
            away = (u - aim).ravel()
            return self.energy(u) - float(load @ u.ravel()) + 0.5 * weight * float(away @ (self.mass @ away))

        scale = max(float(np.abs(load).max()), float(np.abs(self.force(u)).max()), 1e-6)
        for _ in range(200):
            r = (self.force(u) + load - weight * (self.mass @ (u - aim).ravel()))[self.free]
            if np.abs(r).max() < 1e-9 * scale:
                return u
            matrix = (self.stiffness(u) + weight * self.mass)[self.free][:, self.free].tocsc()
            step = self._descent(matrix, r)
            now, slope = value(u), float(step @ r)
            length = 1.0
            while length > 1e-6:
                trial = u.ravel().copy()
                trial[self.free] += length * step
                trial = trial.reshape(-1, 3)
                if value(trial) <= now - 1e-4 * length * slope + 1e-13 * abs(now):
                    break
                length *= 0.5
            u = trial
        raise AssertionError(f"the reference did not converge: {np.abs(r).max():.2e}")

    def _descent(self, matrix: sparse.csc_matrix, r: np.ndarray) -> np.ndarray:
        """Return the Newton step, with the matrix shifted until the step goes downhill."""
        shift = 0.0
        while True:
            step = splu(matrix + shift * sparse.eye(matrix.shape[0], format="csc")).solve(r)
            if step @ r > 0.0:
                return step
            shift = max(10.0 * shift, 1e-3 * float(np.abs(matrix.diagonal()).mean()))

    def static(self, gravity: np.ndarray, steps: int = 4) -> np.ndarray:
        """Return the equilibrium displacements (n, 3) under `gravity` (3,), reached in load steps."""
        u = np.zeros_like(self.solid.mesh.points)
        load = self.mass @ np.tile(gravity, len(u))
        for k in range(1, steps + 1):
            u = self.minimise(load * k / steps, u)
        return u

    def swing(self, gravity: np.ndarray, pulse: float, dt: float, count: int) -> np.ndarray:
        """Return displacements (count, n, 3) of the bar under `gravity` during `pulse` seconds, then free.

        Implicit midpoint by minimisation: second order, no damping.
        """
        u = np.zeros_like(self.solid.mesh.points)
        v = np.zeros_like(u)
        load = self.mass @ np.tile(gravity, len(u))
        out = np.zeros((count, *u.shape))
        for k in range(count):
            acting = load if (k + 0.5) * dt < pulse else 0.0 * load
            middle = self.minimise(acting, u + 0.5 * dt * v, (4.0 / dt**2, u + 0.5 * dt * v))
            v, u = 4.0 / dt * (middle - u) - v, 2.0 * middle - u
            out[k] = u
        return out
