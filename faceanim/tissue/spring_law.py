"""The nonlinear spring law of the skin (Zhang, Prakash, Sung, Eqs. 1-4 and 14; written out in `kernels/springs.py`)."""

from __future__ import annotations

from dataclasses import dataclass

from faceanim.ground.errors import UserError


@dataclass(frozen=True)
class SpringLaw:
    """Parameters shared by all springs of a skin.

    alpha : nonlinearity factor [-] (Eq. 1); 0 gives linear springs
    s0 : elongation at which the stiffness has grown by 2^alpha [mm]; 1 mm reproduces the paper
    beta : repulsion strength factor [-] (Eq. 14)
    zeta : repulsion force scale [-] as a fraction of (stiffness * rest height), so that it has no hidden unit
    uniform_k0 : one stiffness [mN/mm] for every spring, as in the paper's Fig. 2; None = from the membrane modulus
    height_ratio : stiffness of an edge repulsion spring over that of an edge in an equilateral mesh of its height [-]
    reaction : whether an edge repulsion spring pushes back on its edge (exact gradient of an energy); the paper: False
    """

    alpha: float = 1.0
    s0: float = 1.0
    beta: float = 2.0
    zeta: float = 0.3
    uniform_k0: float | None = None
    height_ratio: float = 0.5
    reaction: bool = True

    def __post_init__(self) -> None:
        if not (self.alpha >= 0 and self.s0 > 0 and self.beta > 0 and self.zeta >= 0 and self.height_ratio >= 0):
            raise UserError(f"spring law {self}: alpha, zeta, height_ratio >= 0 and s0, beta > 0 are needed")
        if self.uniform_k0 is not None and not self.uniform_k0 > 0:
            raise UserError(f"spring law: uniform_k0 = {self.uniform_k0} must be positive")
