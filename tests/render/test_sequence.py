"""Laws of the files: what is written reads back, and what failed leaves nothing that looks whole."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from faceanim.ground.errors import RunError, UserError
from faceanim.render import sequence
from faceanim.render.sequence import Film, PngSequence, contact_sheet, side_by_side, write_all, write_png


def gradient(step: int = 0, width: int = 64, height: int = 48) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 3 + step, y * 4, 0 * x + 40 + 3 * step], axis=2).astype(np.uint8)


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return image[:, :, ::-1]


def full_disk(*_: Any, **__: Any) -> Any:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_png_sequence_round_trip(tmp_path: Path) -> None:
    """Frames are numbered from 0 and read back byte for byte in RGB order; no other file is left."""
    pictures = [gradient(k) for k in range(3)]
    assert write_all(PngSequence(tmp_path / "new" / "frames"), pictures) == 3
    names = sorted(p.name for p in (tmp_path / "new" / "frames").iterdir())
    assert names == ["frame_00000.png", "frame_00001.png", "frame_00002.png"]
    for name, picture in zip(names, pictures, strict=True):
        np.testing.assert_array_equal(read(tmp_path / "new" / "frames" / name), picture)


def test_folder_with_frames_is_refused_unless_overwritten(tmp_path: Path) -> None:
    """Old frames are kept and the request refused; with overwrite they go, other files stay."""
    write_all(PngSequence(tmp_path), [gradient(), gradient(1)])
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="already holds 2 frames"):
        PngSequence(tmp_path)
    write_all(PngSequence(tmp_path, overwrite=True), [gradient(2)])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["frame_00000.png", "notes.txt"]


def test_folder_that_cannot_be_made(tmp_path: Path) -> None:
    """A folder below a file, or a file in its place, is a mistake in the request and named in the message."""
    (tmp_path / "file").write_text("x")
    for folder in (tmp_path / "file", tmp_path / "file" / "frames"):
        with pytest.raises(UserError, match="file") as caught:
            PngSequence(folder)
        assert str(folder) in str(caught.value)
    with pytest.raises(UserError, match=r"\.png"):
        write_png(tmp_path / "picture.jpg", gradient())


def test_full_disk_leaves_no_half_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When writing fails, the error is a `RunError`, earlier frames stay, and no part of the frame is left."""
    writer = PngSequence(tmp_path)
    writer.write(gradient())
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full_disk)
        with pytest.raises(RunError, match="No space left"):
            writer.write(gradient(1))
    assert [p.name for p in tmp_path.iterdir()] == ["frame_00000.png"]
    assert writer.write(gradient(1)).name == "frame_00001.png"


def film_frames(path: Path) -> list[np.ndarray]:
    reader, frames = cv2.VideoCapture(str(path)), []
    while True:
        more, frame = reader.read()
        if not more:
            return frames
        frames.append(frame[:, :, ::-1])


@pytest.mark.parametrize("codec", ["mpeg4", "h264"])
def test_film_round_trip(tmp_path: Path, codec: str) -> None:
    """A film holds every frame, in order, at its rate, close to the pictures given."""
    if codec == "h264":
        pytest.importorskip("av")
    pictures = [gradient(9 * k) for k in range(8)]
    write_all(Film(tmp_path / "film.mp4", 30.0, codec=codec), pictures)
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]
    frames = film_frames(tmp_path / "film.mp4")
    assert len(frames) == 8
    assert cv2.VideoCapture(str(tmp_path / "film.mp4")).get(cv2.CAP_PROP_FPS) == pytest.approx(30.0)
    for frame, picture in zip(frames, pictures, strict=True):
        assert np.abs(frame.astype(int) - picture).mean() < 6.0


def test_film_that_fails_is_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An exception while frames are made, or a file that ends up incomplete, leaves no film and no remnant."""

    def broken() -> Any:
        yield gradient()
        raise ValueError("no more")

    with pytest.raises(ValueError, match="no more"):
        write_all(Film(tmp_path / "film.mp4", 25.0, codec="mpeg4"), broken())
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(sequence, "_whole", lambda *_: False)
    with pytest.raises(RunError, match="disk full"):
        write_all(Film(tmp_path / "film.mp4", 25.0, codec="mpeg4"), [gradient()])
    assert not list(tmp_path.iterdir())


def test_film_refuses_what_it_cannot_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wrong ending, rate, codec, size or an existing film: `UserError`, and the old film stays."""
    for wrong in ({"path": tmp_path / "film.avi", "rate": 30}, {"path": tmp_path / "film.mp4", "rate": 0}):
        with pytest.raises(UserError):
            Film(**wrong)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="codec"):
        Film(tmp_path / "film.mp4", 30, codec="theora")
    monkeypatch.setattr(sequence, "have_h264", lambda: False)
    with pytest.raises(UserError, match="video"):
        Film(tmp_path / "film.mp4", 30, codec="h264")
    with pytest.raises(UserError, match="64"), Film(tmp_path / "film.mp4", 30) as film:
        film.write(gradient())
        film.write(gradient(width=32))
    (tmp_path / "old.mp4").write_bytes(b"old")
    with pytest.raises(UserError, match="exists already"):
        Film(tmp_path / "old.mp4", 30)
    assert (tmp_path / "old.mp4").read_bytes() == b"old"


def test_contact_sheet_holds_every_picture(tmp_path: Path) -> None:
    """Each picture appears unchanged in its place; labels only add borders."""
    rows = [[gradient(8 * i + j) for j in range(3)] for i in range(2)]
    bare = contact_sheet(rows, gap=4)
    assert bare.shape == (2 * 52, 3 * 64 + 2 * 4, 3)
    np.testing.assert_array_equal(bare[52:100, 68:132], rows[1][1])
    sheet = contact_sheet(rows, row_labels=["front", "side"], column_labels=["0 s", "1 s", "2 s"], title="smile", gap=4)
    np.testing.assert_array_equal(sheet[-52:-4, -64:], rows[1][2])
    assert (sheet[: sheet.shape[0] - 104] < 200).any(), "the title is drawn"
    write_png(tmp_path / "sheet.png", sheet)
    np.testing.assert_array_equal(read(tmp_path / "sheet.png"), sheet)
    with pytest.raises(UserError, match="same length"):
        contact_sheet([rows[0], rows[1][:2]])
    with pytest.raises(UserError, match="one label"):
        contact_sheet(rows, row_labels=["front"])


def test_pictures_side_by_side() -> None:
    """Pictures of one height are joined from left to right; others are refused."""
    np.testing.assert_array_equal(side_by_side([gradient(), gradient(5)])[:, 64:], gradient(5))
    with pytest.raises(UserError):
        side_by_side([gradient(), gradient(height=10)])
    with pytest.raises(UserError, match="bytes"):
        side_by_side([gradient().astype(float)])
