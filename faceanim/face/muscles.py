"""The facial muscles: linear, sheet and sphincter, placed in a head by points on bone and skin.

A muscle is a row of `assets/muscles.toml`; paired muscles are written once, for the left side, and mirrored. Its total
force, activation * force, is shared over the vertices of its influence zone with weights that sum to 1 and carry the
vertex area, so that the result does not depend on the density of the mesh (Zhang, Prakash & Sung, section 3.2; their
earlier paper for the zones).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
import numpy as np

from faceanim.body.body import PULL_ALONG, PULL_TO_POINT, Muscles
from faceanim.ground.arrays import Floats, Ints
from faceanim.ground.errors import AssetError

Vec = tuple[float, float, float]
BONES = ("cranium", "jaw")
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


_SIDES = ("left", "right")
_LENGTHS = ("radius", "half_width", "length", "reach", "softening", "width", "force")
_LARGEST = 1e6


def _fault(muscle: AnyMuscle, bones: Collection[str]) -> str | None:
    """Return what is wrong with a row, None if it can be built."""
    for name in muscle.__struct_fields__:
        value = getattr(muscle, name)
        numbers = value if isinstance(value, tuple) else (value,)
        if any(isinstance(v, float) and not abs(v) < _LARGEST for v in numbers):
            return f"has {name} {value}; it must be finite and below {_LARGEST:g}"
        if name in _LENGTHS and not value > 0:
            return f"has {name} {value}; it must be positive"
    if isinstance(muscle, SphincterMuscle) and not min(muscle.axes) > 0:
        return f"has axes {muscle.axes}; both must be positive"
    if isinstance(muscle, (LinearMuscle, SheetMuscle)):
        if muscle.bone not in bones:
            return f"springs from {muscle.bone!r}; a bone is one of {', '.join(bones)}"
        if muscle.insertion in (muscle.origin, muscle.via) or muscle.origin == muscle.via:
            return "has two points in one place; origin, via and insertion must differ"
    return None


def parse_muscles(text: str, source: str) -> dict[str, AnyMuscle]:
    """Return the muscles of a TOML text by base name; raise `AssetError` naming what does not fit."""
    try:
        table = msgspec.toml.decode(text, type=dict[str, AnyMuscle])
    except msgspec.DecodeError as error:
        raise AssetError(f"{source}: {error}") from error
    for name, muscle in table.items():
        fault = _fault(muscle, BONES)
        if fault is not None:
            raise AssetError(f"{source}: muscle {name!r} {fault}")
        if not name.replace("_", "").isalnum() or not name.isascii():
            raise AssetError(f"{source}: {name!r} is no name for a muscle; use letters, digits and underscores")
        if isinstance(muscle, LidMuscle) and not muscle.paired and side_of(name) == "middle":
            raise AssetError(
                f"{source}: muscle {name!r} closes the lids of one eye; its name must end in _left or _right"
            )
        twin = name.rpartition("_")[0] if side_of(name) != "middle" else ""
        if twin in table and table[twin].paired:
            raise AssetError(f"{source}: muscle {name!r} is given twice: the paired {twin!r} has that side too")
    return table


def side_of(name: str) -> str:
    """Return the side in a full name: "left", "right" or "middle"."""
    end = name.rpartition("_")[2]
    return end if end in _SIDES else "middle"


def mirrored(muscle: AnyMuscle) -> AnyMuscle:
    """Return the right-side twin of a left-side muscle (x -> -x)."""
    flipped = {f: (-v[0], *v[1:]) for f in ("origin", "via", "insertion", "centre") if (v := getattr(muscle, f, None))}
    return msgspec.structs.replace(muscle, **flipped)


def both_sides(table: Mapping[str, AnyMuscle]) -> dict[str, tuple[AnyMuscle, str]]:
    """Return every single muscle by full name (name_left, name_right, or the name if unpaired) with its side."""
    out: dict[str, tuple[AnyMuscle, str]] = {}
    for name, muscle in table.items():
        if muscle.paired:
            out[f"{name}_left"] = (muscle, "left")
            out[f"{name}_right"] = (mirrored(muscle), "right")
        else:
            out[name] = (muscle, side_of(name))
    return out


def one_sided(table: Mapping[str, AnyMuscle]) -> dict[str, AnyMuscle]:
    """Return every muscle by its full name, each a row of its own (paired = false)."""
    return {n: msgspec.structs.replace(m, paired=False) for n, (m, _) in both_sides(table).items()}


def paired(table: Mapping[str, AnyMuscle], within: float = 0.0) -> dict[str, AnyMuscle]:
    """Return `table` with twins that mirror each other to `within` [mm] written once, as their mean.

    Muscles in the middle that are their own mirror image to `within` are put on x = 0.
    """
    rows, out = one_sided(table), dict[str, AnyMuscle]()
    for name, row in rows.items():
        base, side = name.rpartition("_")[0], side_of(name)
        if side == "middle":
            half = _mean(row, mirrored(row), within)
            out[name] = row if half is None else half
            continue
        left, right = rows.get(f"{base}_left"), rows.get(f"{base}_right")
        mean = None if left is None or right is None else _mean(left, mirrored(right), within)
        if mean is None or base in rows:
            out[name] = row
        else:
            out[base] = msgspec.structs.replace(mean, paired=True)
    return out


_POINTS = ("origin", "via", "insertion", "centre")


def _mean(a: AnyMuscle, b: AnyMuscle, within: float) -> AnyMuscle | None:
    """Return the row half-way between `a` and `b`, None if they differ by more than their points within `within`."""
    if type(a) is not type(b):
        return None
    changed: dict[str, tuple[float, ...]] = {}
    for name in (*_POINTS, "axes"):
        p, q = getattr(a, name, None), getattr(b, name, None)
        if p is not None and q is not None and p != q:
            if math.dist(p, q) > within:
                return None
            changed[name] = tuple(round(0.5 * (u + v), 4) + 0.0 for u, v in zip(p, q, strict=True))
    a = msgspec.structs.replace(a, **changed)
    return a if a == msgspec.structs.replace(b, **changed) else None


def moved(muscle: AnyMuscle, linear: Floats, offset: Floats, scale: float) -> AnyMuscle:
    """Return a muscle carried to another head: points by x -> linear x + offset, lengths by `scale`, forces by scale^2."""
    if scale == 1.0 and np.array_equal(linear, np.eye(3)) and not offset.any():
        return muscle
    changed: dict[str, Any] = {}
    for name in muscle.__struct_fields__:
        value = getattr(muscle, name)
        if value is None:
            continue
        if name in _POINTS:
            changed[name] = tuple(float(v) for v in linear @ np.array(value) + offset)
        elif name == "axes":
            changed[name] = (float(abs(linear[0, 0]) * value[0]), float(abs(linear[1, 1]) * value[1]))
        elif name in ("radius", "half_width", "length", "reach", "softening", "protrusion"):
            changed[name] = value * scale
        elif name == "force":
            changed[name] = value * scale**2
    return msgspec.structs.replace(muscle, **changed)


def muscles_text(table: Mapping[str, AnyMuscle], notes: Mapping[str, str] | None = None, head: str = "") -> str:
    """Return TOML that `parse_muscles` reads back as an equal table.

    notes : a comment for some of the muscles;  head : a comment at the top;  fields at their defaults are left out
    """
    lines = [f"# {line}" for line in head.splitlines()]
    for name, muscle in table.items():
        note = (notes or {}).get(name, "")
        lines += ["", f"[{name}]", *(f"# {line}" for line in note.splitlines())]
        lines.append(f'kind = "{muscle.__struct_config__.tag}"')
        for field in msgspec.structs.fields(muscle):
            value = getattr(muscle, field.name)
            if value is None or (field.default is not msgspec.NODEFAULT and value == field.default):
                continue
            lines.append(f"{field.name} = {_toml(value)}")
    return "\n".join(lines).lstrip("\n") + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        return "[" + ", ".join(repr(float(v)) for v in value) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(float(value))


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


def build_muscles(table: Mapping[str, AnyMuscle], terrain: Terrain) -> Muscles:
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
