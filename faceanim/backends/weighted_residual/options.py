"""Choices of the weighted residual backend and of the method beneath it."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral

import numpy as np

from faceanim.ground.errors import UserError, unknown_name

BASES = ("navier", "paper", "paper_linear")
METHODS = ("nitsche", "collocation")
SOLVERS = ("qr", "normal_equations", "svd")


@dataclass(frozen=True)
class Options:
    """Which trial fields, how they are fitted to the boundary, and how flesh is cut into patches.

    basis : "navier" (default) all polynomials up to `degree` that solve Navier's equation; "paper" the 36 `terms` fields
        of the paper; "paper_linear" these and the 12 linear fields
    method : "nitsche" (default) weights the residuals by the energy, with the penalty gamma E / l on displacements;
        "collocation" sums their squares at the points, as the paper does
    displacement_weight : collocation only; a displacement residual counts this times E / l beside tractions; 0.01 is
        the paper's sum of metres and pascals for its block
    solver : collocation only; "qr" of the scaled columns, "normal_equations" (paper Eq. 12), "svd" of the scaled columns
    cut_off : eigenvalues below this share of the largest are left out
    reach : [mm] flesh within this way of a pulled vertex answers it; a body no larger than two reaches is one patch
    patch_degree : degree of the polynomials in a patch of a larger body, where `basis` is "navier"
    corrections : how often what superposed patches leave unbalanced is answered by columns from skin to bone; 0 = the
        patches alone, which on a face give little more than half of the movement
    limit : [-] strain of the surface towards which the answer of a muscle saturates; linear theory means little beyond
    cache : keep the answers on disk
    """

    basis: str = "navier"
    degree: int = 8
    terms: int = 5
    method: str = "nitsche"
    gamma: float = 100.0
    displacement_weight: float = 1.0
    solver: str = "qr"
    cut_off: float = 1e-12
    reach: float = 32.0
    patch_degree: int = 5
    corrections: int = 3
    limit: float = 0.8
    cache: bool = True

    def __post_init__(self) -> None:
        for kind, value, known in (
            ("basis", self.basis, BASES),
            ("method", self.method, METHODS),
            ("solver", self.solver, SOLVERS),
        ):
            if value not in known:
                raise unknown_name(kind, value, known)
        for name in ("degree", "terms", "patch_degree"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
                raise UserError(f"{name} = {value} must be a whole number of at least 1")
        if isinstance(self.corrections, bool) or not isinstance(self.corrections, Integral) or self.corrections < 0:
            raise UserError(f"corrections = {self.corrections} must be a whole number of at least 0")
        for name in ("gamma", "displacement_weight", "reach", "limit"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise UserError(f"{name} = {value} must be positive and finite")
        if not 0 <= self.cut_off < 1e-3:
            raise UserError(f"cut_off = {self.cut_off} must lie between 0 and 0.001")
