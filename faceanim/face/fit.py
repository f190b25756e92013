"""A generic skull fitted into any head: boxes, affine map, thin-plate spline to the tissue depths, push inside.

Zhang, Prakash & Sung place the skull by hand (rotation, translation, scale along the axes): `place` does that. `fit`
needs no hand: it takes the landmarks of the skin, the tissue depths beneath them and the same landmarks on the bone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from faceanim.face.muscles import BONES
from faceanim.face.skull import Skull, bone_grid, rotation
from faceanim.geometry.distance import DistanceGrid
from faceanim.geometry.distance_field import point_distance, signed_distance_grid
from faceanim.geometry.rays import ray_hit
from faceanim.geometry.surface import TriMesh
from faceanim.ground.arrays import Floats, Ints, floats
from faceanim.ground.errors import AssetError, UserError

MUCOSA, LID = 2, 3
_FEWEST_MARKS = 8


class Depth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Tissue depth at a landmark: mean and uncertainty [mm], and the bone beneath ("cranium" or "jaw")."""

    depth: float
    spread: float
    bone: str


def parse_depths(text: str, source: str) -> dict[str, Depth]:
    """Return the depth table of a TOML text, landmark -> `Depth`; raise `AssetError` naming what does not fit."""
    try:
        table = msgspec.toml.decode(text, type=dict[str, Depth])
    except msgspec.DecodeError as error:
        raise AssetError(f"{source}: {error}") from error
    for name, row in table.items():
        if not (0.0 < row.depth < 60.0 and row.spread > 0.0 and row.bone in BONES):
            raise AssetError(f"{source}: {name} needs 0 < depth < 60, spread > 0 and bone cranium or jaw, not {row}")
    return table


@dataclass(frozen=True, eq=False)
class Marks:
    """Landmarks on the skin with what lies beneath.

    names : (k,)   point : (k, 3) on the skin [mm]   inward : (k, 3) unit vectors   depth, spread : (k,) [mm]
    bone : (k,) 0 cranium, 1 jaw
    """

    names: tuple[str, ...]
    point: Floats
    inward: Floats
    depth: Floats
    spread: Floats
    bone: Ints

    @property
    def target(self) -> Floats:
        """Where the bone should be, (k, 3) [mm]."""
        return self.point + self.depth[:, None] * self.inward


def outer_surface(mesh: TriMesh, region: Ints | None = None) -> TriMesh:
    """Return the closed outer surface of a head: without the mouth's and the lids' inside, every hole capped.

    region : (n,) codes of the face files, or None for a mesh that has no inside.
    Raises `UserError` when nothing is left.
    """
    keep = np.ones(len(mesh.triangles), dtype=bool)
    if region is not None:
        inner = (region == MUCOSA) | (region == LID)
        keep = ~inner[mesh.triangles].any(axis=1)
    triangles = _largest_part(mesh.triangles[keep], len(mesh.points))
    if not len(triangles):
        raise UserError("the head has no outer triangles; check its regions")
    caps = [cap(mesh.points, loop[::-1]) for loop in boundary_loops(triangles)]
    used, packed = np.unique(np.vstack([triangles, *caps]), return_inverse=True)
    return TriMesh(mesh.points[used], packed.reshape(-1, 3).astype(np.int32))


def cap(points: Floats, loop: Ints) -> Ints:
    """Return the triangles (k - 2, 3) of least area that span a closed chain of vertices `loop` (k,), in its direction.

    Dynamic programming over sub-chains (Barequet & Sharir 1995); a narrow slit is closed across, not from its middle.
    """
    count = len(loop)
    p = points[loop]
    cost, split = np.zeros((count, count)), np.zeros((count, count), dtype=np.int64)
    for span in range(2, count):
        for i in range(count - span):
            j = i + span
            k = np.arange(i + 1, j)
            area = 0.5 * np.linalg.norm(np.cross(p[k] - p[i], p[j] - p[i]), axis=1)
            total = cost[i, k] + cost[k, j] + area
            best = int(total.argmin())
            cost[i, j], split[i, j] = total[best], k[best]
    out, open_chains = [], [(0, count - 1)]
    while open_chains:
        i, j = open_chains.pop()
        if j - i > 1:
            m = int(split[i, j])
            out.append((loop[i], loop[m], loop[j]))
            open_chains += [(i, m), (m, j)]
    return np.array(out, dtype=np.int32).reshape(-1, 3)


def _largest_part(triangles: Ints, count: int) -> Ints:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(triangles):
        return triangles
    i, j = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    _, label = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (count, count)), directed=False)
    part = label[triangles[:, 0]]
    return np.asarray(triangles[part == np.bincount(part).argmax()])


def boundary_loops(triangles: Ints) -> list[Ints]:
    """Return the closed chains of boundary edges, each in the direction of its triangles."""
    directed = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = {(int(a), int(b)) for a, b in directed}
    follow: dict[int, list[int]] = {}
    for a, b in sorted(edges):
        if (b, a) not in edges:
            follow.setdefault(a, []).append(b)
    loops = []
    while follow:
        start = next(iter(follow))
        loop, here = [], start
        while follow.get(here):
            loop.append(here)
            after = follow[here].pop()
            if not follow[here]:
                del follow[here]
            here = after
            if here == start:
                break
        if here == start and len(loop) > 2:
            loops.append(np.array(loop, dtype=np.int32))
    return loops


def skin_marks(head: TriMesh, landmarks: dict[str, Floats], table: dict[str, Depth], radius: float = 8.0) -> Marks:
    """Return the marks for those `landmarks` (name -> point (3,) [mm]) that the depth table knows.

    Inward is against the skin's normal, averaged within `radius` [mm] so that creases do not turn it.
    Raises `UserError` when fewer than eight landmarks are known.
    """
    rows = []
    for name in sorted(landmarks):
        key = name.removesuffix("_left").removesuffix("_right")
        if key in table:
            rows.append((name, floats(name, landmarks[name], 3), table[key]))
    if len(rows) < _FEWEST_MARKS:
        raise UserError(
            f"{len(rows)} landmarks have a tissue depth; at least {_FEWEST_MARKS} are needed to fit a skull"
        )
    point = np.array([r[1] for r in rows])
    return Marks(
        names=tuple(r[0] for r in rows),
        point=point,
        inward=-_mean_normals(head, point, radius),
        depth=np.array([r[2].depth for r in rows]),
        spread=np.array([r[2].spread for r in rows]),
        bone=np.array([BONES.index(r[2].bone) for r in rows], dtype=np.int32),
    )


def _mean_normals(head: TriMesh, points: Floats, radius: float) -> Floats:
    centres = head.points[head.triangles].mean(axis=1)
    normals = head.normals_by_area
    out = np.zeros_like(points)
    for k, p in enumerate(points):
        far2 = ((centres - p) ** 2).sum(axis=1)
        reach2 = max(radius**2, 4.0 * float(np.partition(far2, 3)[3]))
        weight = np.clip(1.0 - far2 / reach2, 0.0, 1.0) ** 2
        facing = normals @ (weight @ normals) > 0
        out[k] = (weight * facing) @ normals
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Spline:
    """A thin-plate spline of space: x -> x A + b + sum_k |x - centre_k| w_k.

    centres (k, 3), weights (k, 3), linear (3, 3), offset (3,)
    """

    centres: Floats
    weights: Floats
    linear: Floats
    offset: Floats

    def __call__(self, points: Floats) -> Floats:
        """Return the moved points (n, 3)."""
        radius = np.linalg.norm(points[:, None] - self.centres[None], axis=2)
        return np.asarray(points @ self.linear + self.offset + radius @ self.weights)


def thin_plate(source: Floats, target: Floats, slack: Floats | float = 0.0) -> Spline:
    """Return the smoothest map of space that takes `source` (k, 3) to `target` (k, 3).

    slack : (k,) [mm], how loosely each pair is met; 0 meets it exactly
    """
    count = len(source)
    scale = np.linalg.norm(np.ptp(source, axis=0))
    radius = np.linalg.norm(source[:, None] - source[None], axis=2) / scale
    system = np.zeros((count + 4, count + 4))
    system[:count, :count] = radius - np.diag(np.broadcast_to(np.asarray(slack) / scale, count))
    system[:count, count:-1] = (source - source.mean(axis=0)) / scale
    system[:count, -1] = 1.0
    system[count:, :count] = system[:count, count:].T
    right = np.vstack([target, np.zeros((4, 3))])
    solution = np.linalg.lstsq(system, right, rcond=1e-12)[0]
    linear = solution[count:-1] / scale
    return Spline(source, solution[:count] / scale, linear, solution[-1] - source.mean(axis=0) @ linear)


def affine(source: Floats, target: Floats, weight: Floats, stiffness: float = 0.02) -> Spline:
    """Return the affine map that takes `source` nearest to `target`, starting from the map of their boxes.

    weight : (k,);  stiffness : how strongly the linear part is held to the boxes' scales [-]
    """
    middle, aim = 0.5 * (source.min(0) + source.max(0)), 0.5 * (target.min(0) + target.max(0))
    box = np.diag(np.ptp(target, axis=0) / np.maximum(np.ptp(source, axis=0), 1e-9))
    start = (source - middle) @ box + aim
    w = weight / weight.sum()
    centre = w @ start
    rest = (target - start) - w @ (target - start)
    flat = start - centre
    normal = flat.T @ (w[:, None] * flat)
    turn = np.linalg.solve(normal + stiffness * np.trace(normal) / 3.0 * np.eye(3), flat.T @ (w[:, None] * rest))
    linear = box @ (np.eye(3) + turn)
    offset = w @ target - (w @ source) @ linear
    return Spline(np.zeros((0, 3)), np.zeros((0, 3)), linear, offset)


def mark_depths(marks: Marks, cranium: TriMesh, jaw: TriMesh) -> tuple[Floats, Floats]:
    """Return the depth of each mark along its ray, (k,) [mm], and where it ends on the bone, (k, 3).

    A ray that misses its bone, or grazes it far behind the nearest point, ends at the nearest point.
    """
    depth, end = np.empty(len(marks.names)), np.empty((len(marks.names), 3))
    for bone, mesh in enumerate((cranium, jaw)):
        rows = np.flatnonzero(marks.bone == bone)
        if not len(rows):
            continue
        back = 40.0
        start = marks.point[rows] - back * marks.inward[rows]
        far = ray_hit(start, marks.inward[rows], mesh, back + 60.0) - back
        near, triangle = point_distance(marks.point[rows], mesh)
        foot = _closest_on(mesh, triangle, marks.point[rows])
        use = np.isfinite(far) & (far < 1.6 * near + 4.0)
        reached = marks.point[rows] + np.where(use, far, 0.0)[:, None] * marks.inward[rows]
        end[rows] = np.where(use[:, None], reached, foot)
        side = np.sign(np.einsum("ij,ij->i", foot - marks.point[rows], marks.inward[rows]))
        depth[rows] = np.where(use, far, side * near)
    return depth, end


def _closest_on(mesh: TriMesh, triangle: Ints, points: Floats) -> Floats:
    """Return the closest point of each given triangle, by a fine sample of it, (n, 3)."""
    a, b, c = (mesh.points[mesh.triangles[triangle, k]] for k in range(3))
    share = np.array([(i, j) for i in range(13) for j in range(13 - i)]) / 12.0
    sample = a[:, None] + share[None, :, :1] * (b - a)[:, None] + share[None, :, 1:] * (c - a)[:, None]
    pick = ((sample - points[:, None]) ** 2).sum(axis=2).argmin(axis=1)
    return np.asarray(sample[np.arange(len(points)), pick])


@dataclass(frozen=True)
class FitReport:
    """How well a skull fits: depth errors against the table after each stage [mm], and what is left to the skin.

    affine_rms, spline_rms, final_rms : [mm];  outside : share of bone vertices outside the skin [-]
    thinnest : smallest tissue thickness over bone [mm]
    """

    affine_rms: float
    spline_rms: float
    final_rms: float
    outside: float
    thinnest: float


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted skull: bone meshes, the stages of the warp without the last push, and the report."""

    cranium: TriMesh
    jaw: TriMesh
    stages: tuple[Spline, ...]
    marks: Marks
    report: FitReport

    def warp(self, points: Floats) -> Floats:
        """Return `points` (n, 3) of the generic skull where the smooth stages carry them [mm]."""
        for stage in self.stages:
            points = stage(points)
        return points


def fit(
    generic: Skull,
    head: TriMesh,
    landmarks: dict[str, Floats],
    table: dict[str, Depth],
    *,
    least_thickness: float = 3.0,
    slack: float = 3.0,
    rounds: int = 3,
) -> Fit:
    """Return the generic skull fitted into a head.

    head : closed outer surface [mm], see `outer_surface`;  landmarks : name -> point on the skin (3,) [mm]
    least_thickness : tissue left over every bone vertex [mm];  slack : looseness of the first spline [mm]
    rounds : how often the depths along the rays are corrected
    Raises `UserError` for too few landmarks in common.
    """
    marks = skin_marks(head, {n: p for n, p in landmarks.items() if n in generic.landmarks}, table)
    source = np.array([generic.landmarks[n] for n in marks.names])
    weight = 1.0 / marks.spread
    stages = [affine(source, marks.target, weight)]
    cranium, jaw = (_moved(m, stages[0]) for m in (generic.cranium, generic.jaw))
    affine_rms = _rms(mark_depths(marks, cranium, jaw)[0] - marks.depth)
    loose = thin_plate(stages[0](source), marks.target, slack * marks.spread)
    stages.append(loose)
    cranium, jaw = _moved(cranium, loose), _moved(jaw, loose)
    every = with_vault(marks, head)
    for _ in range(rounds):
        stage = _ray_stage(every, cranium, jaw)
        stages.append(stage)
        cranium, jaw = _moved(cranium, stage), _moved(jaw, stage)
    spline_rms = _rms(mark_depths(marks, cranium, jaw)[0] - marks.depth)
    grid = head_grid(head)
    cranium, jaw = (push_inside(m, grid, least_thickness) for m in (cranium, jaw))
    report = report_fit(marks, cranium, jaw, head, grid, affine_rms, spline_rms)
    return Fit(cranium, jaw, tuple(stages), marks, report)


def _ray_stage(marks: Marks, cranium: TriMesh, jaw: TriMesh) -> Spline:
    """Return the spline that moves the bone along each mark's ray to its depth."""
    depth, end = mark_depths(marks, cranium, jaw)
    toward = (end - marks.point) / np.where(depth > 0, 1.0, -1.0)[:, None]
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-9)
    toward = np.where(np.abs(depth)[:, None] > 0.5, toward, marks.inward)
    slack = 0.05 + 2.0 * np.array([name.startswith(_VAULT) for name in marks.names])
    return thin_plate(end, marks.point + marks.depth[:, None] * toward, slack)


_VAULT = "vault "


def with_vault(marks: Marks, head: TriMesh) -> Marks:
    """Return the marks with more of them over the braincase, where the tables leave wide gaps.

    Their depths are those of the marks around, weighted by the inverse square of the distance. They lie on rays from
    the middle between glabella and opisthocranion; without these two marks nothing is added.
    """
    if not {"glabella", "opisthocranion"} <= set(marks.names):
        return marks
    front, back = (marks.point[marks.names.index(n)] for n in ("glabella", "opisthocranion"))
    centre, ahead = 0.5 * (front + back), (front - back) / np.linalg.norm(front - back)
    up = np.array([0.0, 1.0, 0.0]) - ahead[1] * ahead
    up /= np.linalg.norm(up)
    side = np.cross(up, ahead)
    rise, turn = (v.ravel() for v in np.meshgrid(np.radians([14.0, 38.0, 64.0]), np.radians(np.arange(0, 360, 30))))
    ring = np.cos(turn)[:, None] * ahead + np.sin(turn)[:, None] * side
    way = np.cos(rise)[:, None] * ring + np.sin(rise)[:, None] * up
    far = ray_hit(np.broadcast_to(centre, way.shape), way, head, 400.0)
    way, far = way[np.isfinite(far)], far[np.isfinite(far)]
    point = centre + far[:, None] * way
    near = (marks.bone == 0) & ((marks.point - centre) @ up > -25.0)
    weight = 1.0 / (((point[:, None] - marks.point[near]) ** 2).sum(axis=2) + 1.0)
    depth = weight @ marks.depth[near] / weight.sum(axis=1)
    return Marks(
        names=(*marks.names, *(f"{_VAULT}{k}" for k in range(len(point)))),
        point=np.vstack([marks.point, point]),
        inward=np.vstack([marks.inward, -_mean_normals(head, point, 12.0)]),
        depth=np.concatenate([marks.depth, depth]),
        spread=np.concatenate([marks.spread, np.full(len(point), 2.0)]),
        bone=np.concatenate([marks.bone, np.zeros(len(point), dtype=np.int32)]),
    )


def report_fit(
    marks: Marks,
    cranium: TriMesh,
    jaw: TriMesh,
    head: TriMesh,
    grid: DistanceGrid,
    affine_rms: float,
    spline_rms: float,
) -> FitReport:
    """Return the report of fitted bones; thickness by exact distances, the side by the grid."""
    bone = np.vstack([cranium.points, jaw.points])
    side = np.where(grid.sample(bone) > 0.0, -1.0, 1.0)
    thickness = side * point_distance(bone, head)[0]
    final = _rms(mark_depths(marks, cranium, jaw)[0] - marks.depth)
    return FitReport(affine_rms, spline_rms, final, float((thickness <= 0).mean()), float(thickness.min()))


def head_grid(head: TriMesh, spacing: float = 2.5, band: float = 20.0) -> DistanceGrid:
    """Return the signed distance to a head's closed outer surface, as the push inside needs it."""
    return signed_distance_grid([head], spacing=spacing, margin=3.0 * spacing, band=band)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _moved(mesh: TriMesh, move: Spline) -> TriMesh:
    return TriMesh(move(mesh.points), mesh.triangles)


def push_inside(mesh: TriMesh, grid: DistanceGrid, least_thickness: float, *, spread: int = 12) -> TriMesh:
    """Return the bone pushed inside the skin until every vertex lies `least_thickness` [mm] deep.

    grid : signed distance of the head;  spread : rings over which a push fades away
    """
    neighbour_mean = _neighbour_mean(mesh)
    rest = mesh.points
    push = np.zeros_like(rest)
    for sweep in range(30):
        here = rest + push
        lack = np.maximum(grid.sample(here) + least_thickness, 0.0)
        if lack.max(initial=0.0) < 1e-3:
            break
        push = push - lack[:, None] * _slope(grid, here)
        if sweep < 20:
            for _ in range(spread):
                smooth = neighbour_mean @ push
                wider = (smooth**2).sum(axis=1) > (push**2).sum(axis=1)
                push = np.where(wider[:, None], smooth, push)
    return TriMesh(rest + push, mesh.triangles)


def _neighbour_mean(mesh: TriMesh) -> Any:
    from scipy.sparse import coo_matrix, diags

    i, j = mesh.triangles[:, [0, 1, 2]].ravel(), mesh.triangles[:, [1, 2, 0]].ravel()
    n = len(mesh.points)
    link = coo_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), (n, n)).tocsr()
    link.data[:] = 1.0
    return diags(1.0 / np.maximum(np.asarray(link.sum(axis=1)).ravel(), 1.0)) @ link


def _slope(grid: DistanceGrid, points: Floats) -> Floats:
    """Return the unit direction in which the distance grows, (n, 3)."""
    step = 0.75 * grid.spacing
    out = np.empty_like(points)
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = step
        out[:, axis] = grid.sample(points + shift) - grid.sample(points - shift)
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9))


@dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale * rotation x + translation: what teeth may undergo. rotation (3, 3), translation (3,) [mm]."""

    rotation: Floats
    scale: float
    translation: Floats

    def __call__(self, points: Floats) -> Floats:
        """Return the moved points (n, 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)


def similarity(source: Floats, target: Floats) -> Similarity:
    """Return the similarity that takes `source` (n, 3) nearest to `target` (n, 3); Umeyama 1991."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, s, vt = np.linalg.svd((target - b).T @ (source - a))
    keep = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = (u * keep) @ vt
    scale = float((s * keep).sum() / ((source - a) ** 2).sum())
    return Similarity(turn, scale, b - scale * turn @ a)


def fit_skull(
    generic: Skull,
    teeth: tuple[TriMesh, TriMesh],
    head: TriMesh,
    landmarks: dict[str, Floats],
    table: dict[str, Depth],
    *,
    least_thickness: float = 3.0,
) -> tuple[Skull, Similarity, FitReport]:
    """Return a whole skull for a head: bones, distance grids with teeth, condyles; and how the teeth move.

    generic : any skull with landmarks, such as the built-in one;  teeth : its upper and lower row
    head, landmarks, table, least_thickness : as for `fit`
    The similarity moves whatever belongs to the bite: teeth, gums, tongue. The bite is not bent: both rows move as
    one, and back until no tooth is nearer than 1.5 mm to the skin.
    """
    fitted = fit(generic, head, landmarks, table, least_thickness=least_thickness)
    grid = head_grid(head)
    both = np.vstack([row.points for row in teeth])
    together = similarity(both, fitted.warp(both))
    for _ in range(8):
        lack = float(np.maximum(grid.sample(together(both)) + 1.5, 0.0).max())
        together = Similarity(together.rotation, together.scale, together.translation - [0.0, 0.0, lack])
    rows = [TriMesh(together(row.points), row.triangles) for row in teeth]
    tips = together(np.stack([generic.incisor_upper, generic.incisor_lower]))
    condyles = fitted.warp(np.stack([generic.condyle_left, generic.condyle_right]))
    ends = mark_depths(fitted.marks, fitted.cranium, fitted.jaw)[1]
    skull = Skull(
        cranium=fitted.cranium,
        jaw=fitted.jaw,
        cranium_grid=bone_grid(fitted.cranium, [rows[0]], symmetric=False),
        jaw_grid=bone_grid(fitted.jaw, [rows[1]], symmetric=False),
        condyle_left=condyles[0],
        condyle_right=condyles[1],
        incisor_upper=tips[0],
        incisor_lower=tips[1],
        landmarks=dict(zip(fitted.marks.names, ends, strict=True)),
        landmark_bone={n: generic.landmark_bone[n] for n in fitted.marks.names},
    )
    return skull, together, fitted.report


def place(points: Floats, rotation_deg: Floats, translation: Floats, scale: Floats, about: Floats) -> Floats:
    """Return `points` (n, 3) scaled along the axes, turned about X, Y, Z in this order, and moved: the hand's way.

    rotation_deg (3,), translation (3,) [mm], scale (3,) [-], about (3,) [mm]: the point that only moves.
    Eq. "skull fitting" of Zhang, Prakash & Sung: rotation, translation and non-uniform scale set by the user.
    """
    out = (np.asarray(points, dtype=np.float64) - about) * scale
    for axis in range(3):
        out = out @ rotation(np.eye(3)[axis], float(np.radians(rotation_deg[axis]))).T
    return np.asarray(out + about + translation)
