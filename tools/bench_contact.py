"""Time and judge how flesh is taken out of moved bones, beside Table 2 of the mixed-element paper.

    python tools/bench_contact.py [--spacing 1.0] [--vertices 3500] [--output contact.json]

Vertices lie densely on the resting bone of the default head where flesh covers it. The bone moves in steps of less
than 3 mm; in each step those that it has run into are moved out along the direction of its distance field, and the
exact depth of what was moved is measured afterwards. An error vertex is one that is more than 0.1 mm off the surface.
Vertices moved against the bone's motion ("against") were pinched in a hollow, or left by the far side of a wall
thinner than a step; their number hardly depends on the step, so that most are of the first kind.
Prints for the mandible (8 mm forward and 3 degrees) and the mid-face (12 mm forward) the time of all steps, without
making the field, which is done once, for several readings of the field; the first is the paper's.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from faceanim.elements.contact import imposed, pose_between, steps_needed
from faceanim.face.face import Face
from faceanim.geometry.bone_field import BoneField, bone_field
from faceanim.geometry.surface import TriMesh

TABLE_2 = {"mandible": (0.468, 3258, 33, 1.01), "mid-face": (0.538, 3657, 56, 1.53)}
"""Seconds, imposed vertices, error vertices, error ratio [%], printed; which procedure is which is not."""
ERROR = 0.1
"""An error vertex is farther than this from the surface that it was moved to [mm]."""
CLEARANCE = 0.02
"""Vertices lie so far before the bone at rest [mm]."""
WAYS = (("linear", 1), ("mean", 3), ("spline", 3), ("nearest", 1), ("nearest", 3))
"""How the field is read and how often a vertex is looked at in a step; the first is the paper's."""


def covering(bone: TriMesh, chosen: np.ndarray, count: int) -> np.ndarray:
    """Return about `count` points evenly on the `chosen` triangles, a little before them, (k, 3) [mm]."""
    rng = np.random.default_rng(3)
    area = bone.areas[chosen]
    which = chosen[rng.choice(len(chosen), size=count, p=area / area.sum())]
    a, b = rng.uniform(size=(2, count))
    turned = a + b > 1.0
    a, b = np.where(turned, 1.0 - a, a), np.where(turned, 1.0 - b, b)
    corner = bone.points[bone.triangles[which]]
    at = corner[:, 0] + a[:, None] * (corner[:, 1] - corner[:, 0]) + b[:, None] * (corner[:, 2] - corner[:, 0])
    return at + CLEARANCE * bone.normals_by_area[which] / bone.areas[which][:, None]


def leading(bone: TriMesh, way: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the triangles that go ahead when the bone goes along `way` (3,), with middles between `low` and `high`."""
    middle = bone.points[bone.triangles].mean(axis=1)
    ahead = bone.normals_by_area @ way > 0.2 * bone.areas
    return np.flatnonzero(ahead & ((middle >= low) & (middle <= high)).all(axis=1))


def run(field: BoneField, points: np.ndarray, pose: np.ndarray, reading: str, sweeps: int) -> dict[str, Any]:
    """Move the bone to `pose` in steps and take the `points` out of it; return times and what is left."""
    goal, start = pose[None], np.eye(4)[None]
    steps = steps_needed([field], start, goal)
    place, hit = points.copy(), np.zeros(len(points), dtype=bool)
    seconds, worst, buried = 0.0, 0.0, 0
    wrong, against = np.zeros(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    before = start[0]
    for k in range(1, steps + 1):
        now = pose_between(start, goal, k / steps)[0]
        begin = time.perf_counter()
        out = imposed(place, field, now, reading=reading, sweeps=sweeps)
        place[out.chosen] += out.move
        seconds += time.perf_counter() - begin
        way = place[out.chosen] @ (now - before)[:3, :3].T + (now - before)[:3, 3]
        against[out.chosen[np.einsum("ki,ki->k", out.move, way) < 0.0]] = True
        before = now
        off = np.abs(field.exact(place[out.chosen], now))
        hit[out.chosen] = True
        wrong[out.chosen[off > ERROR]] = True
        worst, buried = max(worst, float(off.max(initial=0.0))), buried + len(out.buried)
    last = np.maximum(field.exact(place, pose), 0.0)
    return {
        "reading": reading, "steps": steps, "sweeps": sweeps, "seconds": seconds, "imposed": int(hit.sum()),
        "errors": int(wrong.sum()), "ratio": 100.0 * wrong.sum() / max(hit.sum(), 1), "worst": worst,
        "buried": buried, "left_inside": int((last > ERROR).sum()), "against": int(against.sum()),
    }  # fmt: skip


def cases(face: Face) -> dict[str, tuple[TriMesh, np.ndarray, np.ndarray]]:
    """Return for each procedure the bone, the triangles that flesh covers and the pose (4, 4) it goes to."""
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


def main() -> None:
    """Measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spacing", type=float, default=1.0, help="of the field's lattice [mm]")
    parser.add_argument("--vertices", type=int, default=3500)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    rows = []
    print("procedure  reading  sweeps steps   time/s  imposed errors ratio/%  worst/mm  buried against  field/s")
    for name, (bone, chosen, pose) in cases(Face.from_assets("default", "default")).items():
        bone_field(bone, spacing=options.spacing)
        begin = time.perf_counter()
        field = bone_field(bone, spacing=options.spacing)
        made = time.perf_counter() - begin
        points = covering(bone, chosen, options.vertices)
        run(field, points[:10], pose, WAYS[0][0], 1)
        for reading, sweeps in WAYS:
            row = {"procedure": name, "field_seconds": made, **run(field, points, pose, reading, sweeps)}
            rows.append(row)
            print(
                f"{name:10} {reading:8} {sweeps:6d} {row['steps']:5d} {row['seconds']:8.4f} {row['imposed']:8d} "
                f"{row['errors']:6d} {row['ratio']:7.2f} {row['worst']:9.3f} {row['buried']:7d} "
                f"{row['against']:7d} {made:8.2f}"
            )
        seconds, count, errors, ratio = TABLE_2[name]
        print(f"{'(Table 2)':10} {'':21} {seconds:8.4f} {count:8d} {errors:6d} {ratio:7.2f}")
    if options.output:
        options.output.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
