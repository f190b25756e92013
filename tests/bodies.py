"""Small bodies for tests: a held sheet with muscles, bones and an eyeball; two facing sheets; a chain of two masses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from faceanim.body.body import (
    PULL_ALONG,
    PULL_TO_POINT,
    Attachment,
    Body,
    Bone,
    BoneContact,
    Muscles,
    PairContact,
    SphereContact,
)
from faceanim.body.control import Control
from faceanim.body.solid import solid_body
from faceanim.geometry.distance import DistanceGrid
from faceanim.geometry.shapes import box_tets, sheet
from faceanim.geometry.surface import TriMesh
from faceanim.tissue.material import Material
from faceanim.tissue.spring_law import SpringLaw

NO_MUSCLES = Muscles(
    (), np.zeros(0), np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0), np.zeros(0, np.int32),
    np.zeros((0, 3)), np.zeros(0, np.int32), np.zeros(0),
)  # fmt: skip


def ball_grid(
    centre: tuple[float, float, float], radius: float, half: float = 20.0, spacing: float = 1.0
) -> DistanceGrid:
    """Return the distance to a ball on a cube of side 2 `half` about it [mm]."""
    axis = np.arange(-half, half + 1e-9, spacing)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    values = np.sqrt(x**2 + y**2 + z**2) - radius
    return DistanceGrid(values.astype(np.float32), np.array(centre) - half, spacing)


def zone(
    points: np.ndarray, at: tuple[float, float], radius: float, allowed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices within `radius` of `at` in x and y, and smooth weights that sum to 1."""
    r = np.hypot(points[:, 0] - at[0], points[:, 1] - at[1])
    node = np.flatnonzero((r < radius) & allowed).astype(np.int32)
    weight = (1.0 - (r[node] / radius) ** 2) ** 2
    return node, weight / weight.sum()


def two_muscles(points: np.ndarray, allowed: np.ndarray, force: float) -> Muscles:
    """Return a mirrored pair of linear muscles and one sheet muscle that pulls up."""
    rows: list[tuple[Any, ...]] = []
    for muscle, (at, goal, kind) in enumerate(
        (
            ((9.0, -4.0), (22.0, 12.0, 2.0), PULL_TO_POINT),
            ((-9.0, -4.0), (-22.0, 12.0, 2.0), PULL_TO_POINT),
            ((0.0, 9.0), (0.0, 0.8, -0.6), PULL_ALONG),
        )
    ):
        node, weight = zone(points, at, 7.0, allowed)
        rows.extend((muscle, int(i), w, kind, goal) for i, w in zip(node, weight, strict=True))
    muscle, node, weight, kind, goal = (np.array(c) for c in zip(*rows, strict=True))
    return Muscles(
        ("left", "right", "up"), np.array([force, force, 0.5 * force]), muscle.astype(np.int32), node.astype(np.int32),
        weight, kind.astype(np.int32), goal.astype(np.float64), np.zeros(len(node), np.int32), np.full(len(node), 1.0),
    )  # fmt: skip


def held_sheet(nx: int = 14, ny: int = 14, *, colliders: bool = True, force: float = 300.0, **changes: Any) -> Body:
    """Return a bulging sheet, 40 mm wide, on two bones, with three muscles, a bony ball and an eyeball behind it.

    Every edge vertex is pinned. `changes` replace fields of the body.
    """
    surface = sheet(nx, ny, 40.0, 40.0, bulge=6.0)
    x = surface.points
    pinned = (np.abs(x[:, 0]) > 19.9) | (np.abs(x[:, 1]) > 19.9)
    jaw = 1.0 / (1.0 + np.exp((x[:, 1] + 6.0) / 4.0))
    bones: tuple[Bone, ...] = (Bone("cranium"), Bone("jaw"))
    bone_contact, spheres = None, ()
    if colliders:
        bones = (Bone("cranium", ball_grid((0.0, 3.0, -6.0), 10.0)), Bone("jaw"))
        free = np.flatnonzero(~pinned).astype(np.int32)
        bone_contact = BoneContact(free, np.zeros(len(free), np.int32), np.full(len(free), 1.0))
        centre = np.array([10.0, 2.0, -5.0])
        spheres = (SphereContact("eye", centre, 8.0, free, np.full(len(free), 0.5)),)
    fields: dict[str, Any] = {
        "surface": surface,
        "mass": surface.vertex_areas * 4.0 * 1.04e-6,
        "membrane_modulus": np.full(len(surface.triangles), 40.0),
        "law": SpringLaw(),
        "damping": 2000.0,
        "pinned": pinned,
        "attachment": Attachment(
            np.stack([1.0 - jaw, jaw], axis=1),
            surface.vertex_areas * 0.8,
            shear=np.full(len(surface.triangles), 3.0),
            shear_limit=np.full(len(surface.triangles), 0.4),
        ),
        "muscles": two_muscles(x, ~pinned, force),
        "bones": bones,
        "bone_contact": bone_contact,
        "spheres": spheres,
    }
    return Body(**(fields | changes))


def free_sheet(**changes: Any) -> Body:
    """Return a sheet that nothing holds, pulls or meets."""
    surface = sheet(6, 6, 20.0, 20.0, bulge=3.0)
    n = len(surface.points)
    return held_sheet(
        colliders=False,
        **{
            "surface": surface,
            "mass": surface.vertex_areas * 4e-6,
            "membrane_modulus": np.full(len(surface.triangles), 40.0),
            "pinned": np.zeros(n, dtype=bool),
            "attachment": Attachment(np.ones((n, 1)), np.zeros(n)),
            "muscles": NO_MUSCLES,
            "bones": (Bone("cranium"),),
        }
        | changes,
    )


def two_lips(gap: float = 0.3) -> Body:
    """Return an upper and a lower sheet that face each other 2 mm apart, with a muscle that presses each on the other."""
    upper, lower = sheet(6, 6, 12.0, 12.0), sheet(6, 6, 12.0, 12.0)
    n = len(upper.points)
    # the upper sheet looks down, the lower one up; shifted so that vertices meet triangles
    turn = np.array([1.0, -1.0, -1.0])
    points = np.concatenate([upper.points * turn + [0.0, 0.0, 2.0], lower.points + np.array([0.4, 0.3, 0.0])])
    triangles = np.concatenate([upper.triangles, lower.triangles + n])
    surface = TriMesh(points, triangles)
    t = len(upper.triangles)
    node = np.arange(2 * n, dtype=np.int32)
    start = np.arange(2 * n + 1, dtype=np.int32) * t
    other = np.concatenate([np.tile(np.arange(t, 2 * t), n), np.tile(np.arange(t), n)]).astype(np.int32)
    pull = Muscles(
        ("press",), np.array([1600.0]), np.zeros(2 * n, np.int32), node, np.full(2 * n, 0.5 / n),
        np.full(2 * n, PULL_ALONG, np.int32), np.repeat([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], n, axis=0),
        np.zeros(2 * n, np.int32), np.ones(2 * n),
    )  # fmt: skip
    return held_sheet(
        colliders=False,
        surface=surface,
        mass=surface.vertex_areas * 4e-6,
        membrane_modulus=np.full(2 * t, 40.0),
        pinned=np.zeros(2 * n, dtype=bool),
        attachment=Attachment(np.ones((2 * n, 1)), np.full(2 * n, 5.0)),
        muscles=pull,
        bones=(Bone("cranium"),),
        pairs=(PairContact("lips", node, start, other, gap),),
    )


def turned(angle: float, about: tuple[float, float, float] = (0.0, 20.0, -30.0)) -> np.ndarray:
    """Return the pose (4, 4) of a jaw opened by `angle` [degrees] about a transverse axis."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, c, -s], [0, s, c]]
    pose[:3, 3] = np.array(about) - pose[:3, :3] @ np.array(about)
    return pose


def control(body: Body, activation: Any = 0.0, jaw: float = 0.0) -> Control:
    """Return a control with these activations and the last bone turned by `jaw` [degrees]."""
    out = Control.rest(body)
    out.activation[:] = activation
    if jaw:
        out.bone_pose[-1] = turned(jaw)
    return out


def crumpled(body: Body, amount: float, seed: int = 3) -> np.ndarray:
    """Return the body's points moved at random by about `amount` [mm], (n, 3)."""
    return body.surface.points + amount * np.random.default_rng(seed).standard_normal(body.surface.points.shape)


DAMPING = {"damping": 2000.0, "stiffness_damping": 1e-3}
FLESH = Material("flesh", 1.04e-6, 15.0, 0.4)


def bridge(cells: tuple[int, int, int] = (8, 3, 3), **changes: Any) -> Body:
    """Return a bar of flesh, 40 x 12 x 12 mm, between cranium (x = 0) and jaw (x = 40), with two muscles on its back."""
    mesh = box_tets(cells, (40.0, 12.0, 12.0))
    x = mesh.points[:, 0]
    held = (x < 1e-9) | (x > 40.0 - 1e-9)
    bones = ("cranium", "jaw")
    plain = solid_body(mesh, FLESH, held, bone=(x > 20.0).astype(int), bones=bones, **DAMPING)
    p = plain.surface.points
    top = np.flatnonzero((p[:, 1] > 11.9) & (np.abs(p[:, 0] - 20.0) < 11.0)).astype(np.int32)
    k, zeros = len(top), np.zeros(len(top), np.int32)
    muscles = Muscles(
        ("to_point", "along"), np.array([120.0, 60.0]), np.concatenate([zeros, zeros + 1]), np.tile(top, 2),
        np.full(2 * k, 1.0 / k), np.repeat([PULL_TO_POINT, PULL_ALONG], k).astype(np.int32),
        np.repeat([[10.0, 40.0, 15.0], [0.0, 0.6, 0.8]], k, axis=0), np.zeros(2 * k, np.int32), np.ones(2 * k),
    )  # fmt: skip
    return replace(plain, muscles=muscles, **changes)


def cantilever(cells: tuple[int, int, int] = (12, 3, 3), material: Material = FLESH, **changes: Any) -> Body:
    """Return a bar of flesh, 40 x 10 x 10 mm, held at x = 0 alone."""
    mesh = box_tets(cells, (40.0, 10.0, 10.0))
    body = solid_body(mesh, material, mesh.points[:, 0] < 1e-9, **DAMPING)
    return replace(body, **changes)
