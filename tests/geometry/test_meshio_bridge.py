"""Laws of volume files: what is written is read back, what is broken is refused with a way out."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

from faceanim.geometry.meshio_bridge import WRITABLE, read_volume, write_volume
from faceanim.geometry.shapes import box_tets
from faceanim.geometry.volume import TetMesh
from faceanim.ground.errors import RunError, UserError

BOX = box_tets((2, 1, 1), (2.0, 1.0, 3.0))
TET = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def save(path: Path, points: object, cells: list[tuple[str, object]], **data: object) -> Path:
    """Write a file through meshio alone; return its path."""
    meshio.Mesh(np.asarray(points, dtype=float), [(k, np.asarray(c)) for k, c in cells], **data).write(path)
    return path


@pytest.mark.parametrize("ending", WRITABLE)
def test_what_is_written_is_read_back(tmp_path: Path, ending: str) -> None:
    """Every format keeps points and elements to the last bit that it stores."""
    path = tmp_path / f"box{ending}"
    write_volume(path, BOX)
    mesh, report = read_volume(path)
    np.testing.assert_allclose(mesh.points, BOX.points, atol=1e-12)
    np.testing.assert_array_equal(mesh.tets, BOX.tets)
    assert (report.flipped, report.loose, report.split, report.parts, report.notes) == (0, 0, 0, 1, [])
    assert report.cells == {"tetra": len(BOX.tets)}


@pytest.mark.parametrize("ending", [".vtu", ".vtk", ".msh"])
def test_data_travel_with_the_mesh(tmp_path: Path, ending: str) -> None:
    """Cell data called region come back as the region; point data are in the file."""
    path, region = tmp_path / f"box{ending}", np.arange(len(BOX.tets)) % 3
    u = np.random.default_rng(0).normal(size=BOX.points.shape)
    write_volume(path, BOX, {"displacement": u}, {"region": region})
    np.testing.assert_array_equal(read_volume(path)[1].region, region)
    np.testing.assert_allclose(meshio.read(path).point_data["displacement"], u)


def test_physical_groups_of_gmsh_are_regions(tmp_path: Path) -> None:
    """gmsh:physical names the region when there is no data called region."""
    tags = {n: [np.array([7, 9], np.int32)] for n in ("gmsh:physical", "gmsh:geometrical")}
    points = np.concatenate([TET, [[1.0, 1.0, 1.0]]])
    path = tmp_path / "two.msh"
    mesh = meshio.Mesh(points, [("tetra", np.array([[0, 1, 2, 3], [1, 4, 2, 3]]))], cell_data=tags)
    mesh.write(path, file_format="gmsh22", binary=False)
    report = read_volume(path)[1]
    assert report.region is not None and report.region.tolist() == [7, 9]


def test_cells_of_second_order_keep_their_corners(tmp_path: Path) -> None:
    """A tetra10 becomes the tetrahedron of its corners; its mid-side points are left out and reported."""
    pairs = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
    points = np.concatenate([TET, [0.5 * (TET[a] + TET[b]) for a, b in pairs]])
    mesh, report = read_volume(save(tmp_path / "q.vtu", points, [("tetra10", [list(range(10))])]))
    np.testing.assert_array_equal(mesh.points, TET)
    assert report.loose == 6 and "6 points" in report.notes[0]


@pytest.mark.parametrize("seed", range(4))
def test_other_cells_are_split_without_gap_or_overlap(tmp_path: Path, seed: int) -> None:
    """Two hexahedra, a wedge and a pyramid that share faces fill the same space however their points are numbered."""
    points = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1, 2)], dtype=float)
    points = np.concatenate([points, [[0.5, 2.0, 0.0], [0.5, 2.0, 1.0], [0.5, 0.5, 2.0]]])
    hexes = [[0, 1, 4, 3, 6, 7, 10, 9], [1, 2, 5, 4, 7, 8, 11, 10]]
    wedge, pyramid = [[3, 4, 12, 9, 10, 13]], [[6, 7, 10, 9, 14]]
    order = np.random.default_rng(seed).permutation(len(points))
    back = np.argsort(order)
    cells = [("hexahedron", back[hexes]), ("wedge", back[wedge]), ("pyramid", back[pyramid])]
    mesh, report = read_volume(save(tmp_path / "mixed.vtu", points[order], cells))
    assert mesh.volumes.min() > 0 and report.split == 4 and report.flipped == 0
    np.testing.assert_allclose(mesh.volumes.sum(), 2.0 + 0.5 + 1.0 / 3.0)
    # neighbours fit when the boundary is closed and encloses just that volume
    np.testing.assert_allclose(mesh.boundary.areas.sum(), 8.0 + 2 * 0.5 + 2 * np.sqrt(1.25) + 4 * 0.5 * np.sqrt(1.25))
    assert report.parts == 1


def test_inverted_elements_are_turned_and_loose_points_left_out(tmp_path: Path) -> None:
    """Both are repaired, and the report says how often."""
    points = np.concatenate([[[9.0, 9.0, 9.0]], TET])
    mesh, report = read_volume(save(tmp_path / "a.vtu", points, [("tetra", [[1, 3, 2, 4]])]))
    assert mesh.volumes[0] > 0 and len(mesh.points) == 4
    assert (report.flipped, report.loose) == (1, 1) and len(report.notes) == 2


def test_parts_and_what_is_left_out_are_reported(tmp_path: Path) -> None:
    """Two tetrahedra apart are two parts; triangles beside them are not part of the volume."""
    points = np.concatenate([TET, TET + 5.0])
    cells = [("tetra", [[0, 1, 2, 3], [4, 5, 6, 7]]), ("triangle", [[0, 1, 2]])]
    report = read_volume(save(tmp_path / "two.vtu", points, cells))[1]
    assert report.parts == 2
    assert report.notes == ["left out: 1 triangle", "the volume falls into 2 parts that do not hang together"]


def test_missing_too_large_and_unknown_files_are_refused(tmp_path: Path) -> None:
    """The path and the way out are in the message; nothing is read."""
    with pytest.raises(UserError, match=r"no\.vtu cannot be read: No such file"):
        read_volume(tmp_path / "no.vtu")
    (tmp_path / "dir.vtu").mkdir()
    with pytest.raises(UserError, match="is no file"):
        read_volume(tmp_path / "dir.vtu")
    write_volume(tmp_path / "box.vtu", BOX)
    with pytest.raises(UserError, match="at most 0 MB are read"):
        read_volume(tmp_path / "box.vtu", largest=100)
    (tmp_path / "box.pkl").write_bytes(b"x")
    with pytest.raises(UserError, match=r"'.pkl'; known: .msh"):
        read_volume(tmp_path / "box.pkl")


@pytest.mark.parametrize("ending", WRITABLE)
@pytest.mark.parametrize("keep", [0.0, 0.2, 0.6])
def test_truncated_files_are_refused(tmp_path: Path, ending: str, keep: float, capfd: pytest.CaptureFixture) -> None:
    """A file cut off is refused by name, whatever meshio does about it; nothing is printed."""
    path = tmp_path / f"box{ending}"
    write_volume(path, BOX)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(UserError, match=rf"box\{ending}"):
        read_volume(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("ending", [".msh", ".vtu", ".vtk", ".mesh", ".inp"])
def test_files_of_another_kind_are_refused(tmp_path: Path, ending: str, capfd: pytest.CaptureFixture) -> None:
    """Text and bytes that are no mesh end in a message, not in an exit."""
    for content in (b"hello\n" * 5, bytes(range(256)) * 4):
        path = tmp_path / f"junk{ending}"
        path.write_bytes(content)
        with pytest.raises(UserError, match="junk"):
            read_volume(path)
    assert capfd.readouterr() == ("", "")


def test_meshes_without_volume_are_refused(tmp_path: Path) -> None:
    """A surface is told apart from an empty file."""
    with pytest.raises(UserError, match="holds only triangles: a volume needs tetrahedra"):
        read_volume(save(tmp_path / "s.vtu", TET, [("triangle", [[0, 1, 2]])]))
    with pytest.raises(UserError, match="holds 1 line, 1 triangle"):
        read_volume(save(tmp_path / "l.vtu", TET, [("line", [[0, 1]]), ("triangle", [[0, 1, 2]])]))


def test_bad_numbers_are_refused(tmp_path: Path) -> None:
    """Points that are not finite, corners that are no points, flat elements and broken regions are named."""
    points = TET.copy()
    points[2, 1] = np.nan
    with pytest.raises(UserError, match="point 2 holds a number that is not finite"):
        read_volume(save(tmp_path / "nan.vtu", points, [("tetra", [[0, 1, 2, 3]])]))
    for corner in (4, -1):
        with pytest.raises(UserError, match=rf"\[0, 1, 2, {corner}\] outside 0..3"):
            read_volume(save(tmp_path / "index.vtu", TET, [("tetra", [[0, 1, 2, corner]])]))
    with pytest.raises(UserError, match="1 of 1 elements are flat, the first is 0"):
        read_volume(save(tmp_path / "flat.vtu", TET * [1.0, 1.0, 0.0], [("tetra", [[0, 1, 2, 3]])]))
    with pytest.raises(UserError, match="1 of 1 elements are flat"):
        read_volume(save(tmp_path / "double.vtu", TET, [("tetra", [[0, 1, 2, 2]])]))
    data = {"region": [np.array([0.5])]}
    with pytest.raises(UserError, match="whole numbers"):
        read_volume(save(tmp_path / "r.vtu", TET, [("tetra", [[0, 1, 2, 3]])], cell_data=data))
    data = {"region": [np.zeros((1, 2))]}
    with pytest.raises(UserError, match="one number per cell"):
        read_volume(save(tmp_path / "r2.vtu", TET, [("tetra", [[0, 1, 2, 3]])], cell_data=data))


def test_flat_drawings_are_refused(tmp_path: Path) -> None:
    """Points of two coordinates are no volume."""
    path = tmp_path / "flat.mesh"
    path.write_text(
        "MeshVersionFormatted 2\nDimension 2\nVertices\n3\n0 0 1\n1 0 1\n0 1 1\nTriangles\n1\n1 2 3 1\nEnd\n"
    )
    with pytest.raises(UserError, match=r"flat\.mesh"):
        read_volume(path)


def test_data_that_do_not_fit_are_not_written(tmp_path: Path) -> None:
    """Rows must match points and elements; the ending must be known; a folder must exist."""
    with pytest.raises(UserError, match="cell data 'region' has shape"):
        write_volume(tmp_path / "a.vtu", BOX, cell_data={"region": np.zeros(3)})
    with pytest.raises(UserError, match="point data 'u' has shape"):
        write_volume(tmp_path / "a.vtu", BOX, {"u": 1.0})
    with pytest.raises(UserError, match=r"written as \.vtu, \.msh"):
        write_volume(tmp_path / "a.stl", BOX)
    with pytest.raises(RunError, match="cannot be written"):
        write_volume(tmp_path / "none" / "a.vtu", BOX)


def test_a_single_element_survives(tmp_path: Path) -> None:
    """The smallest volume there is."""
    write_volume(tmp_path / "t.vtu", TetMesh(TET, [[0, 1, 2, 3]]))
    assert read_volume(tmp_path / "t.vtu")[0].volumes == pytest.approx([1.0 / 6.0])
