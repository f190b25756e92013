"""The adaptive partition: what is integrated, what follows quasi-statically, what never moves (section 4 of the paper)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from faceanim.body.body import Body
from faceanim.body.control import Control
from faceanim.geometry import topology
from faceanim.ground.arrays import Bools, Floats, Ints
from faceanim.ground.cache import content_key as cache_key
from faceanim.ground.cache import load_arrays, save_arrays

STATIC, QUASI_STATIC, DYNAMIC = 0, 1, 2
FAINT = 0.05
"""Share of a muscle's strongest pull per area at which its zone ends."""
_VERSION = "partition 4"


@dataclass(frozen=True, eq=False)
class Partition:
    """Which vertices are dynamic (V_d), quasi-static (V_q) and static (V_s), for one set of acting muscles and bones.

    node_set : (n,) 2 dynamic, 1 quasi-static, 0 static   wave : (n,) breadth-first ring of V_q around V_d, else 0
    muscles : (m,) those that may act   bones : (b,) those that may move
    threshold : displacement below which a vertex was declared static [mm]
    error_max, error_rms : of the equilibria with V_s frozen against the full ones, over all vertices [mm]
    seconds : what it cost to compute (0 = read from the cache)
    """

    node_set: np.ndarray
    wave: Ints
    muscles: Bools
    bones: Bools
    threshold: float
    error_max: float
    error_rms: float
    seconds: float

    @property
    def n_dynamic(self) -> int:
        """Number of vertices in V_d."""
        return int((self.node_set == DYNAMIC).sum())

    @property
    def n_quasi_static(self) -> int:
        """Number of vertices in V_q."""
        return int((self.node_set == QUASI_STATIC).sum())

    @property
    def n_static(self) -> int:
        """Number of vertices in V_s."""
        return int((self.node_set == STATIC).sum())

    def covers(self, muscles: Bools, bones: Bools) -> bool:
        """Return whether these acting muscles and moving bones were prepared for."""
        return bool((self.muscles | ~muscles).all() and (self.bones | ~bones).all())


def acting(control: Control) -> tuple[Bools, Bools]:
    """Return which muscles act and which bones are not at rest."""
    moved = np.abs(control.bone_pose - np.eye(4)).max(axis=(1, 2)) > 1e-12
    return np.asarray(control.activation) != 0.0, moved


def full_blast(control: Control) -> Control:
    """Return the control with every acting muscle at 1, for a partition made before the peak is known."""
    return Control(np.where(control.activation != 0.0, 1.0, 0.0), control.bone_pose.copy())


def anchors(body: Body, pose: Floats) -> Floats:
    """Return where the bones carry every rest position, (n, 3) [mm]."""
    moved = np.einsum("bij,nj->nbi", pose[:, :3, :3], body.surface.points) + pose[None, :, :3, 3]
    return np.einsum("nb,nbi->ni", body.attachment.bone_weight, moved)


def dynamic_set(body: Body, controls: Sequence[Control], tolerance: float) -> Bools:
    """Return V_d: zones of the acting muscles, and vertices tied to an anchor that moves by `tolerance` [mm].

    Where a muscle's pull per area is below `FAINT` of its strongest, its zone ends.
    """
    out = np.zeros(len(body.mass), dtype=bool)
    muscles = np.any([acting(c)[0] for c in controls], axis=0)
    u = body.muscles
    density = u.weight / body.surface.vertex_areas[u.node]
    strongest = np.zeros(len(u.names))
    np.maximum.at(strongest, u.muscle, density)
    zone = muscles[u.muscle] & (density > FAINT * strongest[u.muscle])
    out[u.node[zone]] = True
    tied = (body.attachment.stiffness > 0) | body.pinned
    for control in controls:
        shift = anchors(body, control.bone_pose) - body.surface.points
        out |= tied & (np.linalg.norm(shift, axis=1) > tolerance)
    return out


def split(body: Body, dynamic: Bools, travel: Floats, threshold: float) -> tuple[np.ndarray, Ints]:
    """Return node_set and wave: outside V_d, a vertex whose `travel` (n,) [mm] stays below `threshold` is static."""
    quasi = ~dynamic & ~body.pinned & (travel >= threshold)
    node_set = np.zeros(len(travel), dtype=np.uint8)
    node_set[quasi] = QUASI_STATIC
    node_set[dynamic] = DYNAMIC
    adjacent = topology.neighbours(body.surface.triangles, len(travel))
    wave = topology.waves(adjacent, dynamic, quasi)
    wave[quasi & (wave < 0)] = wave.max(initial=0) + 1  # islands without a path to V_d come last
    wave[~quasi] = 0
    return node_set, wave.astype(np.int32)


Solve = Callable[[Control, Ints | None, Floats | None], Floats]
"""(control, free vertices or None for all, guess) -> equilibrium positions (n, 3)."""


def compute(body: Body, controls: Sequence[Control], tolerance: float, solve: Solve) -> Partition:
    """Return the partition for `controls`; the threshold is lowered until the measured error is below `tolerance` [mm]."""
    started = perf_counter()
    full = [solve(c, None, None) for c in controls]
    travel = np.max([np.linalg.norm(x - body.surface.points, axis=1) for x in full], axis=0)
    dynamic = dynamic_set(body, controls, tolerance)
    threshold = tolerance
    for _ in range(8):
        node_set, wave = split(body, dynamic, travel, threshold)
        free = np.flatnonzero((node_set > 0) & ~body.pinned).astype(np.int32)
        miss = [np.linalg.norm(solve(c, free, x) - x, axis=1) for c, x in zip(controls, full, strict=True)]
        worst = float(np.max(miss))
        if worst <= tolerance:
            break
        threshold *= 0.5
    pairs = [acting(c) for c in controls]
    return Partition(
        node_set, wave, np.any([p[0] for p in pairs], axis=0), np.any([p[1] for p in pairs], axis=0), threshold,
        worst, float(np.sqrt(np.mean(np.square(miss)))), perf_counter() - started,
    )  # fmt: skip


def content_key(body: Body, controls: Sequence[Control], tolerance: float) -> str:
    """Return a hash of everything that shapes a partition."""
    u, a, s, contact = body.muscles, body.attachment, body.surface, body.bone_contact
    parts: list[object] = [
        s.points, s.triangles, body.mass, body.membrane_modulus, body.pinned, a.bone_weight, a.stiffness, u.max_force,
        u.muscle, u.node, u.weight, u.kind, u.point, u.bone, u.softening, a.shear, a.shear_limit,
    ]  # fmt: skip
    for bone in body.bones:
        if bone.grid is not None:
            parts += [bone.grid.values, bone.grid.origin, bone.grid.spacing]
    if contact is not None:
        parts += [contact.node, contact.bone, contact.clearance]
    for ball in body.spheres:
        parts += [ball.centre, ball.radius, ball.node, ball.clearance]
    for pair in body.pairs:
        parts += [pair.node, pair.start, pair.triangle, pair.gap]
    parts.append((body.law, a.alpha, a.s0, body.contact_stiffness, tolerance))
    for control in controls:
        parts += [np.round(control.activation, 6), np.round(control.bone_pose, 6)]
    return cache_key(_VERSION, *parts)


def load(key: str, n: int) -> Partition | None:
    """Return the partition cached under `key`, or None if there is none that fits `n` vertices."""
    held = load_arrays("partitions", key)
    try:
        if held is None or held["node_set"].shape != (n,) or held["wave"].shape != (n,):
            return None
        threshold, worst, rms = (float(v) for v in held["numbers"])
        return Partition(held["node_set"], held["wave"], held["muscles"], held["bones"], threshold, worst, rms, 0.0)
    except (KeyError, ValueError):
        return None


def save(key: str, partition: Partition) -> None:
    """Cache `partition` under `key`; a folder that cannot be written is no error."""
    numbers = np.array([partition.threshold, partition.error_max, partition.error_rms])
    save_arrays(
        "partitions", key, node_set=partition.node_set, wave=partition.wave, muscles=partition.muscles,
        bones=partition.bones, numbers=numbers,
    )  # fmt: skip


def widened(body: Body, partition: Partition, positions: Floats) -> Partition:
    """Return `partition` with the static vertices that are away from rest made quasi-static, so that they can return."""
    away = np.linalg.norm(positions - body.surface.points, axis=1) > partition.threshold
    away &= (partition.node_set == STATIC) & ~body.pinned
    if not away.any():
        return partition
    node_set = partition.node_set.copy()
    node_set[away] = QUASI_STATIC
    wave = partition.wave.copy()
    wave[away] = wave.max(initial=0) + 1
    return Partition(
        node_set, wave, partition.muscles, partition.bones, partition.threshold, partition.error_max,
        partition.error_rms, partition.seconds,
    )  # fmt: skip
