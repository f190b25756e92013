"""Laws of a head's flesh as a volume: sound elements, nodes on bone, separate lips and lids, skin that rides on it."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from heads import other_head
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from faceanim.backends.nodal import carried
from faceanim.body.assembly import stiffness_matrix
from faceanim.body.body import PULL_TO_POINT, Body
from faceanim.body.control import Control
from faceanim.expression.library import load_expression
from faceanim.face.attach import LID, LIP, SCALP, SKIN
from faceanim.face.columns import inner_ball, layer_shares
from faceanim.face.face import Face
from faceanim.face.library import asset_text, load_face
from faceanim.face.tissue import parse_tissue
from faceanim.face.tissue_volume import FAT, GAP, LEAST_QUALITY, MUSCLE, SKIN_LAYER, Flesh, flesh
from faceanim.geometry.distance_field import point_distance
from faceanim.geometry.shapes import sphere
from faceanim.geometry.topology import edges
from faceanim.geometry.volume import TetMesh
from faceanim.ground.errors import AssetError, UserError

COUNTS = {"coarse": (9_000, 13_000), "default": (17_000, 24_000), "fine": (75_000, 105_000)}
DENSITIES = ["coarse", "default", pytest.param("fine", marks=pytest.mark.slow)]
MIRROR = np.array([-1.0, 1.0, 1.0])


@lru_cache(maxsize=3)
def head(density: str) -> tuple[Face, Flesh]:
    """Return the built-in head and its flesh."""
    face = load_face("default", density)
    return face, flesh(face)


@pytest.mark.parametrize("density", DENSITIES)
def test_elements_are_sound(density: str) -> None:
    """No element is inverted or flat, one part, held by bone, as many elements as asked for, half a litre of flesh."""
    _, tissue = head(density)
    solid = tissue.solid
    solid.reject_bad()
    mesh = solid.mesh
    assert mesh.volumes.min() > 0 and mesh.quality.min() >= LEAST_QUALITY
    assert np.percentile(mesh.quality, 1) > 0.1 and np.median(mesh.quality) > 0.35
    low, high = COUNTS[density]
    assert low <= len(mesh.tets) <= high
    assert mesh.parts.max() == 0
    assert 4.5e5 < mesh.volumes.sum() < 6.5e5
    assert tissue.shortened.mean() < 0.2


@pytest.mark.parametrize("density", DENSITIES)
def test_held_nodes_lie_on_bone(density: str) -> None:
    """A foot on bone is within half a millimetre of it; nothing held is deeper than one; shares of bones sum to 1.

    Feet in the gap before the teeth may hover in front of them; columns of pinned skin are held all along.
    """
    face, tissue = head(density)
    solid, layers = tissue.solid, _layers(tissue)
    skull = face.skull
    x = solid.mesh.points
    near = np.minimum(skull.cranium_grid.sample(x), skull.jaw_grid.sample(x))
    pinned = np.repeat(face.pinned[tissue.vertex], layers + 1)
    gap = np.zeros(len(x), dtype=bool)
    gap[solid.mesh.tets[solid.region == GAP]] = True
    strict = solid.held & ~pinned & ~gap
    hovering = np.abs(near[strict]) > 0.5
    assert hovering.mean() < 0.02 and np.abs(near[strict]).max() < 4.0
    assert near[solid.held & ~pinned].min() > -1.0
    foot = np.arange(len(x)) % (layers + 1) == layers
    assert foot[solid.held & ~pinned].all()
    assert 0.4 < (solid.held & foot).sum() / foot.sum() < 0.9
    np.testing.assert_allclose(solid.bone_weight[solid.held].sum(axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("density", DENSITIES)
def test_both_sides_are_mirror_images(density: str) -> None:
    """Nodes, elements, materials, bones and carried skin are symmetric to the last bit."""
    face, tissue = head(density)
    solid, layers = tissue.solid, _layers(tissue)
    x = solid.mesh.points
    twin = (tissue.twin[:, None] * (layers + 1) + np.arange(layers + 1)).ravel()
    np.testing.assert_array_equal(x[twin], x * MIRROR)
    np.testing.assert_array_equal(solid.bone_weight[twin], solid.bone_weight)
    table = {tuple(t): r for t, r in zip(np.sort(solid.mesh.tets, axis=1).tolist(), solid.region, strict=True)}
    for t, r in zip(np.sort(twin[solid.mesh.tets], axis=1).tolist(), solid.region, strict=True):
        assert table[tuple(t)] == r
    u = np.random.default_rng(0).normal(size=x.shape)
    u += u[twin] * MIRROR
    by_bone = (solid.skin.weight[:, 4:] != 0.0).any(axis=1)  # hangs on bones as they turn, not on single nodes
    moved = np.where(by_bone[:, None], 0.0, solid.skin.apply(u))
    np.testing.assert_allclose(moved[face.mirror], moved * MIRROR, atol=1e-9)


@pytest.mark.parametrize("density", DENSITIES)
def test_skin_rides_on_the_flesh(density: str) -> None:
    """Every skin vertex is where it was at rest, most inside or close to an element, weights of modest size."""
    face, tissue = head(density)
    skin = tissue.solid.skin
    np.testing.assert_allclose(skin.apply(tissue.solid.mesh.points), face.mesh.points, atol=1e-9)
    np.testing.assert_allclose(skin.weight.sum(axis=1), 1.0, atol=1e-9)
    free = ~tissue.rigid
    out = free & (skin.weight.min(axis=1) < -1e-9)
    away = point_distance(face.mesh.points[out], tissue.solid.mesh.boundary)[0]
    assert away.max() < 7.0 and np.median(away) < 0.6  # the farthest are inside the mouth
    visible = free & np.isin(face.region, (SKIN, LIP))
    assert np.percentile(skin.weight[visible].min(axis=1), 1) > -4.0
    assert np.percentile(skin.weight[visible].min(axis=1), 10) > -0.8


@pytest.mark.parametrize("density", DENSITIES)
def test_what_bone_carries_goes_with_bone(density: str) -> None:
    """Scalp, ears, collar and the depth of the mouth follow the weighted poses of the bones exactly."""
    face, tissue = head(density)
    solid = tissue.solid
    pose = np.stack([np.eye(4), face.jaw.pose(0.6, 0.4, 0.3)])
    x = solid.mesh.points.copy()
    x[solid.held] = carried(solid, pose)
    rest = face.mesh.points[tissue.rigid]
    wanted = np.einsum("nb,bij,nj->ni", face.bone_weight[tissue.rigid], pose[:, :3, :3], rest)
    wanted += face.bone_weight[tissue.rigid] @ pose[:, :3, 3]
    np.testing.assert_allclose(solid.skin.apply(x)[tissue.rigid], wanted, atol=1e-8)
    assert tissue.rigid[face.pinned].all() and (face.region == SCALP)[tissue.rigid].sum() > 0


@pytest.mark.parametrize("density", DENSITIES)
def test_lips_and_lids_are_joined_at_their_corners_only(density: str) -> None:
    """Through the flesh it is far from the middle of one lip to that of the other, although they touch."""
    face, tissue = head(density)
    corner = face.mesh.points[face.landmarks["cheilion_left"], 0]
    assert _way(face, tissue, "stomion_upper", "stomion_lower", LIP) > 1.5 * corner
    for side in ("left", "right"):
        assert _way(face, tissue, f"lid_upper_mid_{side}", f"lid_lower_mid_{side}", LID) > 22.0


def _way(face: Face, tissue: Flesh, a: str, b: str, code: int) -> float:
    """Return the shortest way along edges between the columns nearest to two landmarks, each on its own flap [mm]."""
    mesh = tissue.solid.mesh
    pairs = np.concatenate([mesh.tets[:, [i, j]] for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))])
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    length = np.linalg.norm(mesh.points[pairs[:, 0]] - mesh.points[pairs[:, 1]], axis=1)
    graph = sparse.coo_matrix((length, tuple(pairs.T)), shape=(len(mesh.points),) * 2)
    ends = []
    for name in (a, b):
        which = "upper" if "upper" in name else "lower"
        kind = "lip" if code == LIP else "lid"
        end = f"_{name.rpartition('_')[2]}" if code == LID else ""
        own = np.isin(tissue.vertex, face.contact_sets[f"{kind}_{which}{end}"])
        column = np.flatnonzero(own)
        at = face.mesh.points[face.landmarks[name]]
        near = column[np.argmin(np.linalg.norm(face.mesh.points[tissue.vertex[column]] - at, axis=1))]
        ends.append(int(near) * (_layers(tissue) + 1))
    assert np.linalg.norm(mesh.points[ends[0]] - mesh.points[ends[1]]) < 15.0
    return float(dijkstra(graph, directed=False, indices=ends[0])[ends[1]])


def _layers(tissue: Flesh) -> int:
    return len(tissue.solid.mesh.points) // len(tissue.vertex) - 1


def test_layers_are_in_order() -> None:
    """The skin lies outside, two millimetres thick where there is room; muscle, fat and the gap lie beneath."""
    face, tissue = head("default")
    solid = tissue.solid
    tree = cKDTree(face.mesh.points)
    depth = tree.query(solid.mesh.points[solid.mesh.tets].mean(axis=1))[0]
    mean = [depth[solid.region == r].mean() for r in (SKIN_LAYER, FAT, MUSCLE)]
    assert mean[0] < min(mean[1:]) and set(np.unique(solid.region)) == {SKIN_LAYER, FAT, MUSCLE, GAP}
    assert solid.mesh.volumes[solid.region == GAP].sum() < 0.05 * solid.mesh.volumes.sum()
    share = layer_shares(np.array([10.0, 3.0, 10.0]), np.array([1.0, 1.0, 0.7]), 4)
    np.testing.assert_allclose(share[0], [0.0, 0.2, 0.2 + 0.8 / 3, 0.2 + 1.6 / 3, 1.0])
    np.testing.assert_allclose(share[1], [0.0, 0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(share[2], [0.0, 0.2, 0.45, 0.7, 1.0])


def test_balls_touch_a_sphere_from_within() -> None:
    """The largest ball inside a sphere is the sphere."""
    ball = sphere(8.0, 3)
    radius = inner_ball(ball.points, -ball.points / 8.0)
    np.testing.assert_allclose(radius, 8.0, rtol=1e-6)


def test_the_mouth_opens_and_smiles() -> None:
    """Linear statics: the lips part with the jaw, happiness draws the corners up and out alike, the nose stays."""
    face, _ = head("coarse")
    body = face.body()
    mark = face.landmarks
    control = Control.rest(body)
    control.bone_pose[1] = face.jaw.pose(0.3)
    moved = _equilibrium(body, control) - face.mesh.points
    assert moved[mark["stomion_lower"], 1] < -8.0 and abs(moved[mark["stomion_upper"], 1]) < 4.0
    assert np.linalg.norm(moved[mark["pronasale"]]) < 3.5
    control = Control.rest(body)
    control.activation[:] = load_expression("happiness").drive(body.muscles.names).activation
    moved = _equilibrium(body, control) - face.mesh.points
    left, right = moved[mark["cheilion_left"]], moved[mark["cheilion_right"]]
    np.testing.assert_allclose(left, right * MIRROR, atol=1e-6)
    assert 9.0 < np.linalg.norm(left) < 17.0 and left[0] > 4.0 and left[1] > 4.0
    assert np.linalg.norm(moved[mark["pronasale"]]) < 3.5
    assert np.abs(moved[face.pinned]).max() < 1e-9


def _equilibrium(body: Body, control: Control) -> np.ndarray:
    """Return the surface (n, 3) in linear statics; muscles pull towards their points by secant stiffness."""
    solid, muscle = body.solid, body.muscles
    assert solid is not None
    n = len(solid.mesh.points)
    stiffness, skin = stiffness_matrix(solid), sparse.kron(solid.skin.matrix(n), sparse.eye(3)).tocsr()
    held = np.repeat(solid.held, 3)
    u = np.zeros(3 * n)
    u[held] = (carried(solid, control.bone_pose) - solid.mesh.points[solid.held]).ravel()
    rest = body.surface.points
    pull = control.activation[muscle.muscle] * muscle.max_force[muscle.muscle] * muscle.weight
    goal = np.einsum("eij,ej->ei", control.bone_pose[muscle.bone, :3, :3], muscle.point)
    towards = muscle.kind == PULL_TO_POINT
    goal = np.where(towards[:, None], goal + control.bone_pose[muscle.bone, :3, 3], goal)
    for _ in range(5):
        way = goal - (rest + (skin @ u).reshape(-1, 3))[muscle.node]
        secant = np.where(towards, pull / np.sqrt((way**2).sum(axis=1) + muscle.softening**2), 0.0)
        force, k = np.zeros_like(rest), np.bincount(muscle.node, secant, len(rest))
        np.add.at(
            force,
            muscle.node,
            np.where(towards[:, None], secant[:, None] * (goal - rest[muscle.node]), pull[:, None] * goal),
        )
        total = (stiffness + skin.T @ sparse.diags(np.repeat(k, 3)) @ skin).tocsr()
        free = total[~held][:, ~held].tocsc()
        right = (skin.T @ force.ravel())[~held] - total[~held][:, held] @ u[held]
        u[~held] = splu(free, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(right)
    return rest + (skin @ u).reshape(-1, 3)


def test_heads_of_other_shapes_have_flesh() -> None:
    """A larger head, and one that is not symmetric (grown as a whole), give sound elements and exact rest."""
    face, _ = head("coarse")
    wide = other_head(face, (1.03, 1.0, 1.0))
    x = face.mesh.points
    bent = replace(face, mesh=type(face.mesh)(x + 0.02 * x[:, [1]] * [1.0, 0.0, 0.0], face.mesh.triangles))
    for changed in (wide, bent):
        tissue = flesh(changed)
        tissue.solid.reject_bad()
        assert tissue.solid.mesh.quality.min() > 0.5 * LEAST_QUALITY
        np.testing.assert_allclose(tissue.solid.skin.apply(tissue.solid.mesh.points), changed.mesh.points, atol=1e-9)


def test_prisms_that_stay_unsound_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without time to mend them, the bad prisms are missing, the rest is sound and still carries all the skin."""
    face, usual = head("coarse")
    monkeypatch.setattr("faceanim.face.columns._ATTEMPTS", 1)
    monkeypatch.setattr("faceanim.face.tissue_volume.load_arrays", lambda *_: None)
    monkeypatch.setattr("faceanim.face.tissue_volume.save_arrays", lambda *_, **__: None)
    tissue = flesh(face)
    tissue.solid.reject_bad()
    assert tissue.solid.mesh.quality.min() >= LEAST_QUALITY
    assert 0.7 * len(usual.solid.mesh.tets) < len(tissue.solid.mesh.tets) < len(usual.solid.mesh.tets)
    np.testing.assert_allclose(tissue.solid.skin.apply(tissue.solid.mesh.points), face.mesh.points, atol=1e-9)


def test_the_body_has_flesh_when_asked() -> None:
    """A body grows its volume when it is first asked for; it is damped as flesh is, apart from the body's surface."""
    face, tissue = head("coarse")
    solid = face.body().solid
    assert solid is not None
    assert (solid.damping, solid.stiffness_damping) == (face.tissue.solid.damping, face.tissue.solid.stiffness_damping)
    np.testing.assert_array_equal(solid.mesh.tets, tissue.solid.mesh.tets)


def test_the_flesh_is_kept_on_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second time nothing is grown, and the arrays are the same; another head is grown anew."""
    face, tissue = head("coarse")

    def never(*_: object) -> None:
        raise AssertionError("grown again")

    monkeypatch.setattr("faceanim.face.tissue_volume._grown", never)
    again = flesh(face)
    np.testing.assert_array_equal(again.solid.mesh.points, tissue.solid.mesh.points)
    np.testing.assert_array_equal(again.solid.skin.weight, tissue.solid.skin.weight)
    x = face.mesh.points.copy()
    x[0] += 1e-6
    with pytest.raises(AssertionError, match="grown again"):
        flesh(replace(face, mesh=type(face.mesh)(x, face.mesh.triangles)))


def test_constants_are_checked() -> None:
    """Layers come from tissue.toml; what is missing or out of range is named."""
    text = asset_text("tissue.toml")
    materials = parse_tissue(text, "t").materials()
    assert [m.name for m in materials] == ["skin", "fat", "muscle", "gap"]
    for m, (low, high) in zip(materials[:3], ((10, 60), (1, 5), (5, 20)), strict=True):
        assert low <= m.young_modulus <= high and 0.4 <= m.poisson_ratio < 0.5 and m.density == 1.04e-6
    with pytest.raises(AssetError, match=r"t: .*solid.fat"):
        parse_tissue(text.replace("[solid.fat]\nyoung_modulus", "[solid.fat]\nstiffness"), "t")
    wrong = parse_tissue(text.replace("poisson_ratio = 0.45", "poisson_ratio = 0.5"), "t")
    with pytest.raises(UserError, match=r"material 'skin': poisson_ratio = 0\.5"):
        wrong.materials()


def test_no_edge_of_the_flesh_crosses_the_mouth() -> None:
    """No element reaches from the upper to the lower lip between the corners: columns there are of one side only."""
    face, tissue = head("default")
    column = np.unique(edges_of(tissue.solid.mesh) // (_layers(tissue) + 1), axis=0)
    side, x = face.mouth_side[tissue.vertex], face.mesh.points[tissue.vertex]
    corner = face.mesh.points[face.landmarks["cheilion_left"]]
    lip = face.region[tissue.vertex] == LIP
    crossing = column[(side[column[:, 0]] != side[column[:, 1]]) & lip[column].all(axis=1)]
    assert np.abs(x[crossing, 0]).min(initial=np.inf) > corner[0] - 6.0


def edges_of(mesh: TetMesh) -> np.ndarray:
    return edges(np.concatenate([mesh.tets[:, :3], mesh.tets[:, 1:], mesh.tets[:, [0, 1, 3]]]))
