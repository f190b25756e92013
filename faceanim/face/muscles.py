"""The facial muscles: linear, sheet and sphincter, placed in a head by points on bone and skin.

A muscle is a row of `assets/muscles.toml`; paired muscles are written once, for the left side, and mirrored. Its total
force, activation * force, is shared over the vertices of its influence zone with weights that sum to 1 and carry the
vertex area, so that the result does not depend on the density of the mesh (Zhang, Prakash & Sung, section 3.2; their
earlier paper for the zones).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from faceanim.body.body import PULL_ALONG, PULL_TO_POINT, Muscles
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import AssetError

Vec = tuple[float, float, float]
Side = Literal["any", "upper", "lower"]


class LinearMuscle(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="linear", tag_field="kind"):
    """Fibres converge on one point of bone.

    origin, insertion [mm]; force [mN]; radius [mm] of the bump around the insertion; angle [deg] of the cone from
    where the pull goes; bone that carries the origin; mouth side that the zone is confined to
    via [mm] : where the fibres bend over bone or tissue; the pull is towards it (None: towards the origin)
    """

    origin: Vec
    insertion: Vec
    force: float
    radius: float
    angle: float = 35.0
    via: Vec | None = None
    bone: str = "cranium"
    side: Side = "any"
    paired: bool = True


class SheetMuscle(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="sheet", tag_field="kind"):
    """Parallel fibres in a strip of half width `half_width` [mm] around origin-insertion, pulling along it.

    length [mm] of the bump along the strip at the insertion; with `galea` > 0 the origin is no bone but the scalp's
    tendon, which is drawn towards the insertion by that share of the force
    via [mm] : where the fibres bend over bone or tissue; the pull is towards it (None: towards the origin)
    """

    origin: Vec
    insertion: Vec
    force: float
    half_width: float
    length: float
    galea: float = 0.0
    via: Vec | None = None
    bone: str = "cranium"
    side: Side = "any"
    paired: bool = True


class SphincterMuscle(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="sphincter", tag_field="kind"):
    """A ring in an ellipse with semi-axes `axes` (along x, along y) [mm] around `centre`; `width` [-] of the ring.

    Each vertex is drawn to its own place in the contracted ring: offset * `contraction` (x, y) + `protrusion` [mm]
    forward; the pull fades over the last `softening` [mm].
    """

    centre: Vec
    axes: tuple[float, float]
    force: float
    width: float
    contraction: tuple[float, float] = (0.0, 0.0)
    protrusion: float = 0.0
    softening: float = 6.0
    side: Side = "any"
    paired: bool = False


class LidMuscle(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="lid", tag_field="kind"):
    """The palpebral ring: draws both lids along the eyeball to the lid line.

    force [mN] for both lids together; reach [mm] above and below the margins over which the pull fades; `meet` [-]
    where the lids meet, 0 at the lower lid's rest, 1 at the upper lid's; softening [mm]
    """

    force: float
    reach: float
    meet: float = 0.2
    softening: float = 3.0
    paired: bool = True


AnyMuscle = LinearMuscle | SheetMuscle | SphincterMuscle | LidMuscle


@dataclass(frozen=True, eq=False)
class Lids:
    """One eye as the lid muscle sees it: eyeball centre (3,) and radius [mm], margin vertices of both lids."""

    centre: Floats
    radius: float
    upper_margin: Ints
    lower_margin: Ints


@dataclass(frozen=True, eq=False)
class Terrain:
    """The skin as muscles see it.

    points, normals : (n, 3)   area : (n,) [mm^2], zero where no muscle may pull   side : (n,) +1 above the mouth, -1 below
    lids : {"left": ..., "right": ...}   bones : names, in the order of the body
    """

    points: Floats
    normals: Floats
    area: Floats
    side: Ints
    lids: dict[str, Lids]
    bones: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Zone:
    node: Ints
    weight: Floats
    kind: int
    point: Floats
    softening: float
    bone: int


def parse_muscles(text: str, source: str) -> dict[str, AnyMuscle]:
    """Return the muscles of a TOML text by base name; raise `AssetError` naming what does not fit."""
    try:
        table = msgspec.toml.decode(text, type=dict[str, AnyMuscle])
    except msgspec.DecodeError as error:
        raise AssetError(f"{source}: {error}") from error
    for name, muscle in table.items():
        if not muscle.force > 0:
            raise AssetError(f"{source}: muscle {name!r} has force {muscle.force}; it must be positive [mN]")
    return table


def mirrored(muscle: AnyMuscle) -> AnyMuscle:
    """Return the right-side twin of a left-side muscle (x -> -x)."""
    flipped = {f: (-v[0], *v[1:]) for f in ("origin", "via", "insertion", "centre") if (v := getattr(muscle, f, None))}
    return msgspec.structs.replace(muscle, **flipped)


def both_sides(table: dict[str, AnyMuscle]) -> dict[str, tuple[AnyMuscle, str]]:
    """Return every single muscle by full name (name_left, name_right, or the name if unpaired) with its side."""
    out: dict[str, tuple[AnyMuscle, str]] = {}
    for name, muscle in table.items():
        if muscle.paired:
            out[f"{name}_left"] = (muscle, "left")
            out[f"{name}_right"] = (mirrored(muscle), "right")
        else:
            out[name] = (muscle, "middle")
    return out


def _bump(r: Floats) -> Floats:
    """The radial bump (1 - r^2)^2 on |r| < 1, 0 beyond: 1 with zero slope at 0, 0 with zero slope at 1."""
    return (1.0 - np.minimum(np.abs(r), 1.0) ** 2) ** 2


def _on_side(terrain: Terrain, side: Side) -> Floats:
    if side == "any":
        return terrain.area
    return np.where(terrain.side == (1 if side == "upper" else -1), terrain.area, 0.0)


def _zone(
    name: str, raw: Floats, point: Floats, *, kind: int = PULL_TO_POINT, softening: float, bone: int = 0
) -> _Zone:
    node = np.flatnonzero(raw > 1e-9 * max(float(raw.max(initial=0.0)), 1e-300)).astype(np.int32)
    if not len(node):
        raise AssetError(f"muscle {name!r} reaches no skin vertex; move its insertion or widen its zone")
    weight = raw[node] / raw[node].sum()
    points = np.broadcast_to(point, (len(raw), 3))[node] if point.ndim == 1 else point[node]
    return _Zone(node, weight, kind, np.ascontiguousarray(points), softening, bone)


def _direction(start: Floats, end: Floats) -> Floats:
    """Return the unit vector (3,) from `start` to `end`."""
    way = end - start
    return np.asarray(way / np.linalg.norm(way))


def _linear(name: str, m: LinearMuscle, t: Terrain) -> list[_Zone]:
    pull, insertion = np.array(m.via or m.origin), np.array(m.insertion)
    axis = _direction(pull, insertion)
    ray = t.points - pull
    angle = np.arccos(np.clip(ray @ axis / np.linalg.norm(ray, axis=1), -1.0, 1.0))
    radial = np.linalg.norm(t.points - insertion, axis=1) / m.radius
    raw = _on_side(t, m.side) * _bump(radial) * _bump(angle / np.deg2rad(m.angle))
    return [_zone(name, raw, pull, softening=1.0, bone=t.bones.index(m.bone))]


def _sheet(name: str, m: SheetMuscle, t: Terrain) -> list[_Zone]:
    origin, pull, insertion = np.array(m.origin), np.array(m.via or m.origin), np.array(m.insertion)
    area = _on_side(t, m.side)

    def strip(foot: Floats, along: Floats) -> Floats:
        offset = t.points - foot
        run = offset @ along
        across = np.linalg.norm(offset - np.outer(run, along), axis=1)
        return area * _bump(across / m.half_width) * _bump(run / m.length)

    bone = t.bones.index(m.bone)
    along = _direction(insertion, pull)
    zones = [_zone(name, strip(insertion, along), along, kind=PULL_ALONG, softening=0.0, bone=bone)]
    if m.galea > 0:
        down = _direction(origin, insertion if m.via is None else pull)
        tail = _zone(name, strip(origin, down), down, kind=PULL_ALONG, softening=0.0, bone=bone)
        zones.append(_Zone(tail.node, tail.weight * m.galea, tail.kind, tail.point, 0.0, bone))
    return zones


def _sphincter(name: str, m: SphincterMuscle, t: Terrain) -> list[_Zone]:
    offset = t.points - np.array(m.centre)
    ring = np.hypot(offset[:, 0] / m.axes[0], offset[:, 1] / m.axes[1])
    near = np.abs(offset[:, 2]) < 2.0 * max(m.axes)
    raw = _on_side(t, m.side) * _bump((ring - 1.0) / m.width) * near
    goal = t.points.copy()
    goal[:, 0] = m.centre[0] + offset[:, 0] * m.contraction[0]
    goal[:, 1] = m.centre[1] + offset[:, 1] * m.contraction[1]
    goal[:, 2] += m.protrusion
    return [_zone(name, raw, goal, softening=m.softening)]


_CANTHUS = 5.0
"""Where the lids are nearer to each other than this at rest [mm] they hang together, and the ring pulls less."""


_LIFT = 0.4
"""Share of its depth below the eyeball's arc by which a lid's chord is raised [-]: it must not press into the eye."""


def _margin_height(t: Terrain, margin: Ints) -> Floats:
    """Height of a lid margin [mm] at every vertex's x, (n,)."""
    order = margin[np.argsort(t.points[margin, 0])]
    return np.interp(t.points[:, 0], t.points[order, 0], t.points[order, 1])


def _lid(name: str, m: LidMuscle, t: Terrain, side: str) -> list[_Zone]:
    eye = t.lids[side]
    upper, lower = _margin_height(t, eye.upper_margin), _margin_height(t, eye.lower_margin)
    line = lower + m.meet * (upper - lower)
    near = np.linalg.norm(t.points - eye.centre, axis=1) < eye.radius + m.reach
    margin = t.points[np.concatenate([eye.upper_margin, eye.lower_margin]), 0]
    centre, half = 0.5 * (margin.min() + margin.max()), 0.5 * (margin.max() - margin.min())
    lateral = _bump((t.points[:, 0] - centre) / (1.15 * half))
    above = t.points[:, 1] >= line
    away = np.where(above, t.points[:, 1] - upper, lower - t.points[:, 1])
    opening = np.clip((upper - lower) / _CANTHUS, 0.0, 1.0) ** 2
    raw = t.area * near * lateral * opening * _bump(np.maximum(away, 0.0) / m.reach)
    goal = t.points.copy()
    goal[:, 1] = line + np.where(above, 0.35, -0.35) * np.maximum(away, 0.0)
    radius = np.linalg.norm(t.points - eye.centre, axis=1)
    radius += _LIFT * (goal[:, 1] - t.points[:, 1]) ** 2 / (2.0 * radius)
    across = np.hypot(goal[:, 0] - eye.centre[0], goal[:, 1] - eye.centre[1])
    goal[:, 2] = eye.centre[2] + np.sqrt(np.maximum(radius**2 - across**2, 1.0))
    return [_zone(name, raw, goal, softening=m.softening)]


def _zones(name: str, muscle: AnyMuscle, side: str, terrain: Terrain) -> list[_Zone]:
    if isinstance(muscle, LinearMuscle):
        return _linear(name, muscle, terrain)
    if isinstance(muscle, SheetMuscle):
        return _sheet(name, muscle, terrain)
    if isinstance(muscle, SphincterMuscle):
        return _sphincter(name, muscle, terrain)
    return _lid(name, muscle, terrain, side)


def build_muscles(table: dict[str, AnyMuscle], terrain: Terrain) -> Muscles:
    """Return the fibres of every muscle of `table` on `terrain`; raise `AssetError` naming a muscle that misses it."""
    named = both_sides(table)
    rows = [(k, z) for k, (name, (m, side)) in enumerate(named.items()) for z in _zones(name, m, side, terrain)]

    def column(values: list[np.ndarray], dtype: type) -> np.ndarray:
        return np.ascontiguousarray(np.concatenate(values), dtype=dtype)

    return Muscles(
        names=tuple(named),
        max_force=np.array([m.force for m, _ in named.values()]),
        muscle=column([np.full(len(z.node), k) for k, z in rows], np.int32),
        node=column([z.node for _, z in rows], np.int32),
        weight=column([z.weight for _, z in rows], np.float64),
        kind=column([np.full(len(z.node), z.kind) for _, z in rows], np.int32),
        point=column([z.point for _, z in rows], np.float64),
        bone=column([np.full(len(z.node), z.bone) for _, z in rows], np.int32),
        softening=column([np.full(len(z.node), z.softening) for _, z in rows], np.float64),
    )
