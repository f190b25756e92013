"""Taking flesh out of moved bones, judged as in Table 2 of the mixed-element paper.

Vertices lie densely on the resting bone of the default head where flesh covers it. The bone moves in steps of less
than 3 mm; in each step those that it has run into are moved out along the direction of its distance field, and the
exact depth of what was moved is measured afterwards. An error vertex is one that is more than 0.1 mm off the surface.
Vertices moved against the bone's motion ("against") were pinched in a hollow, or left by the far side of a wall
thinner than a step; their number hardly depends on the step, so that most are of the first kind.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from scipy.spatial.transform import Rotation

from faceanim.elements.contact import imposed, pose_between, steps_needed
from faceanim.face.face import Face
from faceanim.geometry.bone_field import BoneField, bone_field
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.notes import tell

TABLE_2 = {"mandible": (0.468, 3258, 33, 1.01), "mid-face": (0.538, 3657, 56, 1.53)}
"""Seconds, imposed vertices, error vertices, error ratio [%], printed; which procedure is which is not."""
ERROR = 0.1
"""An error vertex is farther than this from the surface that it was moved to [mm]."""
CLEARANCE = 0.02
"""Vertices lie so far before the bone at rest [mm]."""
WAYS = (("linear", 1), ("mean", 3), ("spline", 3), ("nearest", 1), ("nearest", 3))
"""How the field is read and how often a vertex is looked at in a step; the first is the paper's."""
VERTICES = 3500
SPACING = 1.0
"""Of the field's lattice [mm]."""


@dataclass(frozen=True)
class Contact:
    """One procedure with one reading.

    seconds : of all steps, without making the field, which took `field_seconds` once   imposed : vertices moved
    errors : those off by more than `ERROR` after a step   worst [mm]   left_inside : at the end
    buried : times that a vertex lay too deep for the field   against : moved against the bone's motion
    """

    procedure: str
    reading: str
    sweeps: int
    steps: int
    seconds: float
    imposed: int
    errors: int
    worst: float
    buried: int
    left_inside: int
    against: int
    field_seconds: float

    @property
    def ratio(self) -> float:
        """Error vertices over imposed ones [%]."""
        return 100.0 * self.errors / max(self.imposed, 1)


def covering(bone: TriMesh, which: Ints, count: int) -> Floats:
    """Return about `count` points evenly on the triangles `which`, a little before them, (k, 3) [mm]."""
    rng = np.random.default_rng(3)
    area = bone.areas[which]
    on = which[rng.choice(len(which), size=count, p=area / area.sum())]
    a, b = rng.uniform(size=(2, count))
    turned = a + b > 1.0
    a, b = np.where(turned, 1.0 - a, a), np.where(turned, 1.0 - b, b)
    corner = bone.points[bone.triangles[on]]
    at = corner[:, 0] + a[:, None] * (corner[:, 1] - corner[:, 0]) + b[:, None] * (corner[:, 2] - corner[:, 0])
    return np.asarray(at + CLEARANCE * bone.normals_by_area[on] / bone.areas[on][:, None])


def leading(bone: TriMesh, way: Floats, low: Floats, high: Floats) -> Ints:
    """Return the triangles that go ahead when the bone goes along `way` (3,), with middles between `low` and `high`."""
    middle = bone.points[bone.triangles].mean(axis=1)
    ahead = bone.normals_by_area @ way > 0.2 * bone.areas
    return np.flatnonzero(ahead & ((middle >= low) & (middle <= high)).all(axis=1)).astype(np.int32)


def procedures(face: Face) -> dict[str, tuple[TriMesh, Ints, Floats]]:
    """Return for each procedure the bone, the triangles that flesh covers and the pose (4, 4) it goes to.

    The mandible goes 8 mm forward and turns by 3 degrees, the mid-face 12 mm forward.
    """
    skull = face.skull
    centre = 0.5 * (skull.condyle_left + skull.condyle_right)
    forward = np.array([0.0, 0.0, 1.0])
    jaw = np.eye(4)
    jaw[:3, :3] = Rotation.from_rotvec([-np.deg2rad(3.0), 0.0, 0.0]).as_matrix()
    jaw[:3, 3] = centre - jaw[:3, :3] @ centre + 8.0 * forward
    middle = np.eye(4)
    middle[2, 3] = 12.0
    wide = np.full(3, np.inf)
    below_orbits = np.array([np.inf, skull.landmarks["nasion"][1], np.inf])
    before_condyles = np.array([-np.inf, -np.inf, centre[2]])
    return {
        "mandible": (skull.jaw, leading(skull.jaw, forward, -wide, wide), jaw),
        "mid-face": (skull.cranium, leading(skull.cranium, forward, before_condyles, below_orbits), middle),
    }


def moved_out(field: BoneField, points: Floats, pose: Floats, reading: str, sweeps: int) -> dict[str, float | int]:
    """Move the bone to `pose` (4, 4) in steps and take the `points` (n, 3) out of it; return the figures of `Contact`."""
    goal, start = pose[None], np.eye(4)[None]
    steps = steps_needed([field], start, goal)
    place, hit = points.copy(), np.zeros(len(points), dtype=bool)
    seconds, worst, buried = 0.0, 0.0, 0
    wrong, against = np.zeros(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    before = start[0]
    for k in range(1, steps + 1):
        now = pose_between(start, goal, k / steps)[0]
        begin = perf_counter()
        out = imposed(place, field, now, reading=reading, sweeps=sweeps)
        place[out.chosen] += out.move
        seconds += perf_counter() - begin
        way = place[out.chosen] @ (now - before)[:3, :3].T + (now - before)[:3, 3]
        against[out.chosen[np.einsum("ki,ki->k", out.move, way) < 0.0]] = True
        before = now
        off = np.abs(field.exact(place[out.chosen], now))
        hit[out.chosen] = True
        wrong[out.chosen[off > ERROR]] = True
        worst, buried = max(worst, float(off.max(initial=0.0))), buried + len(out.buried)
    last = np.maximum(field.exact(place, pose), 0.0)
    return {
        "steps": steps, "seconds": seconds, "imposed": int(hit.sum()), "errors": int(wrong.sum()), "worst": worst,
        "buried": buried, "left_inside": int((last > ERROR).sum()), "against": int(against.sum()),
    }  # fmt: skip


def contacts(*, vertices: int = VERTICES, spacing: float = SPACING) -> Iterator[Contact]:
    """Yield the figures of both procedures by every reading; compiled before anything is timed."""
    for name, (bone, which, pose) in procedures(Face.from_assets("default", "default")).items():
        tell(f"flesh before the {name}")
        bone_field(bone, spacing=spacing)
        begin = perf_counter()
        field = bone_field(bone, spacing=spacing)
        made = perf_counter() - begin
        points = covering(bone, which, vertices)
        for reading, sweeps in WAYS:
            moved_out(field, points[:10], pose, reading, sweeps)
            found = moved_out(field, points, pose, reading, sweeps)
            yield Contact(name, reading, sweeps, field_seconds=made, **found)  # type: ignore[arg-type]
