"""How an expression becomes what is asked of a body: activations and the pose of the jaw, at any intensity."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.expression.expression import Expression

if TYPE_CHECKING:
    from faceanim.face.face import Face


class Command:
    """An expression on the body of a face; raises `UserError` for a muscle that the body lacks."""

    def __init__(self, face: Face, body: Body, expression: Expression) -> None:
        self.face, self.body = face, body
        self.drive = expression.drive(body.muscles.names)
        self._jaw = next((k for k, bone in enumerate(body.bones) if bone.name == "jaw"), None)

    def at(self, intensity: float, out: Control | None = None) -> Control:
        """Return the control at `intensity` [0, 1] of the expression, written into `out` if given."""
        out = Control.rest(self.body) if out is None else out
        np.multiply(self.drive.activation, intensity, out=out.activation)
        if self._jaw is not None:
            jaw = self.drive.jaw
            out.bone_pose[self._jaw] = self.face.jaw.pose(
                intensity * jaw.opening, intensity * jaw.lateral, intensity * jaw.protrusion
            )
        return out
