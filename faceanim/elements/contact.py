"""Flesh against rigid bones: a frictionless penalty on how deep its nodes are, or displacements imposed on them.

The penalty lets flesh slide along bone; imposed displacements, as in the mixed-element paper on craniofacial surgery,
make it stick where it touches. Nodes that are held (periosteum) take part in neither.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from faceanim.elements.newton import Report, System, Term, newton
from faceanim.geometry.bone_field import BoneField, rigid_pose
from faceanim.geometry.volume import TetMesh
from faceanim.ground.arrays import Bools, Floats, Ints, floats, ints
from faceanim.ground.errors import DivergenceError, UserError

FACTOR = 50.0
"""Penalty stiffness per area over Young's modulus by edge length; the deepest of the usual 10 to 50 keeps < 0.05 mm."""
SMALLEST = 1.0 / 32.0
"""A movement is divided down to this share of its steps before it counts as impossible."""
RIM = 1e-6
"""A node is counted as touching from this depth on [mm]."""


class Tangled(System, Protocol):
    """A system whose tangent says where the blocks of its node pairs are; node_pattern : (n, n), sparse, the pairs."""

    node_pattern: Any

    def entries(self, i: Ints, j: Ints) -> Ints:
        """Return where the 3 x 3 blocks of the pairs (`i`, `j`) are in the tangent's values, (k, 3, 3)."""


class Frozen(Term, Protocol):
    """A term whose contacts are found at some positions and then kept."""

    def freeze(self, x: Floats) -> None:
        """Find what touches at `x` (n, 3), and keep it."""


@dataclass(frozen=True, eq=False)
class BoneTouch:
    """Nodes that may touch bones, one (node, bone) pair a row.

    node, bone : (k,)   area : (k,) [mm^2] of surface that each stands for
    stiffness : (k,) [mN/mm^3], pressure per depth   allowance : (k,) [mm], depth that is allowed (that at rest)
    """

    node: Ints
    bone: Ints
    area: Floats
    stiffness: Floats
    allowance: Floats

    def __post_init__(self) -> None:
        k = len(self.node)
        for name in ("bone", "area", "stiffness", "allowance"):
            value = getattr(self, name)
            if value.shape != (k,):
                raise UserError(f"bone touch: {name} has shape {value.shape}; ({k},) is needed")
            if not np.isfinite(value).all() or (value < 0).any():
                raise UserError(f"bone touch: {name} must hold finite numbers that are not negative")


class Touch(NamedTuple):
    """How things touch: the deepest depth beyond what is allowed [mm], how many, how many are buried, the force [mN].

    force : (number of bones, 3), that of the flesh on each bone
    """

    deepest: float
    active: int
    buried: int
    force: Floats


def node_areas(points: Floats, triangles: Ints) -> Floats:
    """Return the area that each node stands for, (n,) [mm^2]: the load of a unit pressure on faces with 3 or 6 nodes.

    A face with 6 nodes loads its mid-edge nodes alone, by a third each.
    """
    corner = points[triangles[:, :3]]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    loaded = triangles[:, -3:]
    return np.asarray(np.bincount(loaded.ravel(), np.repeat(area / 3.0, 3), len(points)), dtype=np.float64)


def penalty_stiffness(mesh: TetMesh, young: Any, faces: Ints, n: int, factor: float = FACTOR) -> Floats:
    """Return `factor` times Young's modulus over the edge length at the nodes of boundary `faces`, (n,) [mN/mm^3].

    young : [kPa], a number or (e,); the stiffest element at a corner counts   faces : (t, 3 | 6) of `n` nodes
    The stiffest face at a node counts; zero where there is none.
    """
    if not (np.isfinite(factor) and factor > 0.0):
        raise UserError(f"penalty stiffness: factor = {factor} must be positive and finite")
    modulus = np.zeros(len(mesh.points))
    each = np.broadcast_to(np.asarray(young, dtype=np.float64), len(mesh.tets))
    np.maximum.at(modulus, mesh.tets.ravel(), np.repeat(each, 4))
    corner = mesh.points[faces[:, :3]]
    length = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).mean(axis=1)
    out = np.zeros(n)
    stiff = factor * modulus[faces[:, :3]].max(axis=1) / length
    np.maximum.at(out, faces.ravel(), np.repeat(stiff, faces.shape[1]))
    return out


def near_bones(
    mesh: TetMesh,
    held: Any,
    bones: Sequence[BoneField],
    *,
    reach: float,
    young: Any,
    factor: float = FACTOR,
    among: Any = None,
    faces: Ints | None = None,
    points: Floats | None = None,
) -> BoneTouch:
    """Return the free boundary nodes of `mesh` that may touch one of `bones`: those within `reach` [mm] of it at rest.

    held : (n,) bool, nodes that bones hold   young : [kPa], a number or (e,), for the stiffness
    among : node indices; only faces with all nodes in it take part, and make up areas (None = the whole boundary)
    faces, points : for quadratic elements `face_nodes(mesh.boundary_triangles)` and their `points`
    A node that is inside a bone at rest is allowed the depth that it has; one deeper than the field knows is left out.
    """
    if not (np.isfinite(reach) and reach > 0.0):
        raise UserError(f"near bones: reach = {reach} mm must be positive and finite")
    place = mesh.points if points is None else points
    faces = mesh.boundary_triangles if faces is None else faces
    n = len(place)
    free = ~np.asarray(held, dtype=bool)
    if free.shape != (n,):
        raise UserError(f"near bones: held has shape {free.shape}; ({n},) is needed")
    if among is not None:
        faces = faces[np.isin(faces, ints("among", among, None, below=n)).all(axis=1)]
    wanted = np.unique(faces[:, -3:])
    wanted = wanted[free[wanted]]
    area, stiffness = node_areas(place, faces), penalty_stiffness(mesh, young, faces, n, factor)
    node, owner, allowance = [np.zeros(0, np.int32)], [np.zeros(0, np.int32)], [np.zeros(0)]
    for b, bone in enumerate(bones):
        near = wanted[bone.exact(place[wanted]) > -reach] if len(wanted) else wanted
        depth = bone.sample(place[near]).depth
        known = depth < np.inf
        node.append(near[known].astype(np.int32))
        owner.append(np.full(known.sum(), b, dtype=np.int32))
        allowance.append(np.maximum(depth[known], 0.0))
    nodes = np.concatenate(node)
    return BoneTouch(nodes, np.concatenate(owner), area[nodes], stiffness[nodes], np.concatenate(allowance))


class BonePenalty:
    """The energy k A p^2 / 2 of every node that is p deeper in a bone than allowed: a `newton.Term`.

    With the field read as a spline its force -k A p grad d is the exact, continuous derivative of that energy, and
    Newton's search converges; the paper's linear reading jumps from one tetrahedron to the next, where a search may
    get stuck. The tangent k A grad d grad d^T leaves out the curvature of d and is never negative. The force is along
    grad d alone: no friction. Where a node is buried the energy is infinite, so that a search cuts its step.
    """

    def __init__(
        self, elements: Tangled, touch: BoneTouch, bones: Sequence[BoneField], *, reading: str = "spline"
    ) -> None:
        """Compile the tables; `reading` as in `BoneField.sample`. Raises `UserError` for indices that do not exist."""
        self.touch, self.bones, self.reading = touch, tuple(bones), reading
        self._n = len(elements.points)
        ints("touch.node", touch.node, None, below=self._n)
        ints("touch.bone", touch.bone, None, below=len(self.bones))
        self._rows = [np.flatnonzero(touch.bone == b) for b in range(len(self.bones))]
        self._weight = touch.stiffness * touch.area
        self._at = elements.entries(touch.node, touch.node).reshape(-1, 9)
        self.poses: Floats = np.tile(np.eye(4), (len(self.bones), 1, 1))

    def move(self, poses: Any) -> None:
        """Carry the bones by `poses` (b, 4, 4) from their rest; they hold until the next call."""
        self.poses = rigid_poses(poses, len(self.bones))

    def depths(self, x: Floats) -> tuple[Floats, Floats]:
        """Return how much deeper than allowed each row of `touch` is, (k,) [mm], and grad d, (k, 3)."""
        depth, inward = np.full(len(self.touch.node), -np.inf), np.zeros((len(self.touch.node), 3))
        for bone, pose, rows in zip(self.bones, self.poses, self._rows, strict=True):
            if len(rows):
                depth[rows], inward[rows], _ = bone.sample(x[self.touch.node[rows]], pose, reading=self.reading)
        return depth - self.touch.allowance, inward

    def energy(self, x: Floats) -> float:
        """Return the energy [uJ]; infinite where a node is buried."""
        deep = np.maximum(self.depths(x)[0], 0.0)
        return float(0.5 * (self._weight * deep) @ deep) if np.isfinite(deep).all() else np.inf

    def forces(self, x: Floats) -> Floats:
        """Return minus its gradient, (n, 3) [mN]; nothing for buried nodes, whose energy has none."""
        depth, inward = self.depths(x)
        size = self._weight * np.where(np.isfinite(depth), np.maximum(depth, 0.0), 0.0)
        return _added(self.touch.node, -size[:, None] * inward, self._n)

    def add_tangent(self, x: Floats, values: Floats) -> None:
        """Add k A grad d grad d^T of the nodes that touch."""
        depth, inward = self.depths(x)
        on = np.flatnonzero((depth > 0.0) & np.isfinite(depth))
        block = self._weight[on, None, None] * inward[on, :, None] * inward[on, None, :]
        np.add.at(values, self._at[on], block.reshape(-1, 9))

    def report(self, x: Floats) -> Touch:
        """Return how the flesh touches the bones at `x`."""
        depth, inward = self.depths(x)
        known = np.isfinite(depth)
        size = self._weight * np.where(known, np.maximum(depth, 0.0), 0.0)
        force = _added(self.touch.bone, size[:, None] * inward, len(self.bones))
        deepest = float(depth[known].max(initial=0.0))
        return Touch(max(deepest, 0.0), int((depth[known] > RIM).sum()), int((depth == np.inf).sum()), force)


class Imposed(NamedTuple):
    """Displacements imposed on points: chosen (k,), move (k, 3) [mm]; buried (m,), those of no known direction."""

    chosen: Ints
    move: Floats
    buried: Ints


def imposed(
    points: Any,
    bone: BoneField,
    pose: Any = None,
    *,
    allowance: Any = 0.0,
    reading: str = "nearest",
    sweeps: int = 1,
    last: Any = None,
) -> Imposed:
    """Return which of `points` (n, 3) are in the bone, and the displacement d n that takes each out of it.

    n = -grad d / |grad d|, outwards. reading : see `BoneField.sample`; the paper's is "linear", which at ridges and
    hollows is a share of the lattice's spacing off   sweeps : how often a point is looked at; 1 = as in the paper
    last : (n, 3) directions in which a buried point is taken out by the envelope's thickness; None = not at all
    The bone's motion since the points were outside must stay below `BoneField.step`, else points end up buried.
    """
    if sweeps < 1:
        raise UserError(f"imposed: sweeps = {sweeps} must be at least 1")
    place = floats("points", points, None, 3).copy()
    begin = place.copy()
    index = np.arange(len(place))
    hit, buried = np.zeros(len(place), dtype=bool), np.zeros(len(place), dtype=bool)
    for _ in range(sweeps):
        known = None if last is None else np.asarray(last)[index]
        depth, inward, deep = bone.sample(place[index], pose, reading=reading, last=known)
        depth = depth - np.broadcast_to(allowance, len(place))[index]
        buried[index[deep]] = True
        length = np.linalg.norm(inward, axis=1)
        depth = np.where(deep, bone.thickness, depth)
        out = (depth > 0.0) & (length > 0.0)
        place[index[out]] -= (depth[out] / length[out])[:, None] * inward[out]
        hit[index[out]] = True
        index = index[out]
    chosen = np.flatnonzero(hit).astype(np.int32)
    return Imposed(chosen, place[chosen] - begin[chosen], np.flatnonzero(buried).astype(np.int32))


def settle(
    elements: System,
    sheets: Sequence[Frozen],
    *,
    fixed: Any,
    start: Any = None,
    terms: Sequence[Term] = (),
    rounds: int = 20,
    still: float = 1e-3,
    **options: Any,
) -> tuple[Floats, Report]:
    """Return the balance with sheets that touch, (n, 3) [mm], and the report of the last search, as `newton` does.

    The contacts of `sheets` are frozen where they are, the balance with them is searched, and so on until nothing
    moves by more than `still` [mm]; when `rounds` do not reach that, the report says it has not converged.
    """
    x = elements.points if start is None else np.asarray(start, dtype=np.float64)
    steps = 0
    for _ in range(rounds if sheets else 1):
        for sheet in sheets:
            sheet.freeze(x)
        there, report = newton(elements, fixed=fixed, start=x, terms=(*sheets, *terms), **options)
        steps += report.iterations
        report.iterations = steps
        moved, x = float(np.abs(there - x).max()), there
        if not report.converged or not sheets or moved <= still:
            return x, report
    report.converged = False
    return x, report


def rigid_poses(poses: Any, count: int) -> Floats:
    """Return `poses` as checked (count, 4, 4); raise `UserError` naming the one that is not rigid."""
    array = floats("poses", poses, count, 4, 4)
    for b, pose in enumerate(array):
        rigid_pose(f"the pose of bone {b}", pose)
    return array


def pose_between(start: Floats, goal: Floats, t: float) -> Floats:
    """Return the poses a share `t` of the way from `start` to `goal`, (b, 4, 4): turns at an even rate about the origin."""
    out = np.tile(np.eye(4), (len(start), 1, 1))
    for b in range(len(start)):
        way = Rotation.from_matrix(goal[b, :3, :3] @ start[b, :3, :3].T)
        out[b, :3, :3] = Rotation.from_rotvec(t * way.as_rotvec()).as_matrix() @ start[b, :3, :3]
        out[b, :3, 3] = (1.0 - t) * start[b, :3, 3] + t * goal[b, :3, 3]
    return out


def steps_needed(bones: Sequence[BoneField], start: Floats, goal: Floats) -> int:
    """Return in how many equal parts the way must go so that no part moves any point of a bone by more than its step."""
    most = 1
    for b, bone in enumerate(bones):
        step = _carried(bone.surface.points, goal[b]) - _carried(bone.surface.points, start[b])
        turned = Rotation.from_matrix(goal[b, :3, :3] @ start[b, :3, :3].T).magnitude()
        # the way of a point is an arc, a little longer than its chord
        way = np.linalg.norm(step, axis=1).max() * (1.0 + turned**2 / 24.0)
        most = max(most, int(np.ceil(way / bone.step * (1.0 - 1e-9))))
    return most


@dataclass
class Follow:
    """How flesh followed its bones: final `x` (n, 3), Newton's report and the touch of each accepted step."""

    x: Floats
    reports: list[Report]
    touches: list[Touch]
    stuck: Bools


Carrier = Callable[[Floats], Floats]


def follow(
    elements: Tangled,
    contact: BonePenalty,
    poses: Any,
    *,
    fixed: Any,
    carried: Carrier | None = None,
    start: Any = None,
    terms: Sequence[Term] = (),
    sheets: Sequence[Frozen] = (),
    force: Any = None,
    steps: int | None = None,
    impose: bool = False,
    **options: Any,
) -> Follow:
    """Move the bones of `contact` from where they are to `poses` (b, 4, 4) and let the flesh follow, in steps.

    fixed : (n,) or (n, 3) bool   carried : poses -> positions (n, 3) of the fixed freedoms (None = they stay)
    start : (n, 3), flesh in balance with the bones where they are (None = at rest)   steps : None = as many as needed
    sheets : contacts of flesh with flesh, see `settle`
    impose : take nodes out of the bones by imposed displacements instead of the penalty; they stick while they touch
    options : for `newton.newton`
    A step that fails is divided. Raises `DivergenceError` when that does not help either.
    """
    goal = rigid_poses(poses, len(contact.bones))
    begin, held = contact.poses.copy(), _both(fixed, elements)
    count = steps_needed(contact.bones, begin, goal) if steps is None else steps
    if count < 1:
        raise UserError(f"follow: steps = {steps} must be at least 1")
    out = Follow(floats("start", elements.points if start is None else start, None, 3).copy(), [], [], held.copy())
    done, share = 0.0, 1.0 / count
    while done < 1.0:
        part = 1.0 if done + share > 1.0 - 1e-9 else done + share
        contact.move(pose_between(begin, goal, part))
        values = out.x if carried is None else np.where(held, carried(contact.poses), out.x)
        run = _stuck_step if impose else _sliding_step
        if run(elements, contact, out, held, values, force, terms, sheets, options):
            done = part
            share = min(1.0 / count, 2.0 * share)
            continue
        contact.move(pose_between(begin, goal, done))
        share *= 0.5
        if share * count < SMALLEST:
            raise DivergenceError(
                f"the flesh cannot follow the bones beyond {done:.3g} of their way: no balance was found even in a "
                f"{1.0 / SMALLEST:g}th of a step; move them less, refine the flesh or soften the contact"
            )
    return out


def _sliding_step(
    elements: Tangled, contact: BonePenalty, out: Follow, held: Bools, values: Floats, force: Any,
    terms: Sequence[Term], sheets: Sequence[Frozen], options: dict[str, Any],
) -> bool:  # fmt: skip
    if contact.report(out.x).buried:
        return False
    x, report = settle(
        elements, sheets, fixed=held, values=values, force=force, start=out.x, terms=(contact, *terms), **options
    )
    if not (report.converged and report.valid):
        return False
    out.x = x
    out.reports.append(report)
    out.touches.append(contact.report(x))
    return True


def _stuck_step(
    elements: Tangled, contact: BonePenalty, out: Follow, held: Bools, values: Floats, force: Any,
    terms: Sequence[Term], sheets: Sequence[Frozen], options: dict[str, Any],
) -> bool:  # fmt: skip
    """Impose displacements, balance the rest, and again for nodes that only then come into a bone."""
    x, goal, fixed = out.x, values.copy(), held.copy()
    for _ in range(8):
        depth, _ = contact.depths(np.where(fixed, goal, x))
        if np.isposinf(depth).any():
            return False
        new = (depth > RIM) & ~fixed[contact.touch.node].all(axis=1)
        if not new.any() and len(out.reports) and x is not out.x:
            break
        for node, move in _ways_out(contact, x, new):
            goal[node], fixed[node] = x[node] + move, True
        x, report = settle(elements, sheets, fixed=fixed, values=goal, force=force, start=x, terms=terms, **options)
        if not (report.converged and report.valid):
            return False
        out.reports.append(report)
    out.x, out.stuck = x, fixed
    out.touches.append(contact.report(x))
    return True


def _ways_out(contact: BonePenalty, x: Floats, rows: Bools) -> Iterator[tuple[int, Floats]]:
    """Yield the node and its way out of the bone for each of the `rows` of the touch."""
    for b, bone in enumerate(contact.bones):
        chosen = np.flatnonzero(rows & (contact.touch.bone == b))
        node = contact.touch.node[chosen]
        way = imposed(x[node], bone, contact.poses[b], allowance=contact.touch.allowance[chosen], sweeps=3)
        yield from zip(node[way.chosen].tolist(), way.move, strict=True)


def _both(fixed: Any, elements: System) -> Bools:
    array = np.asarray(fixed)
    n = len(elements.points)
    if array.dtype != np.bool_ or array.shape not in ((n,), (n, 3)):
        raise UserError(f"fixed must be bool of shape ({n},) or ({n}, 3), not {array.dtype} {array.shape}")
    return np.ascontiguousarray(np.broadcast_to(array.reshape(n, -1), (n, 3)))


def _carried(points: Floats, pose: Floats) -> Floats:
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def _added(index: Ints, rows: Floats, n: int) -> Floats:
    """Return the sums of `rows` (k, 3) by `index` (k,), (n, 3)."""
    out = np.empty((n, 3))
    for d in range(3):
        out[:, d] = np.bincount(index, rows[:, d], n)
    return out
