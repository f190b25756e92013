"""What the backends are compared on: bars, a block, a patch of skin, a face; each a body and a load that comes and stays.

A scene says nothing of backends. Its probes are material points that every density of the body has among its surface
vertices, so that runs of any density compare point by point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from faceanim.bench.comparison import bodies
from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.errors import UserError, unknown_name
from faceanim.tissue.material import Material

if TYPE_CHECKING:
    from faceanim.expression.expression import Expression
    from faceanim.face.face import Face

DENSITIES = ("coarse", "default", "fine")
FPS = 30.0
"""Frames per second at which every scene is watched."""


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene at one density: the body, what is asked of it at a share of the load, and the face if it is one."""

    body: Body
    ask: Callable[[float], Control]
    face: Face | None = None


@dataclass(frozen=True)
class Level:
    """How a reference is computed: `finite_elements` of some order at some density, stepped by the trapezoid rule."""

    density: str
    order: int
    steps_per_frame: int


@dataclass(frozen=True, eq=False)
class Scene:
    """A load case.

    name, title, about : for people   build : density -> Stage
    rise : [s] in which the load comes, smoothly   duration : [s] watched   release : the load acts from the beginning,
    in balance, and is let go
    levels : two references, the second the better one   order : of convergence in the size of elements [-]
    exact : (points (m, 3) at rest) -> their displacement in balance (m, 3) [mm], where it is known in closed form
    """

    name: str
    title: str
    about: str
    build: Callable[[str], Stage]
    rise: float
    duration: float
    levels: tuple[Level, Level]
    order: int
    release: bool = False
    exact: Callable[[Floats], Floats] | None = None

    @property
    def frames(self) -> int:
        """Frames after the first one, which shows the beginning."""
        return round(self.duration * FPS)

    def share(self, t: float) -> float:
        """Return the share of the load at time `t` [s]: a minimum-jerk rise, then held; nothing after a release."""
        if self.release:
            return 0.0
        u = min(1.0, max(0.0, t / self.rise))
        return min(1.0, u**3 * (10.0 + u * (6.0 * u - 15.0)))

    @property
    def held_share(self) -> float:
        """The share of the load whose balance is compared: the last one, or the first one of a release."""
        return 1.0

    @cached_property
    def stages(self) -> dict[str, Stage]:
        """Stages built so far, by density."""
        return {}

    def stage(self, density: str) -> Stage:
        """Return the scene at a density, built once; raise `UserError` for an unknown one."""
        if density not in DENSITIES:
            raise unknown_name("density", density, DENSITIES)
        if density not in self.stages:
            self.stages[density] = self.build(density)
        return self.stages[density]

    @cached_property
    def probes(self) -> Floats:
        """Where the probes rest, (m, 3) [mm]: the free vertices of the coarse surface, of a face those in sight."""
        return np.ascontiguousarray(self.stage("coarse").body.surface.points[self._in_sight])

    @cached_property
    def _in_sight(self) -> Bools:
        stage = self.stage("coarse")
        chosen = ~stage.body.pinned
        if stage.face is not None:
            from faceanim.face.attach import MUCOSA

            chosen &= stage.face.region != MUCOSA
        return np.asarray(chosen)

    @cached_property
    def regions(self) -> dict[str, Bools]:
        """Which probes belong to each region of a face, name -> (m,); none of them overlap. Empty for other bodies."""
        face = self.stage("coarse").face
        if face is None:
            return {}
        from faceanim.surgery.distance_map import REGIONS, face_regions

        return {name: mask[self._in_sight] for name, mask in face_regions(face).items() if name in REGIONS}

    def probe_vertices(self, density: str) -> Ints:
        """Return the surface vertices that are the probes, (m,); raise `UserError` if a density lacks some."""
        gap, vertex = cKDTree(self.stage(density).body.surface.points).query(self.probes)
        if gap.max() > 1e-6:
            raise UserError(f"scene {self.name}: {int((gap > 1e-6).sum())} probes are no vertices at density {density}")
        return np.asarray(vertex, dtype=np.int32)


STRAIGHT = Material("jelly", bodies.DENSITY, 30.0, 0.0)
JELLY = Material("jelly", bodies.DENSITY, 30.0, 0.4)
MUSCLE = Material("muscle", bodies.DENSITY, 15.0, 0.49)
SOLID = (Level("coarse", 2, 4), Level("default", 2, 8))
SKIN_LEVELS = (Level("coarse", 2, 1), Level("default", 2, 2))


def _gravity(body: Body, acceleration: tuple[float, float, float]) -> Callable[[float], Control]:
    def ask(share: float) -> Control:
        control = Control.rest(body)
        control.gravity[:] = share * np.asarray(acceleration)
        return control

    return ask


def _moved(body: Body, pose: Callable[[float], Floats], activation: float = 0.0) -> Callable[[float], Control]:
    """Return what moves the last bone to `pose` (4, 4) of the share and activates every muscle."""

    def ask(share: float) -> Control:
        control = Control.rest(body)
        control.bone_pose[-1] = pose(share)
        control.activation[:] = share * activation
        return control

    return ask


def _shifted(by: tuple[float, float, float]) -> Callable[[float], Floats]:
    def pose(share: float) -> Floats:
        out = np.eye(4)
        out[:3, 3] = share * np.asarray(by)
        return out

    return pose


def _twisted(angle: float) -> Callable[[float], Floats]:
    """Return the pose turned about the bar's axis by a share of `angle` [rad]."""

    def pose(share: float) -> Floats:
        c, s = np.cos(share * angle), np.sin(share * angle)
        out = np.eye(4)
        out[1:3, 1:3] = [[c, -s], [s, c]]
        middle = np.array([0.0, 0.5 * bodies.BAR[1], 0.5 * bodies.BAR[2]])
        out[:3, 3] = middle - out[:3, :3] @ middle
        return out

    return pose


PULL = 6.0 * 9810.0
"""Gravity along the bar in tension [mm/s^2]."""


def hanging(points: Floats) -> Floats:
    """Return the exact displacement (m, 3) [mm] of a neo-Hookean bar with nu = 0 that hangs along x under `PULL`.

    No side contracts, so that P = mu (l - 1/l) = rho g (L - X) along the bar: with s = rho g (L - X) / mu the stretch is
    l = (s + sqrt(s^2 + 4)) / 2, and its integral from the held end is known.
    """
    length, k = bodies.BAR[0], STRAIGHT.density * PULL / STRAIGHT.shear_modulus
    s = k * (length - points[:, 0])

    def integral(s: Any) -> Any:
        return 0.25 * s**2 + 0.25 * s * np.sqrt(s**2 + 4.0) + np.arcsinh(0.5 * s)

    out = np.zeros_like(points)
    out[:, 0] = (integral(k * length) - integral(s)) / k - points[:, 0]
    return out


def _bar_bend(density: str) -> Stage:
    body = bodies.bar(density, JELLY)
    return Stage(body, _gravity(body, (0.0, -9810.0, 0.0)))


def _bar_tension(density: str) -> Stage:
    body = bodies.bar(density, STRAIGHT)
    return Stage(body, _gravity(body, (PULL, 0.0, 0.0)))


def _bar_twist(density: str) -> Stage:
    body = bodies.bar(density, JELLY, both_ends=True)
    return Stage(body, _moved(body, _twisted(np.pi)))


def _bar_release(density: str) -> Stage:
    body = bodies.bar(density, JELLY, damping=2.0, stiffness_damping=0.001)
    return Stage(body, _gravity(body, (0.0, -4905.0, 0.0)))


def _block_shear(density: str) -> Stage:
    body = bodies.bar(density, MUSCLE, size=bodies.BLOCK, both_ends=True)
    return Stage(body, _moved(body, _shifted((0.0, 6.0, 0.0))))


def _skin_pull(density: str) -> Stage:
    body = bodies.patch(density)
    return Stage(body, _moved(body, _shifted((0.0, 0.0, 0.0)), activation=1.0))


def _skin_compress(density: str) -> Stage:
    body = bodies.patch(density)
    return Stage(body, _moved(body, _shifted((-4.0, 0.0, 0.0))))


def _face(expression: str, intensity: float) -> Callable[[str], Stage]:
    """Return what builds the default head showing an expression."""

    def build(density: str) -> Stage:
        from faceanim.expression.library import load_expression
        from faceanim.face.library import load_face
        from faceanim.session.command import Command

        face = load_face(density=density)
        body = face.body()
        command = Command(face, body, load_expression(expression))
        return Stage(body, lambda share: command.at(intensity * share), face)

    return build


def _face_bone(density: str) -> Stage:
    from faceanim.face.library import load_face

    face = load_face(density=density)
    body = face.body()
    return Stage(body, _moved(body, _shifted((2.0, 0.0, 5.0))), face)


FACE = (Level("coarse", 1, 1), Level("default", 1, 2))
FINE_FACE = (Level("default", 1, 1), Level("fine", 1, 2))
"""On the fine mesh steps with a moving jaw do not converge: the film over the teeth folds."""


def _face_scene(
    name: str, title: str, about: str, build: Callable[[str], Stage], levels: tuple[Level, Level] = FACE
) -> Scene:
    return Scene(f"face-{name}", title, about, build, rise=0.3, duration=0.6, levels=levels, order=2)


SCENES: dict[str, Scene] = {
    scene.name: scene
    for scene in (
        Scene(
            "bar-bend",
            "A bar bends under gravity",
            "100 x 20 x 20 mm of jelly, 30 kPa, held at one end, sags by more than half its length.",
            _bar_bend,
            0.4,
            1.0,
            SOLID,
            3,
        ),
        Scene(
            "bar-tension",
            "A bar hangs and stretches",
            "The same bar without lateral contraction (Poisson's ratio 0) "
            "under six times gravity along its axis: the balance is known exactly.",
            _bar_tension,
            0.4,
            0.8,
            SOLID,
            3,
            exact=hanging,
        ),
        Scene(
            "bar-twist",
            "A bar is twisted by half a turn",
            "Both ends held, the far one turned about the axis.",
            _bar_twist,
            0.4,
            0.8,
            SOLID,
            3,
        ),
        Scene(
            "bar-release",
            "A bent bar is let go",
            "In balance under half of gravity, then without it: it swings, lightly damped.",
            _bar_release,
            0.4,
            0.8,
            SOLID,
            3,
            release=True,
        ),
        Scene(
            "block-shear",
            "A block of muscle is sheared at its end",
            "50 x 10 x 10 mm, Poisson's ratio 0.49, the far "
            "end moved sideways by 6 mm (after You, Zhang & Comninos, case 3).",
            _block_shear,
            0.3,
            0.6,
            SOLID,
            3,
        ),
        Scene(
            "skin-pull",
            "A muscle pulls a patch of skin",
            "Skin on fat on bone, 60 x 60 x 8 mm; a pull towards a point on the bone.",
            _skin_pull,
            0.3,
            0.6,
            SKIN_LEVELS,
            3,
        ),
        Scene(
            "skin-compress",
            "A patch of skin is pushed together",
            "The bone under one half moves 4 mm towards the other.",
            _skin_compress,
            0.3,
            0.6,
            SKIN_LEVELS,
            3,
        ),
        _face_scene(
            "smile",
            "The face smiles",
            "Happiness at full intensity, action units 6 and 12.",
            _face("happiness", 1.0),
            FINE_FACE,
        ),
        _face_scene("jaw-open", "The jaw opens", "By half, about 20 mm between the incisors.", _face("26", 0.5)),
        _face_scene(
            "surprise", "The face is surprised", "Brows, lids and jaw at 0.75 intensity.", _face("surprise", 0.75)
        ),
        _face_scene(
            "bone-move",
            "A bone is moved",
            "The jaw 5 mm forward and 2 mm to the subject's left, muscles at rest.",
            _face_bone,
        ),
    )
}
"""The built-in scenes by name; `face-NAME` is any expression of the library as well."""


def expression_scene(expression: Expression) -> Scene:
    """Return the default head showing any expression."""

    def build(density: str) -> Stage:
        from faceanim.face.library import load_face
        from faceanim.session.command import Command

        face = load_face(density=density)
        body = face.body()
        command = Command(face, body, expression)
        return Stage(body, command.at, face)

    return _face_scene(expression.name, f"The face shows {expression.name}", expression.formula, build)


def scene_named(name: str) -> Scene:
    """Return a scene; `face-NAME` or `face-NAME@0.5` shows an expression of the library, at an intensity.

    Raises `UserError` listing the scenes.
    """
    if name in SCENES:
        return SCENES[name]
    from faceanim.expression.library import expression_names

    word, _, share = name.removeprefix("face-").partition("@")
    if name.startswith("face-") and word in expression_names():
        try:
            intensity = float(share or 1.0)
        except ValueError:
            intensity = -1.0
        if not 0.0 < intensity <= 1.0:
            raise UserError(f"scene {name!r}: the intensity after @ must be above 0 and at most 1")
        about = f"{word.capitalize()} at {intensity:g} intensity."
        return _face_scene(name.removeprefix("face-"), f"The face shows {word}", about, _face(word, intensity))
    raise unknown_name("scene", name, [*SCENES, *(f"face-{word}" for word in expression_names())])
