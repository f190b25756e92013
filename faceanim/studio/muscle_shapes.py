"""Muscles as lines on a moving face: from their origins on bone to their insertions in skin, or around an opening."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from faceanim.face.muscles import AnyMuscle, LidMuscle, SheetMuscle, SphincterMuscle, both_sides
from faceanim.ground.arrays import Floats, Ints

RING = 36
"""Points of a ring."""
SHEET = (-0.7, 0.0, 0.7)
"""Where fibres of a sheet are drawn, across its half width."""
INSERTION, ORIGIN, AXIS = (214, 52, 48), (40, 160, 74), (52, 104, 214)
"""Colours of marks: where a muscle ends in the skin, where it begins on bone, the ends of a ring's axis."""
QUIET, ACTIVE = np.array([122.0, 22.0, 26.0]), np.array([255.0, 96.0, 24.0])
PROUD = 1.2
"""How far marks stand off bone and skin, towards the front [mm], so that they are not cut by it."""


@dataclass(frozen=True, eq=False)
class _Path:
    muscle: int
    points: Floats
    carrier: Ints


class MuscleLines:
    """The lines of a table of muscles on `face`.

    names : the muscles by full name    segments : (s, 2) indices of points    muscle : (s,) whose segment it is
    mark_colour : (k, 3) sRGB bytes of the marks
    """

    def __init__(self, face: Any, table: dict[str, AnyMuscle]) -> None:
        named = both_sides(table)
        self.names = tuple(named)
        skin, tree = face.mesh.points, cKDTree(face.mesh.points)
        paths = [
            _Path(k, *path) for k, (muscle, side) in enumerate(named.values()) for path in _paths(muscle, side, face)
        ]
        rows = [np.arange(len(p.points)) for p in paths]
        start = np.cumsum([0] + [len(r) for r in rows[:-1]]) if rows else np.zeros(0, int)
        self.segments = np.concatenate(
            [np.stack([r[:-1], r[1:]], axis=1) + s for r, s in zip(rows, start)] or [np.zeros((0, 2), int)]
        )
        self.muscle = np.concatenate([np.full(len(p.points) - 1, p.muscle) for p in paths] or [np.zeros(0, int)])
        self._rest = np.concatenate([p.points for p in paths] or [np.zeros((0, 3))])
        self._carrier = np.concatenate([p.carrier for p in paths] or [np.zeros(0, int)])
        self._vertex = tree.query(self._rest)[1] if len(self._rest) else np.zeros(0, int)
        self._skin, self._middle = skin, 0.5 * (skin.min(axis=0) + skin.max(axis=0))
        self._marks, self._mark_carrier, self.mark_colour = _marks(named)
        self._mark_vertex = tree.query(self._marks)[1] if len(self._marks) else np.zeros(0, int)

    def points(self, skin: Floats, jaw_pose: Floats) -> np.ndarray:
        """Return the ends of all segments, (s, 2, 3) [mm], over the skin (n, 3) with the jaw at `jaw_pose` (4, 4)."""
        at = self._moved(self._rest, self._carrier, self._vertex, skin, jaw_pose)
        return np.asarray(at[self.segments], dtype=np.float32)

    def marks(self, skin: Floats, jaw_pose: Floats) -> np.ndarray:
        """Return where the marks are, (k, 3) [mm]; their colours are `mark_colour` (k, 3)."""
        at = self._moved(self._marks, self._mark_carrier, self._mark_vertex, skin, jaw_pose)
        way = at - self._middle
        at += PROUD * way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
        return at.astype(np.float32)

    def _moved(self, rest: Floats, carrier: Ints, nearest: Ints, skin: Floats, jaw_pose: Floats) -> Floats:
        at, in_skin, on_jaw = rest.copy(), carrier < 0, carrier == 1
        at[in_skin] += skin[nearest[in_skin]] - self._skin[nearest[in_skin]]
        at[on_jaw] = at[on_jaw] @ jaw_pose[:3, :3].T + jaw_pose[:3, 3]
        return at

    def colours(self, activation: dict[str, float], chosen: str = "") -> np.ndarray:
        """Return the colours of the ends of all segments, (s, 2, 3) sRGB bytes; the `chosen` muscle stands out."""
        share = np.array([activation.get(name, 0.0) for name in self.names])
        colour = QUIET + np.sqrt(np.clip(share, 0.0, 1.0))[:, None] * (ACTIVE - QUIET)
        if chosen in self.names:
            colour[self.names.index(chosen)] = (250.0, 206.0, 60.0)
        rows = np.round(colour)[self.muscle].astype(np.uint8)
        return np.repeat(rows[:, None, :], 2, axis=1)


def _paths(muscle: AnyMuscle, side: str, face: Any) -> list[tuple[Floats, Ints]]:
    """Return polylines (k, 3) with what carries each point: -1 the skin, else the number of a bone."""
    if isinstance(muscle, LidMuscle):
        return _lid_paths(face, side)
    if isinstance(muscle, SphincterMuscle):
        return [_ring_path(muscle, face)]
    bone = 1 if muscle.bone == "jaw" else 0
    stops = [muscle.origin, *([muscle.via] if muscle.via else []), muscle.insertion]
    line = np.array(stops, dtype=np.float64)
    carrier = np.array([bone] * (len(line) - 1) + [-1])
    if not isinstance(muscle, SheetMuscle):
        return [(line, carrier)]
    along = line[-1] - line[-2]
    across = np.cross(along, [0.0, 0.0, 1.0])
    across *= muscle.half_width / max(float(np.linalg.norm(across)), 1e-9)
    return [(line + share * across, carrier) for share in SHEET]


def _ring_path(muscle: SphincterMuscle, face: Any) -> tuple[Floats, Ints]:
    angle = np.linspace(0.0, 2.0 * np.pi, RING + 1)
    ring = np.tile(np.array(muscle.centre), (RING + 1, 1))
    ring[:, 0] += muscle.axes[0] * np.cos(angle)
    ring[:, 1] += muscle.axes[1] * np.sin(angle)
    skin = face.mesh.points
    near = skin[np.abs(skin[:, 2] - muscle.centre[2]) < 2.0 * max(muscle.axes)]
    if len(near):
        # The front skin above each point of the ring: the nearest in the picture plane, the foremost of a few.
        found = cKDTree(near[:, :2]).query(ring[:, :2], k=min(4, len(near)))[1].reshape(len(ring), -1)
        ring[:, 2] = near[found, 2].max(axis=1) + 0.5
    return ring, np.full(RING + 1, -1)


def _lid_paths(face: Any, side: str) -> list[tuple[Floats, Ints]]:
    eye = face.lids.get("left" if side == "middle" else side)
    if eye is None:
        return []
    out = []
    for margin in (eye.upper_margin, eye.lower_margin):
        order = margin[np.argsort(face.mesh.points[margin, 0])]
        out.append((face.mesh.points[order].copy(), np.full(len(order), -1)))
    return out


def _marks(named: dict[str, tuple[AnyMuscle, str]]) -> tuple[Floats, Ints, np.ndarray]:
    """Return points (k, 3), what carries each (-1 the skin, else a bone) and colours (k, 3)."""
    rows: list[tuple[Any, int, tuple[int, int, int]]] = []
    for muscle, _ in named.values():
        if isinstance(muscle, SphincterMuscle):
            x, y, z = muscle.centre
            rows += [((x + turn * muscle.axes[0], y, z), -1, AXIS) for turn in (-1.0, 1.0)]
        elif not isinstance(muscle, LidMuscle):
            rows += [(muscle.insertion, -1, INSERTION), (muscle.origin, 1 if muscle.bone == "jaw" else 0, ORIGIN)]
    return (
        np.array([r[0] for r in rows], dtype=np.float64).reshape(-1, 3),
        np.array([r[1] for r in rows], dtype=np.int32),
        np.array([r[2] for r in rows], dtype=np.uint8).reshape(-1, 3),
    )
