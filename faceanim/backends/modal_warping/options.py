"""Choices of the modal warping backend."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral

from faceanim.ground.errors import UserError, unknown_name

VARIANTS = ("warped", "linear", "consistent", "rotation_strain", "rotation_strain_shape")
INTEGRATORS = ("semi_implicit", "exact", "trapezoid")
AVERAGES = ("plain", "volume")
MASSES = ("consistent", "lumped")
PRECISIONS = ("double", "single")


@dataclass(frozen=True)
class Options:
    """How many modes, how they are warped, and how they move in time.

    modes : how many of the lowest vibration modes are kept
    muscle_modes : add the static answer to each muscle, without which the lowest modes, which are those of the softest
        flaps, would have to stand for every local pull (mode acceleration)
    variant : "rotation_strain" (the default) elements turned and stretched, joined by a Poisson problem, with the
        consistent force: keeps lengths and volume; "consistent" nodes turned by their own rotation, three times faster,
        with the force that is the true derivative of that shape, so that dead loads have an energy and high ones do not
        make it oscillate; "warped" as Choi & Ko, the same shape with forces projected by (R Phi)^T (Eq. 18);
        "rotation_strain_shape" the first shape with the forces of Eq. 18; "linear" no warping: plain modal analysis
    integrator : "semi_implicit" (Eq. 19; damps fast modes), "exact" for a force constant over the step, "trapezoid"
    rotation_average : a node's rotation is the "plain" or the "volume"-weighted mean of its elements' (Eq. 7)
    mass : "consistent" or "lumped"
    coriolis : keep the term R^T R' of Eq. 14 (footnote 2)
    held : further solid nodes that stay at rest in the frame of bone 0 (static position constraints)
    precision : "single" computes the surface in blocks of float32, "double" in float64
    cache : keep the modes on disk
    static_tolerance : relative residual at which an equilibrium is found   static_most : cap of its evaluations
    """

    modes: int = 40
    muscle_modes: bool = True
    variant: str = "rotation_strain"
    integrator: str = "semi_implicit"
    rotation_average: str = "plain"
    mass: str = "consistent"
    coriolis: bool = False
    held: tuple[int, ...] = ()
    precision: str = "double"
    cache: bool = True
    static_tolerance: float = 1e-9
    static_most: int = 2000

    def __post_init__(self) -> None:
        for kind, value, known in (
            ("variant", self.variant, VARIANTS),
            ("integrator", self.integrator, INTEGRATORS),
            ("rotation average", self.rotation_average, AVERAGES),
            ("mass", self.mass, MASSES),
            ("precision", self.precision, PRECISIONS),
        ):
            if value not in known:
                raise unknown_name(kind, value, known)
        for name in ("modes", "static_most"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
                raise UserError(f"{name} = {value} must be a whole number of at least 1")
        if not 0 < self.static_tolerance < 1:
            raise UserError(f"static_tolerance = {self.static_tolerance} must lie between 0 and 1")
        if any(isinstance(i, bool) or not isinstance(i, Integral) or i < 0 for i in self.held):
            raise UserError(f"held = {self.held} must be node numbers, none negative")
