"""What drives a body from outside, at one moment: muscle activations and bone poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from faceanim.body.body import Body
from faceanim.ground.arrays import Floats


@dataclass(eq=False)
class Control:
    """activation : (m,) in [0, 1];  bone_pose : (n_bone, 4, 4), rest frame to head frame [mm]."""

    activation: Floats
    bone_pose: Floats

    @classmethod
    def rest(cls, body: Body) -> Control:
        """Return the control that asks for nothing: no activation, every bone where it was built."""
        return cls(np.zeros(len(body.muscles.names)), np.tile(np.eye(4), (len(body.bones), 1, 1)))
