"""Columns of flesh between skin and bone: where they stand, which way they run and where they end.

The columns stand on a coarser copy of the visible skin whose vertices are vertices of the skin. Each runs inwards until
it meets bone, the wall of the mouth, an eyeball or the far side of the nose, or has reached the greatest depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from faceanim.face.attach import LID, LIP, MUCOSA, NECK
from faceanim.face.geodesic import distance_along
from faceanim.geometry.coarsen import coarsened
from faceanim.geometry.distance_field import point_distance
from faceanim.geometry.rays import first_hit, ray_hit
from faceanim.geometry.surface import TriMesh
from faceanim.geometry.topology import edges
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats, Ints

if TYPE_CHECKING:
    from faceanim.face.face import Face

DEEPEST = 24.0
"""Greatest length of a column [mm]; the cheek over the ramus is about 20 mm thick."""
NECK_DEPTH = 9.0
"""Thickness of the flesh that moves with the skin of the neck [mm]; no bone lies near."""
LEAST_LENGTH = 1.2
"""Shortest column [mm], the thickness of a lid."""
SKIN_THICKNESS = 2.0
"""Of the outer layer [mm]: dermis with the fascia beneath."""
SHORTEST = 1.2
"""Columns are not cut shorter than this to keep elements sound [mm]."""

# Where the skin's triangles are small: near lips and lids, and where the skin is sharply bent.
_FINE_NEAR_OPENINGS = 0.42  # share of the usual edge at lips and lids
_FADE = 32.0  # mm from there to the usual edge
_NECK_EDGE = 1.9  # times the usual edge
_EDGE_PER_BALL = 0.9  # edge over the radius of the ball that fits inside
_BALL_REACH = 16.0  # mm; how far the ball looks
_MOST_OTHERS = 4000
# Visible lips and lids: the cosine between their normal and the way out of the mouth or the eye.
_LIP_EDGE = 0.05
_LID_EDGE = 0.25
# Which way columns run.
_SMOOTH = 9.0  # mm over which normals are averaged
_EYE_REACH = 8.0  # mm before an eyeball where columns start to turn to its centre
_NEAR_BONE = 11.0  # mm; bone so near must not be missed ...
_DETOUR = 1.5  # ... or be reached by a way so many times longer
_LEANINGS = 4
# Where columns end.
_EYE_GAP = 0.3  # mm before the eyeball
_NOSE_SHARE = 0.4  # of the way to the far side of a thin part
_THIN = 12.0  # mm; parts in which no larger ball fits have a far side worth looking for
_WIDEST_GAP = 9.0  # mm between the wall of the mouth and the teeth
_LEAST_GAP = 0.8  # mm
_NEAR_TEETH = 1.5  # mm; a column from a lip that passes a tooth so closely ends there
_STILL_HELD = 0.75  # share of its length to which a column in the gap may shorten and still be held
_LOST_LENGTH = 7.0  # mm; of columns that meet nothing ...
_BALL_SHARE = 0.6  # ... and this share of the ball that fits inside
_CLEAR = 0.6  # mm; rays start so far inside the skin
_SMOOTHING = 6
# How columns are made sound.
_ATTEMPTS = 120
_SHORTEN = 0.88
_LARGEST_SHIFT = 3.0  # mm by which the top of a column may leave a fold of the skin


@dataclass(frozen=True, eq=False)
class Columns:
    """Straight columns from `top` (m, 3) on the skin to `foot` (m, 3) [mm].

    vertex : (m,) the skin vertex at the top   triangles : (t, 3) columns that bound each prism
    on_bone : (m,) whether the foot lies on bone   wall : (m,) where the flesh ends and the moist gap before teeth and
    gums begins, as a share of the column; 1 = no gap   shortened : (m,) columns cut short to keep the elements sound
    """

    vertex: Ints
    triangles: Ints
    top: Floats
    foot: Floats
    on_bone: Bools
    wall: Floats
    shortened: Bools

    @property
    def gap(self) -> Bools:
        """Columns that cross the gap between the wall of the mouth and the bone, (m,)."""
        return np.asarray(self.on_bone & (self.wall < 1.0))


def smoothed_normals(face: Face, reach: float = _SMOOTH) -> Floats:
    """Return the mean outward normal of the visible skin around each vertex, (n, 3), unit; over seams as if closed."""
    mesh = face.mesh
    tree = cKDTree(mesh.points)
    near = tree.sparse_distance_matrix(tree, reach, output_type="coo_matrix").tocsr()
    near.data = (1.0 - (near.data / reach) ** 2) ** 2
    outside = (face.region != MUCOSA).astype(np.float64)
    total = near @ (mesh.vertex_normals * (mesh.vertex_areas * outside)[:, None]) + 1e-6 * mesh.vertex_normals
    return np.asarray(total / np.linalg.norm(total, axis=1, keepdims=True))


def hidden(face: Face, normals: Floats) -> Bools:
    """Return which vertices lie inside the mouth or behind the lids, (n,)."""
    mesh = face.mesh
    out = np.asarray(face.region == MUCOSA)
    edge = np.flatnonzero(np.isin(face.region, (LIP, LID)))
    lips = TriMesh(mesh.points, mesh.triangles[(face.region[mesh.triangles] == LIP).any(axis=1)])
    covered = np.isfinite(ray_hit(mesh.points[edge] + 0.3 * normals[edge], normals[edge], lips, 12.0))
    outward = normals[edge].copy()
    lid = face.region[edge] == LID
    for eye in face.eyes.values():
        away = mesh.points[edge] - eye.centre
        far = np.linalg.norm(away, axis=1)
        on_eye = lid & (far < 2.0 * eye.radius)
        outward[on_eye] = (away / far[:, None])[on_eye]
    turned = np.einsum("ij,ij->i", mesh.vertex_normals[edge], outward) < np.where(lid, _LID_EDGE, _LIP_EDGE)
    out[edge[turned | (covered & ~lid)]] = True
    return out


def is_symmetric(face: Face) -> bool:
    """Return whether the head is its own mirror image, and no triangle crosses the middle."""
    x = face.mesh.points
    if np.abs(x[face.mirror] * [-1.0, 1.0, 1.0] - x).max() > 1e-9:
        return False
    across = x[face.mesh.triangles, 0]
    own = {tuple(t) for t in np.sort(face.mesh.triangles, axis=1).tolist()}
    twins = {tuple(t) for t in np.sort(face.mirror[face.mesh.triangles], axis=1).tolist()}
    return own == twins and not ((across.max(axis=1) > 0) & (across.min(axis=1) < 0)).any()


def grow(face: Face, edge: float, layers: int, least_quality: float, *, half: bool) -> Columns:
    """Return sound columns of a head.

    edge : [mm] of the skin's triangles far from lips and lids   half : only the side x >= 0, to be mirrored
    layers, least_quality : the columns are turned and shortened until every element of so many layers is that good
    """
    normals = smoothed_normals(face)
    inside = hidden(face, normals)
    ball = np.full(len(inside), np.inf)
    ball[~inside] = inner_ball(face.mesh.points[~inside], -normals[~inside])
    vertex, triangles = _sheet(face, inside, edge, ball, half)
    ground = _Ground(face, vertex, triangles, ball[vertex], half)
    return _Growth(ground, triangles, layers, least_quality).run(-normals[vertex])


def _sheet(face: Face, inside: Bools, edge: float, ball: Floats, half: bool) -> tuple[Ints, Ints]:
    """Return the vertices (m,) and triangles (t, 3) over them of the coarsened visible skin."""
    mesh = face.mesh
    triangles = mesh.triangles[(~face.pinned[mesh.triangles]).any(axis=1) & (~inside[mesh.triangles]).all(axis=1)]
    if half:
        triangles = triangles[(mesh.points[triangles, 0] >= -1e-9).all(axis=1)]
    triangles = _largest(triangles, len(mesh.points))
    openings = np.flatnonzero(np.isin(face.region, (LIP, LID))).astype(np.int32)
    way = np.minimum(distance_along(mesh, openings), _FADE)
    size = edge * (_FINE_NEAR_OPENINGS + (1.0 - _FINE_NEAR_OPENINGS) * way / _FADE)
    size = np.minimum(size, np.maximum(_EDGE_PER_BALL * ball, _FINE_NEAR_OPENINGS * edge))
    size = np.where(face.region == NECK, size * _NECK_EDGE, size)
    middle = (np.abs(mesh.points[:, 0]) < 1e-9) if half else np.zeros(len(size), dtype=bool)
    border = np.zeros(len(size), dtype=np.int32)
    border[np.isin(face.region, (LIP, LID))] = 2
    rail = np.where(middle, 1 + 4 * (border == 2), border).astype(np.int32)
    rail[~middle & (border == 2) & ~_rim(triangles, len(size))] = 0
    left = coarsened(TriMesh(mesh.points, triangles), size, rail=rail)
    left = _largest(_without_ears(left, middle), len(mesh.points))
    vertex, index = np.unique(left, return_inverse=True)
    return vertex.astype(np.int32), index.reshape(-1, 3).astype(np.int32)


def _without_ears(triangles: Ints, middle: Bools) -> Ints:
    """Return the triangles but those that hang by one edge; the middle (n,) of a half head is no border."""
    while len(triangles):
        pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, index, count = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
        border = (count == 1) & ~middle[unique].all(axis=1)
        ear = border[index.reshape(-1, 3)].sum(axis=1) >= 2
        if not ear.any():
            break
        triangles = triangles[~ear]
    return triangles


def _border(triangles: Ints) -> Ints:
    """Return the edges that belong to one triangle only, (e, 2)."""
    pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(pairs, axis=0, return_counts=True)
    return unique[count == 1].astype(np.int32)


def _rim(triangles: Ints, n: int) -> Bools:
    """Return which of n vertices lie on the border of the triangles, (n,)."""
    out = np.zeros(n, dtype=bool)
    out[_border(triangles)] = True
    return out


def _largest(triangles: Ints, n: int) -> Ints:
    """Return the triangles of the largest part that hangs together by edges."""
    pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, edge = np.unique(pairs, axis=0, return_inverse=True)
    t = len(triangles)
    owner = np.repeat(np.arange(t), 3)
    member = csr_matrix((np.ones(3 * t), (owner, edge.ravel())))
    _, label = connected_components(member @ member.T, directed=False)
    return triangles[label == np.bincount(label).argmax()]


class _Ground:
    """What columns meet on their way inwards."""

    def __init__(self, face: Face, vertex: Ints, triangles: Ints, ball: Floats, half: bool) -> None:
        self.face, self.vertex, self.ball = face, vertex, ball
        mesh = face.mesh
        self.top = mesh.points[vertex].copy()
        self.middle = (np.abs(self.top[:, 0]) < 1e-9) & half
        code = face.region[mesh.triangles]
        self.mouth = TriMesh(mesh.points, mesh.triangles[(code == MUCOSA).any(axis=1)])
        self.sheet = _whole(TriMesh(mesh.points[vertex], triangles), half)
        code = face.region[vertex]
        self.neck, self.lip, self.lid = code == NECK, code == LIP, code == LID
        self.rigid = face.pinned[vertex]
        self.wall = point_distance(self.top, self.mouth)[0] if len(self.mouth.triangles) else np.full(len(vertex), 99.0)

    def flat(self, inward: Floats) -> Floats:
        """Return unit directions, those of the middle without a sideways part."""
        out = np.where(self.middle[:, None] & np.array([True, False, False]), 0.0, inward)
        return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))

    def bone(self, points: Floats) -> Floats:
        """Return the distance of points (k, 3) to the nearer bone with its teeth, (k,) [mm], negative inside."""
        skull = self.face.skull
        return np.minimum(skull.cranium_grid.sample(points), skull.jaw_grid.sample(points))

    def aim(self, inward: Floats) -> Floats:
        """Return directions (m, 3) turned towards the eyeball where it is near, so that lids stand on it."""
        out = inward
        for eye in self.face.eyes.values():
            to = eye.centre - self.top
            far = np.linalg.norm(to, axis=1)
            share = np.clip((_EYE_REACH - (far - eye.radius)) / (_EYE_REACH - 2.0), 0.0, 1.0)
            share = np.where(self.lid & (far < 2.5 * eye.radius), 1.0, share * share * (3.0 - 2.0 * share))[:, None]
            out = (1.0 - share) * out + share * to / far[:, None]
        return self.flat(out)

    def lean(self, inward: Floats) -> Floats:
        """Return directions (m, 3) turned towards the bone where they would pass it by although it is near."""
        gap = self.bone(self.top)
        near = np.flatnonzero((gap < _NEAR_BONE) & ~self.lip & ~self.neck & ~self.rigid)
        h = 1.0
        steps = [self.bone(self.top[near] + h * axis) - self.bone(self.top[near] - h * axis) for axis in np.eye(3)]
        down = -np.stack(steps, axis=1)
        down /= np.maximum(np.linalg.norm(down, axis=1, keepdims=True), 1e-9)
        out = inward.copy()
        for _ in range(_LEANINGS):
            length = self.lengths(out[near], near)[0]
            passing = length > _DETOUR * gap[near] + 1.0
            out[near[passing]] += 0.5 * down[passing]
            out = self.flat(out)
        return out

    def lengths(self, inward: Floats, row: np.ndarray) -> tuple[Floats, Bools, Floats]:
        """Return how far the columns `row` (k,) run along `inward` (k, 3), (k,) [mm], inf if they meet nothing.

        Also which of them end on bone, (k,), and where they leave the flesh for the mouth, (k,) [mm], inf if nowhere.
        """
        top = self.top[row]
        bone = self._to_bone(top, inward, self.lip[row])
        wall = _leaving(self.mouth, top, inward, self.wall[row] < DEEPEST)
        wall = np.where(self.lip[row] & ~np.isfinite(wall), self.wall[row], wall)
        wall = np.where(wall < bone, np.maximum(wall, LEAST_LENGTH), np.inf)
        gap = np.isfinite(wall) & (bone < wall + _WIDEST_GAP)
        bone = np.where(gap, np.maximum(bone, wall + _LEAST_GAP), bone)
        free = np.minimum(np.where(gap, np.inf, wall), self._to_eye(top, inward))
        across = np.where(gap, np.inf, _NOSE_SHARE * _leaving(self.sheet, top, inward, self.ball[row] < _THIN))
        length = np.minimum(np.minimum(bone, free), across)
        on_bone = np.isfinite(bone) & (bone <= length)
        length = np.where(on_bone, length, np.maximum(length, LEAST_LENGTH))
        shallow = (self.neck[row] | self.rigid[row]) & (length > NECK_DEPTH)
        wall = np.where(gap & on_bone & ~shallow, wall, np.inf)
        return np.where(shallow, NECK_DEPTH, length), on_bone & ~shallow, wall

    def _to_bone(self, top: Floats, inward: Floats, lip: Bools) -> Floats:
        """Return how far each ray runs to bone, (k,) [mm]; those of `lip` (k,) may also pass it closely, between teeth."""
        step = 0.5
        way = np.arange(0.0, DEEPEST + step, step)
        at = top[:, None] + way[None, :, None] * inward[:, None]
        value = self.bone(at.reshape(-1, 3)).reshape(len(inward), -1)
        level = np.where(lip & (value > 0.0).all(axis=1), _NEAR_TEETH, 0.0)[:, None]
        value = value - level
        inside = value <= 0.0
        k = np.argmax(inside, axis=1)
        row = np.arange(len(k))
        before, after = value[row, k - 1], value[row, k]
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = way[k] - step * after / (after - before)
        return np.where(inside.any(axis=1) & (k > 0), cross, np.inf)

    def _to_eye(self, top: Floats, inward: Floats) -> Floats:
        out = np.full(len(inward), np.inf)
        for eye in self.face.eyes.values():
            away = top - eye.centre
            radius = eye.radius + _EYE_GAP
            along = np.einsum("ij,ij->i", away, inward)
            root = along**2 - np.einsum("ij,ij->i", away, away) + radius**2
            way = -along - np.sqrt(np.maximum(root, 0.0))
            meets = (root > 0) & (along < 0)
            out = np.minimum(out, np.where(meets, np.maximum(way, LEAST_LENGTH), np.inf))
        return out


def _whole(sheet: TriMesh, half: bool) -> TriMesh:
    """Return the sheet with its mirror image, if it is only half a head."""
    if not half:
        return sheet
    points = np.concatenate([sheet.points, sheet.points * [-1.0, 1.0, 1.0]])
    return TriMesh(points, np.concatenate([sheet.triangles, sheet.triangles[:, ::-1] + len(sheet.points)]))


def _leaving(mesh: TriMesh, top: Floats, inward: Floats, wanted: Bools) -> Floats:
    """Return how far each ray runs until it leaves the flesh through `mesh`, (k,) [mm]; inf if it does not.

    wanted : (k,) the rays to follow, the others are known to miss
    """
    out = np.full(len(top), np.inf)
    row = np.flatnonzero(wanted)
    if not len(mesh.triangles) or not len(row):
        return out
    way, hit = first_hit(top[row] + _CLEAR * inward[row], inward[row], mesh, DEEPEST)
    normal = mesh.normals_by_area[np.maximum(hit, 0)]
    leaves = (hit >= 0) & (np.einsum("ij,ij->i", normal, inward[row]) > 0)
    out[row[leaves]] = way[leaves] + _CLEAR
    return out


class _Growth:
    """Columns that turn, leave sharp folds of the skin, and shorten until all their elements are sound."""

    def __init__(self, ground: _Ground, triangles: Ints, layers: int, least_quality: float) -> None:
        self.ground, self.triangles, self.layers, self.least = ground, triangles, layers, least_quality
        m = len(ground.top)
        self.mean = _averaging(edges(triangles), m)
        rim = _rim(triangles, m) & ~ground.middle
        along = _border(triangles)
        along = along[rim[along].all(axis=1)]
        self.fair = diags((~rim).astype(np.float64)) @ self.mean + diags(rim.astype(np.float64)) @ _averaging(along, m)
        self.factor = np.ones(m)
        self.last = np.full((m, 7), np.nan)
        self.unsound = np.zeros(len(triangles), dtype=bool)

    def run(self, inward: Floats) -> Columns:
        """Return the columns that start along `inward` (m, 3)."""
        ground = self.ground
        skin = ground.top.copy()
        direction = ground.aim(ground.lean(ground.flat(inward)))
        self.roomy = np.minimum(_BALL_SHARE * ground.ball, _LOST_LENGTH)
        changed = np.arange(len(direction))
        length, on_bone, wall = ground.lengths(direction, changed)
        for attempt in range(_ATTEMPTS):
            reach = self._filled(length, on_bone) * self.factor
            foot = ground.top + reach[:, None] * direction
            share = np.divide(wall, length, out=np.ones_like(wall), where=np.isfinite(wall))
            bad = self._bad(foot, share)
            if not bad.any() or attempt == _ATTEMPTS - 1:
                break
            near = np.flatnonzero(bad | (self.mean @ bad > 0))
            if attempt % 3 == 1:
                self._fair_top(bad, skin)
            if attempt % 3 == 2:
                shorter = bad & (reach > SHORTEST)
                self.factor[shorter] *= _SHORTEN
            turned = ground.flat(direction + self.mean @ direction)
            direction[near] = turned[near]
            length[near], on_bone[near], wall[near] = ground.lengths(direction[near], near)
        short = self.factor < 1.0
        held = on_bone & (~short | ((share < 1.0) & (self.factor >= _STILL_HELD)))
        every = Columns(ground.vertex, self.triangles, ground.top, foot, held, share, short)
        return _without(every, self.unsound) if self.unsound.any() else every

    def _fair_top(self, bad: Bools, skin: Floats) -> None:
        """Move the tops of bad columns towards the mean of their neighbours, at most `_LARGEST_SHIFT` off the skin."""
        top = self.ground.top
        goal = np.asarray(0.5 * top + 0.5 * (self.fair @ top))
        goal[self.ground.middle, 0] = 0.0
        shift = goal - skin
        size = np.linalg.norm(shift, axis=1, keepdims=True)
        goal = skin + shift * np.minimum(1.0, _LARGEST_SHIFT / np.maximum(size, 1e-9))
        move = bad & (np.asarray(self.fair.sum(axis=1)).ravel() > 0.5) & ~self.ground.rigid
        top[move] = goal[move]

    def _filled(self, length: Floats, on_bone: Bools) -> Floats:
        """Return lengths in which columns that met nothing follow their neighbours, and free ones change smoothly."""
        lost = ~np.isfinite(length)
        limit = np.where(lost, self.roomy, length)
        out = limit
        fixed = on_bone | self.ground.rigid
        for _ in range(_SMOOTHING):
            out = np.where(fixed, out, np.minimum(limit, 0.5 * out + 0.5 * (self.mean @ out)))
        return out

    def _bad(self, foot: Floats, wall: Floats) -> Bools:
        """Return the columns with an unsound element, (m,); only prisms whose columns have moved are looked at."""
        now = np.concatenate([self.ground.top, foot, wall[:, None]], axis=1)
        moved = (now != self.last).any(axis=1)
        check = np.flatnonzero(moved[self.triangles].any(axis=1))
        self.last = now
        mesh = TetMesh(*stacked(self.ground.top, foot, wall, self.triangles[check], self.layers))
        self.unsound[check] = (mesh.quality < self.least).reshape(len(check), -1).any(axis=1)
        out = np.zeros(len(foot), dtype=bool)
        out[self.triangles[self.unsound]] = True
        return out


def _without(columns: Columns, prism: Bools) -> Columns:
    """Return the columns without some prisms (t,): the few of an unusual head that could not be made sound."""
    kept, index = np.unique(_largest(columns.triangles[~prism], len(columns.vertex)), return_inverse=True)
    return Columns(
        vertex=columns.vertex[kept],
        triangles=index.reshape(-1, 3).astype(np.int32),
        top=columns.top[kept],
        foot=columns.foot[kept],
        on_bone=columns.on_bone[kept],
        wall=columns.wall[kept],
        shortened=columns.shortened[kept],
    )


def _averaging(pairs: Ints, n: int) -> csr_matrix:
    """Return the matrix that takes the mean of each vertex's neighbours in `pairs` (e, 2)."""
    half = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    both = half + half.T
    return (diags(1.0 / np.maximum(np.asarray(both.sum(axis=1)).ravel(), 1.0)) @ both).tocsr()


def inner_ball(points: Floats, inward: Floats, reach: float = _BALL_REACH) -> Floats:
    """Return the radius of the largest ball that touches each point from within and holds no other, (m,) [mm].

    points : (m, 3)   inward : (m, 3) unit normals into the body   reach : points farther apart do not count [mm]
    Ma, Bae & Choi, The Visual Computer 28 (2012), Eq. 1
    """
    others = np.arange(0, len(points), 1 + len(points) // _MOST_OTHERS)
    near = cKDTree(points).sparse_distance_matrix(cKDTree(points[others]), reach, output_type="ndarray")
    i, j = near["i"], others[near["j"]]
    way = points[j] - points[i]
    along = np.einsum("ij,ij->i", way, inward[i])
    squared = np.einsum("ij,ij->i", way, way)
    counts = (along > 1e-3) & (squared > 1.0)
    out = np.full(len(points), np.inf)
    np.minimum.at(out, i[counts], squared[counts] / (2.0 * along[counts]))
    return out


def layer_shares(length: Floats, wall: Floats, layers: int) -> Floats:
    """Return how far along its column each node lies, (m, layers + 1) in [0, 1]: the skin first, then equal layers.

    Where the flesh ends before bone, at the share `wall` (m,) < 1, the last layer is the gap between.
    """
    end = np.where(wall < 1.0, layers - 1, layers)
    skin = np.minimum(SKIN_THICKNESS / length, wall / end)
    level = np.arange(layers + 1)
    deep = skin[:, None] + (wall - skin)[:, None] * (level - 1) / np.maximum(end - 1, 1)[:, None]
    return np.where(level == 0, 0.0, np.where(level > end[:, None], 1.0, deep))


def stacked(top: Floats, foot: Floats, wall: Floats, triangles: Ints, layers: int) -> tuple[Floats, Ints]:
    """Return the nodes (m (layers + 1), 3) and elements of prisms on `triangles`, node column * (layers + 1) + layer.

    Every prism is cut into three tetrahedra. Its sides are cut from the top of the column with the smaller number to
    the foot of the other, so that neighbours fit; all layers of a column are cut alike.
    """
    share = layer_shares(np.linalg.norm(foot - top, axis=1), wall, layers)
    points = top[:, None] + share[:, :, None] * (foot - top)[:, None]
    order = np.argsort(triangles, axis=1)
    a, b, c = np.take_along_axis(triangles, order, axis=1).T * (layers + 1)
    even = ((order[:, 1] - order[:, 0]) % 3 == 1)[:, None]
    tets = []
    for k in range(layers):
        for tet in (
            (a + k, b + k, c + k, c + k + 1),
            (a + k, b + k, c + k + 1, b + k + 1),
            (a + k, b + k + 1, c + k + 1, a + k + 1),
        ):
            block = np.stack(tet, axis=1)
            tets.append(np.where(even, block[:, [0, 2, 1, 3]], block))
    return points.reshape(-1, 3), np.stack(tets, axis=1).reshape(-1, 4).astype(np.int32)
