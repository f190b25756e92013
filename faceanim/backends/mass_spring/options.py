"""Choices of the mass-spring backend."""

from __future__ import annotations

from dataclasses import dataclass

from faceanim.ground.errors import UserError, unknown_name

SCHEMES = ("paper", "semi_implicit", "conjugate_gradient", "block_descent", "explicit", "newton")
INTEGRATORS = ("bdf2", "euler")
QUASI_STATIC = ("integrated", "chebyshev", "waves")


@dataclass(frozen=True)
class Options:
    """How the skin is moved in time.

    scheme : "conjugate_gradient" implicit steps by preconditioned conjugate gradients (the default: right in time,
        stable, fast); "block_descent" the same steps by accelerated sweeps over the vertices, without set-up;
        "newton" the same steps solved to the end, the yardstick; "explicit" leapfrog with automatic substeps;
        "semi_implicit" and "paper" the per-node implicit steps of Zhang, Prakash & Sung (Eqs. 18-19), corrected and
        as printed: relaxers rather than integrators, see the stability atlas
    integrator : "euler" (quiet in contact, the default) or "bdf2" (second order), of the implicit schemes
    iterations : most conjugate gradient iterations in a step
    iteration_tolerance : they stop when one moves no vertex farther [mm]
    symmetric : conjugate gradients work on one half while body, state and control are left-right symmetric
    sweeps : passes of block_descent over the vertices in a step
    adaptive : integrate only near the muscles that act and relax the rest quasi-statically (section 4 of the paper)
    tolerance : what the adaptive partition may cost in accuracy [mm]
    quasi_static : what V_q does: "integrated" like V_d in the same sweeps (right in time), "chebyshev" accelerated
        Jacobi passes along the residual force after V_d, or "waves", the paper's in-place passes in breadth-first order
    passes : quasi-static passes in a step
    sweep_tolerance : sweeps stop early when no vertex wants to move farther [mm]
    secant : "paper" only: the secant stiffness of Eq. 18 (True, as printed) or the tangent
    safety : "explicit" only: share of the largest stable substep that is used
    newton_tolerance : largest movement of the last Newton step [mm]
    newton_most : cap of Newton steps
    """

    scheme: str = "conjugate_gradient"
    integrator: str = "euler"
    iterations: int = 12
    iteration_tolerance: float = 6e-3
    symmetric: bool = True
    sweeps: int = 20
    adaptive: bool = False
    tolerance: float = 0.05
    quasi_static: str = "integrated"
    passes: int = 4
    sweep_tolerance: float = 3e-5
    secant: bool = True
    safety: float = 0.8
    newton_tolerance: float = 1e-4
    newton_most: int = 400

    def __post_init__(self) -> None:
        for kind, value, known in (
            ("scheme", self.scheme, SCHEMES),
            ("integrator", self.integrator, INTEGRATORS),
            ("quasi_static method", self.quasi_static, QUASI_STATIC),
        ):
            if value not in known:
                raise unknown_name(kind, value, known)
        for name in ("iterations", "sweeps", "passes", "newton_most"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} = {getattr(self, name)} must be at least 1")
        for name in ("tolerance", "newton_tolerance", "iteration_tolerance", "sweep_tolerance", "safety"):
            if not getattr(self, name) > 0:
                raise UserError(f"{name} = {getattr(self, name)} must be positive")
