"""Around the page: who may connect, where it may listen, uploads, recordings, muscles as lines, clicks as muscles."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toys import toy_body, toy_face

from faceanim.backends.solver import StepReport
from faceanim.face.library import asset_text, load_face
from faceanim.face.muscle_places import Places
from faceanim.face.muscles import muscles_text, one_sided, parse_muscles
from faceanim.ground.errors import AssetError, UserError
from faceanim.studio.engine import STEP, Setup
from faceanim.studio.muscle_files import LARGEST_TEXT, read_upload
from faceanim.studio.muscle_shapes import MuscleLines
from faceanim.studio.placing import BONE, RING, SKIN, Placer
from faceanim.studio.recorder import Recorder
from faceanim.studio.simulation import Moment
from faceanim.studio.skin_layers import region_above, skin_layers

TABLE = parse_muscles(asset_text("muscles.toml"), "muscles.toml")
AHEAD = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def face() -> Any:
    """The built-in head, coarse."""
    return load_face(density="coarse")


@pytest.fixture(scope="module")
def placer(face: Any) -> Placer:
    """Takes clicks on that head."""
    return Placer(Places(face))


@pytest.mark.parametrize(
    ("origin", "own", "host", "let_in"),
    [
        (None, "127.0.0.1:8080", "127.0.0.1", True),
        ("http://127.0.0.1:8080", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://localhost:8080", "localhost:8080", "127.0.0.1", True),
        ("http://evil.example", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://evil.example:8080", "evil.example:8080", "127.0.0.1", False),
        ("http://127.0.0.1:9000", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://studio.lan:8080", "studio.lan:8080", "0.0.0.0", True),
    ],
)
def test_only_its_own_page_is_let_in(origin: str | None, own: str, host: str, let_in: bool) -> None:
    """A page from elsewhere, or one that only pretends to be local, cannot connect."""
    page = pytest.importorskip("faceanim.studio.page", reason="the extra 'studio' is not installed")
    headers = {"Host": own} | ({} if origin is None else {"Origin": origin})
    assert page.own_page(headers, host) is let_in


def test_a_port_in_use_names_one_that_is_free() -> None:
    """The message says which port to take instead."""
    page = pytest.importorskip("faceanim.studio.page", reason="the extra 'studio' is not installed")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(UserError, match=r"is in use; port \d+ is free"):
            page.check_place("127.0.0.1", taken.getsockname()[1])
    with pytest.raises(UserError, match="not an address of this machine"):
        page.check_place("no.such.host.invalid", 8080)


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("a.toml", b"", "holds no muscles"),
        ("a.toml", b"[x]\nkind = 'linear'\n", "origin"),
        ("a.toml", b"x" * (LARGEST_TEXT + 1), "at most"),
        ("a.png", b"text", "is not a picture"),
        ("<img src=x>.toml", b"\xff", "neither"),
    ],
)
def test_uploads_that_are_no_muscles_are_refused(face: Any, name: str, content: bytes, complaint: str) -> None:
    """One sentence says what is wrong; a name from outside is shown as plain text."""
    with pytest.raises(AssetError, match=complaint) as caught:
        read_upload(name, content, face)
    assert "<" not in str(caught.value)


def test_a_list_of_muscles_is_read(face: Any) -> None:
    """What the studio saves it reads again."""
    table, faults = read_upload("m.toml", muscles_text(one_sided(TABLE)).encode(), face)
    assert table == one_sided(TABLE) and not faults


def test_a_recording_leaves_frames_film_positions_and_record(tmp_path: Path) -> None:
    """Every moment that was seen is a frame; the next recording gets the next folder."""
    face, said = toy_face(), list[tuple[str, str]]()
    recorder = Recorder(face, tmp_path, lambda kind, text, share: said.append((kind, text)))
    folder = recorder.start(Setup(toy_body(), "toy"))
    for k in range(3):
        points = face.mesh.points + np.array([0.0, 0.0, 1.0 * k])
        recorder.add(Moment(k, points, np.eye(4), StepReport(), STEP))
    recorder.close()
    assert said[-1][0] == "done", said
    assert folder.name == "recording-001"
    assert {p.name for p in folder.iterdir()} == {
        "frame_00000.png", "frame_00001.png", "frame_00002.png", "points.npy", "recording.mp4", "run.json",
    }  # fmt: skip
    assert np.load(folder / "points.npy")[2] == pytest.approx(face.mesh.points + np.array([0.0, 0.0, 2.0]))
    assert recorder.start(Setup(toy_body(), "toy")).name == "recording-002"
    recorder.close()
    assert said[-1] == ("error", "nothing was recorded")


def test_lines_follow_skin_and_jaw(face: Any) -> None:
    """At rest a line begins at its origin; ends in the skin move with it, origins on the jaw with the jaw."""
    table = {n: m for n, m in one_sided(TABLE).items() if n in ("mentalis_left", "zygomaticus_major_left")}
    lines = MuscleLines(face, table)
    rest, still = face.mesh.points, np.eye(4)
    ends = lines.points(rest, still).reshape(-1, 3)
    for muscle in table.values():
        assert np.abs(ends - muscle.origin).sum(axis=1).min() < 1e-3  # type: ignore[union-attr]
    jaw = np.eye(4)
    jaw[1, 3] = -20.0
    moved = lines.points(rest + np.array([5.0, 0.0, 0.0]), jaw).reshape(-1, 3) - ends
    kinds = {tuple(np.round(row, 3)) for row in moved}
    assert kinds == {(0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (0.0, -20.0, 0.0)}


def test_clicks_on_skin_and_bone_make_a_muscle(placer: Placer) -> None:
    """First the skin, then the bone; the muscle is named and the next one can follow."""
    table: dict[str, Any] = {}
    placer.choose(SKIN)
    assert placer.click(np.array([30.0, -35.0, 400.0]), AHEAD, table) == {}
    assert placer.mode == BONE and placer.pending and len(placer.marks()[0]) == 1
    rows = placer.click(np.array([50.0, 0.0, 400.0]), AHEAD, table)
    ((name, muscle),) = rows.items()
    assert name.endswith("_left") and muscle.insertion[:2] == pytest.approx((30.0, -35.0))
    assert muscle.origin[:2] == pytest.approx((50.0, 0.0)) and not muscle.paired
    assert placer.mode == SKIN and not placer.pending


def test_clicks_beside_the_face_are_refused(placer: Placer) -> None:
    """A miss is named, and what was placed before stays."""
    placer.choose(SKIN)
    placer.click(np.array([30.0, -35.0, 400.0]), AHEAD, {})
    with pytest.raises(UserError, match="no bone"):
        placer.click(np.array([300.0, 0.0, 400.0]), AHEAD, {})
    assert placer.pending
    placer.drop()
    assert not placer.pending


def test_two_clicks_make_a_ring(placer: Placer) -> None:
    """The corner of the mouth and a place above the lip make the ring of the mouth."""
    placer.choose(RING)
    assert placer.click(np.array([30.0, -54.0, 400.0]), AHEAD, {}) == {}
    rows = placer.click(np.array([0.5, -38.0, 400.0]), AHEAD, {})
    assert rows and all(name.startswith("orbicularis_oris") for name in rows)


def test_layers_are_means_of_skin(face: Any) -> None:
    """Each point of a coloured layer moves as the mean of the skin it lies on."""
    layers = skin_layers(face)
    assert {"lining", "red", "hair"} <= {layer.name.split("_")[0] for layer in layers}
    for layer in layers:
        assert np.asarray(layer.weights.sum(axis=1)).ravel() == pytest.approx(1.0)
        way = layer.points(face.mesh.points + np.array([1.0, 2.0, 3.0])) - layer.points(face.mesh.points)
        assert np.allclose(way, [1.0, 2.0, 3.0], atol=1e-4)


def test_a_cut_follows_the_level() -> None:
    """Of a square with a slope the part above half is half of it."""
    from scipy import sparse

    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    triangles = np.array([[0, 1, 2], [1, 3, 2]], dtype=np.int32)
    weights, part = region_above(sparse.identity(4, format="csr"), triangles, points[:, 0], 0.5)
    corner = (weights @ points)[part]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    assert area == pytest.approx(0.5)
