"""The frame loop of the weighted residual backend: skin carried by bones, plus answers times amplitudes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faceanim.ground.jit import kernel

F8 = NDArray[np.float64]
I4 = NDArray[np.int32]


class Answers(NamedTuple):
    """Displacements per amplitude by vertex: rows start[i]..start[i + 1] of `value` (k, 3) [mm] belong to vertex i.

    mode : (k,) whose amplitude it takes   weight : (n, n_bone) by which bones turn the answer at a vertex
    """

    start: I4
    mode: I4
    value: F8
    weight: F8


@kernel
def carry(points, weight, pose, out):
    """Write where the bones at `pose` (b, 4, 4) carry `points` (n, 3) by `weight` (n, b) into `out`."""
    for i in range(len(points)):
        for a in range(3):
            total = 0.0
            for b in range(len(pose)):
                w = weight[i, b]
                if w != 0.0:
                    total += w * (
                        pose[b, a, 0] * points[i, 0]
                        + pose[b, a, 1] * points[i, 1]
                        + pose[b, a, 2] * points[i, 2]
                        + pose[b, a, 3]
                    )
            out[i, a] = total


@kernel
def add_answers(answers, amplitude, pose, turned, out):
    """Add the answers at these amplitudes (r,) to `out` (n, 3), turned with the bones if `turned`."""
    for i in range(len(out)):
        x = 0.0
        y = 0.0
        z = 0.0
        for k in range(answers.start[i], answers.start[i + 1]):
            q = amplitude[answers.mode[k]]
            x += q * answers.value[k, 0]
            y += q * answers.value[k, 1]
            z += q * answers.value[k, 2]
        if not turned:
            out[i, 0] += x
            out[i, 1] += y
            out[i, 2] += z
            continue
        for b in range(len(pose)):
            w = answers.weight[i, b]
            if w != 0.0:
                for a in range(3):
                    out[i, a] += w * (pose[b, a, 0] * x + pose[b, a, 1] * y + pose[b, a, 2] * z)


@kernel
def advance(step, goal, q, qd, q_new, qd_new):
    """Advance amplitudes towards `goal` (r,) by the exact propagators `step` (r, 4); in place is allowed."""
    for j in range(len(goal)):
        away = q[j] - goal[j]
        rate = qd[j]
        q_new[j] = goal[j] + step[j, 0] * away + step[j, 1] * rate
        qd_new[j] = step[j, 2] * away + step[j, 3] * rate
