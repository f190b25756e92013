"""What drives a body from outside, at one moment: muscle activations, bone poses and loads."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from faceanim.body.body import Body
from faceanim.ground.arrays import Floats
from faceanim.ground.errors import UserError

_ROUNDING = 1e-9
"""By how much an activation may miss its limits."""


@dataclass(eq=False)
class Control:
    """What is asked of a body now.

    activation : (m,) in [0, 1]   bone_pose : (n_bone, 4, 4), rest frame to head frame [mm]
    gravity : (3,) [mm/s^2]   force : (n, 3) on the surface vertices [mN], None = none
    """

    activation: Floats
    bone_pose: Floats
    gravity: Floats = field(default_factory=lambda: np.zeros(3))
    force: Floats | None = None

    @classmethod
    def rest(cls, body: Body) -> Control:
        """Return the control that asks for nothing: no activation, every bone where it was built, no load."""
        return cls(np.zeros(len(body.muscles.names)), np.tile(np.eye(4), (len(body.bones), 1, 1)))

    @property
    def loaded(self) -> bool:
        """Whether gravity or forces act."""
        return bool(self.gravity.any()) or self.force is not None

    def reject_unfit(self, body: Body) -> None:
        """Raise `UserError` unless this fits `body`, holds only finite numbers, and activations within 0 to 1."""
        for name, value, shape in (
            ("activation", self.activation, (len(body.muscles.names),)),
            ("bone_pose", self.bone_pose, (len(body.bones), 4, 4)),
            ("gravity", self.gravity, (3,)),
            ("force", self.force, body.surface.points.shape),
        ):
            if value is None:
                continue
            if np.shape(value) != shape:
                raise UserError(f"control: {name} has shape {np.shape(value)}; {shape} is needed")
            if not np.isfinite(value).all():
                raise UserError(f"control: {name} holds a number that is not finite")
        low, high = self.activation.min(initial=0.0), self.activation.max(initial=1.0)
        if low < -_ROUNDING or high > 1.0 + _ROUNDING:
            worst = low if low < -_ROUNDING else high
            raise UserError(f"control: an activation is {worst:g}; it must be between 0 (at rest) and 1 (all force)")
