"""A small face and a solver without physics, to test what surrounds them."""

from __future__ import annotations

from dataclasses import dataclass
from time import sleep
from types import SimpleNamespace
from typing import Any

import numpy as np

from faceanim.backends.solver import Energy, State, StepReport
from faceanim.body.body import Attachment, Body, Bone, Muscles
from faceanim.body.control import Control
from faceanim.expression.action_units import load_action_units
from faceanim.geometry.shapes import sphere
from faceanim.geometry.surface import TriMesh
from faceanim.tissue.spring_law import SpringLaw

UNPAIRED = ("procerus", "orbicularis_oris")


def _muscles() -> tuple[str, ...]:
    """Return full names of every muscle that the action units use."""
    bases = sorted({name for unit in load_action_units().values() for name in unit.muscles})
    return tuple(
        full for base in bases for full in ((base,) if base.startswith(UNPAIRED) else (f"{base}_left", f"{base}_right"))
    )


MUSCLES = _muscles()


def patch(size: int = 9) -> TriMesh:
    """Return a flat square of skin, 80 mm wide, in the plane z = 90."""
    line = np.linspace(-40.0, 40.0, size)
    y, x = np.meshgrid(line, line, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 90.0)], axis=1)
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    right, up = corner + 1, corner + size
    triangles = np.concatenate([np.stack([corner, right, up], 1), np.stack([right, up + 1, up], 1)])
    return TriMesh(points, triangles)


def toy_body(mesh: TriMesh | None = None) -> Body:
    """Return a patch of skin on a cranium and a jaw (the lower half), each muscle pulling one vertex."""
    mesh = patch() if mesh is None else mesh
    n, m = len(mesh.points), len(MUSCLES)
    jaw = (mesh.points[:, 1] < 0.0).astype(np.float64)
    count = np.arange(m, dtype=np.int32)
    return Body(
        surface=mesh,
        mass=np.full(n, 1e-4),
        membrane_modulus=np.full(len(mesh.triangles), 30.0),
        law=SpringLaw(),
        damping=10.0,
        pinned=np.zeros(n, dtype=bool),
        attachment=Attachment(np.stack([1.0 - jaw, jaw], axis=1), np.ones(n)),
        muscles=Muscles(
            names=MUSCLES,
            max_force=np.full(m, 10.0),
            muscle=count,
            node=(count * 7 % n).astype(np.int32),
            weight=np.ones(m),
            kind=np.zeros(m, dtype=np.int32),
            point=np.zeros((m, 3)),
            bone=np.zeros(m, dtype=np.int32),
            softening=np.ones(m),
        ),
        bones=(Bone("cranium"), Bone("jaw")),
    )


class ToyJaw:
    """A jaw that slides: 40 mm down, 10 mm aside, 8 mm forward."""

    def pose(self, opening: float, lateral: float = 0.0, protrusion: float = 0.0) -> np.ndarray:
        """Return the (4, 4) pose [mm]."""
        pose = np.eye(4)
        pose[:3, 3] = 10.0 * lateral, -40.0 * opening, 8.0 * protrusion
        return pose


def toy_face() -> Any:
    """Return what a session needs of a face."""
    body = toy_body()
    return SimpleNamespace(
        name="toy",
        density="coarse",
        muscle_source="built-in",
        mesh=body.surface,
        muscle_names=MUSCLES,
        jaw=ToyJaw(),
        body=lambda: body,
        landmarks={"cheilion_left": 44, "cheilion_right": 36, "lid_upper_mid_left": 60, "lid_lower_mid_left": 51},
        skull=SimpleNamespace(),
        cranium=sphere(30.0, 1),
        jaw_mesh=sphere(20.0, 1),
        parts=(),
        texture=np.full((4, 4, 3), 200, np.uint8),
        uv=(body.surface.points[:, :2] + 40.0) / 80.0,
        uv_triangles=body.surface.triangles,
    )


@dataclass(frozen=True)
class ToyOptions:
    """scheme : ignored    blow_up : time from which positions are not numbers [s]    pause : seconds a step takes."""

    scheme: str = "toy"
    adaptive: bool = False
    threads: int = 1
    blow_up: float = np.inf
    pause: float = 0.0


class ToySolver:
    """Every vertex follows its bones at once; pulled vertices move 10 mm along z at activation 1."""

    Options = ToyOptions
    dt_max = np.inf

    def __init__(self, body: Body, options: ToyOptions) -> None:
        self.body, self.options = body, options
        self.prepared = 0

    def prepare(self, control: Control) -> None:
        """Count how often a session asked for preparation."""
        self.prepared += 1

    def rest(self) -> State:
        """Return the body at rest."""
        return State(self.body.surface.points.copy(), np.zeros_like(self.body.surface.points))

    def step(self, state_in: State, state_out: State, control: Control, dt: float) -> StepReport:
        """Jump to where the control asks for."""
        if self.options.pause:
            sleep(self.options.pause)
        points = self.body.surface.points
        homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
        carried = np.einsum("bij,nj->nbi", control.bone_pose[:, :3], homogeneous)
        state_out.q[:] = np.einsum("nb,nbi->ni", self.body.attachment.bone_weight, carried)
        state_out.q[self.body.muscles.node, 2] += 10.0 * control.activation
        state_out.t = state_in.t + dt
        if state_out.t > self.options.blow_up:
            state_out.q[3] = np.nan
        return StepReport(1, 0.0, True, {"dynamic": 1e-5})

    def solve_static(self, control: Control, guess: State | None = None) -> State:
        """Return the end of a step."""
        state = self.rest()
        self.step(state, state, control, 1.0)
        return state

    def surface(self, state: State, out: np.ndarray) -> None:
        """Write the points."""
        out[:] = state.q

    def energy(self, state: State, control: Control) -> Energy:
        """Return no energy."""
        return Energy(0.0, 0.0, 0.0, 0.0, 0.0)
