"""What a scene's runs are measured against: the motion and the balance of its probes, with an estimate of their error.

Computed by `finite_elements` at two levels of refinement; their difference gives the estimate (Richardson). Known by what
it is made from (scene, levels, assets, versions of this computation), not by the machine, and kept: with the program for
the built-in scenes (`tools/make_references.py`), in the user's cache otherwise.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from faceanim.backends import make_solver
from faceanim.backends.solver import Solver
from faceanim.bench.comparison.scenes import FPS, Level, Scene
from faceanim.elements.factor import Cholesky, has_cholesky
from faceanim.face.library import asset_arrays, asset_folder
from faceanim.ground.arrays import Floats
from faceanim.ground.cache import content_key, load_arrays, save_arrays
from faceanim.ground.errors import AssetError, RunError
from faceanim.ground.notes import tell

VERSION = "reference-1"
"""Change it when a reference would come out differently for the same scene."""


@dataclass(frozen=True, eq=False)
class Reference:
    """Where the probes ought to be, as displacements from rest [mm].

    balance : (m, 3) under the held load   motion : (frames, m, 3) at the end of every frame, first frame excluded
    balance_error, motion_error : estimated RMS error of these [mm]   text : how it was found
    """

    balance: Floats
    motion: Floats
    balance_error: float
    motion_error: float
    text: str

    @property
    def uncertainty(self) -> float:
        """The larger of the two errors [mm]."""
        return max(self.balance_error, self.motion_error)


def rms(field: Floats) -> float:
    """Return the root mean square length of vectors (..., 3)."""
    return float(np.sqrt((field**2).sum(axis=-1).mean()))


def key_of(scene: Scene) -> str:
    """Return what a reference is known by: the scene's times and levels and the files it is made from.

    What `Scene.build` does is not seen: change `VERSION` with the bodies and loads of the scenes.
    """
    parts: list[Any] = [scene.name, scene.rise, scene.duration, scene.release, scene.order, FPS]
    parts += [str(sorted(asdict(level).items())) for level in scene.levels]
    if scene.name.startswith("face-"):
        folder = asset_folder()
        names = ["tissue.toml", "muscles.toml", "jaw.toml", "skull.npz", "action_units.toml"]
        names += [f"face_{level.density}.npz" for level in scene.levels]
        names += sorted(path.relative_to(folder).as_posix() for path in (folder / "expressions").glob("*.toml"))
        parts += [np.frombuffer((folder / name).read_bytes(), np.uint8) for name in names]
    return content_key(VERSION, *parts)


def file_of(scene: Scene) -> str:
    """Return the asset that holds the reference of a built-in scene."""
    return f"references/{scene.name.replace('@', '_')}.npz"


def reference(scene: Scene) -> Reference:
    """Return the reference of a scene: from the program's own files, from the cache, or computed now (minutes).

    Raises `RunError` if it cannot be computed.
    """
    key = key_of(scene)
    kept = _shipped(scene, key) or load_arrays("references", key)
    if kept is None:
        kept = packed(compute(scene), key)
        save_arrays("references", key, **kept)
    return unpacked(kept)


def _shipped(scene: Scene, key: str) -> dict[str, np.ndarray] | None:
    try:
        arrays = asset_arrays(file_of(scene))
    except AssetError:
        return None
    return arrays if str(arrays.get("known_by")) == key else None


def packed(found: Reference, key: str) -> dict[str, np.ndarray]:
    """Return a reference as arrays for a file; lengths in units of 1/4096 mm."""
    return {
        "known_by": np.array(key),
        "text": np.array(found.text),
        "balance": np.rint(4096.0 * found.balance).astype(np.int32),
        "motion": np.rint(4096.0 * found.motion).astype(np.int32),
        "errors": np.array([found.balance_error, found.motion_error]),
    }


def unpacked(arrays: dict[str, np.ndarray]) -> Reference:
    """Return the reference that `packed` made arrays of."""
    balance, motion = (arrays[name].astype(np.float64) / 4096.0 for name in ("balance", "motion"))
    first, second = (float(e) for e in arrays["errors"])
    return Reference(balance, motion, first, second, str(arrays["text"]))


def compute(scene: Scene) -> Reference:
    """Return the reference of a scene, computed at both of its levels."""
    (low_balance, low_motion), (balance, motion) = (_level(scene, level) for level in scene.levels)
    ratio = _refinement(scene) ** scene.order - 1.0
    low, high = scene.levels
    words = (
        f"finite elements of order {high.order} on the {high.density} mesh, {high.steps_per_frame * FPS:g} steps/s; "
        f"error by the difference from order {low.order} on the {low.density} mesh at {low.steps_per_frame * FPS:g} steps/s"
    )
    balance_error = rms(balance - low_balance) / ratio
    if scene.exact is not None:
        exact = scene.exact(scene.probes)
        words += f"; balance exact, from which that of the elements differs by {rms(balance - exact):.2g} mm RMS"
        balance, balance_error = exact, 0.0
    return Reference(balance, motion, balance_error, rms(motion - low_motion) / ratio, words)


def _refinement(scene: Scene) -> float:
    """Return how many times smaller the elements of the second level are."""
    first, second = (_elements(scene, level) for level in scene.levels)
    return float((second / first) ** (1.0 / 3.0))


def _elements(scene: Scene, level: Level) -> int:
    solid = scene.stage(level.density).body.solid
    assert solid is not None
    return len(solid.mesh.tets)


def _level(scene: Scene, level: Level) -> tuple[Floats, Floats]:
    """Return balance (m, 3) and motion (frames, m, 3) of the probes at one level."""
    stage = scene.stage(level.density)
    solver: Any = make_solver("finite_elements", stage.body, _options(level))
    if has_cholesky():
        solver.elements.factorisation = lambda free: Cholesky(solver.elements, free)
    probe = Probe(scene, level.density, solver)
    name = f"reference of {scene.name}, {level.density} mesh"
    tell(f"{name}: balance")
    state = solver.solve_static(stage.ask(scene.held_share)) if scene.release else solver.rest()
    balance = probe(state)
    dt = 1.0 / FPS / level.steps_per_frame
    motion = np.empty((scene.frames, *balance.shape))
    for frame in range(scene.frames):
        for k in range(1, level.steps_per_frame + 1):
            solver.step(state, state, stage.ask(scene.share(frame / FPS + k * dt)), dt)
        motion[frame] = probe(state)
        tell(f"{name}: motion", frame + 1, scene.frames)
    if not scene.release:
        tell(f"{name}: balance")
        balance = probe(solver.solve_static(stage.ask(scene.held_share), state))
    if not np.isfinite(motion).all():
        raise RunError(f"{name} is not finite")
    return balance, motion


def _options(level: Level) -> Any:
    from faceanim.backends import backend_class

    return backend_class("finite_elements").Options(order=level.order, integrator="trapezoid", tolerance=1e-7)


class Probe:
    """Reads the displacement of a scene's probes from a solver's states, (m, 3) [mm]."""

    def __init__(self, scene: Scene, density: str, solver: Solver) -> None:
        self._vertex, self._rest, self._solver = scene.probe_vertices(density), scene.probes, solver
        self.points = scene.stage(density).body.surface.points.copy()

    def __call__(self, state: Any) -> Floats:
        self._solver.surface(state, self.points)
        return self.points[self._vertex] - self._rest
