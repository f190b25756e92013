"""Pictures to files: numbered PNG sequences, films, contact sheets. Nothing half-written ever bears its final name."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import cv2
import numpy as np

from faceanim.ground.errors import RunError, UserError
from faceanim.ground.files import not_written, write_whole
from faceanim.render.overlay import text_scale, text_size, write_text
from faceanim.render.shading import Bytes

_FRAME = re.compile(r"frame_\d{5,}\.png")


def _picture(value: Any) -> Bytes:
    picture = np.ascontiguousarray(value)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise UserError(f"a picture must be (h, w, 3) bytes; this one is {picture.shape} of {picture.dtype}")
    return picture


def _probe(folder: Path) -> None:
    """Make `folder` and try to write into it; raise `UserError` if that cannot be done."""
    probe = folder / f".faceanim-{os.getpid()}.part"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise UserError(
            f"folder {folder} cannot be written ({error.strerror}); choose another folder or change its permissions"
        ) from error


def write_png(path: str | Path, picture: Any) -> None:
    """Write `picture` (h, w, 3) RGB bytes as a PNG file: to a temporary name first, renamed when complete.

    Raises `UserError` for a path that is no .png file or lies in a folder that cannot be written, `RunError` if
    writing fails.
    """
    target = Path(path)
    if target.suffix.lower() != ".png":
        raise UserError(f"{target} does not end in .png, the format that is written")
    _probe(target.parent)
    _write_png(target, _picture(picture))


def _write_png(target: Path, picture: Bytes) -> None:
    done, data = cv2.imencode(".png", picture[:, :, ::-1])
    if not done:
        raise RunError(f"{target} could not be encoded as PNG")
    write_whole(target, data.tobytes())


class FrameWriter(Protocol):
    """Takes the pictures of a sequence one after the other."""

    def write(self, picture: Any) -> None:
        """Add one picture, (h, w, 3) RGB bytes."""

    def close(self) -> None:
        """Finish; calling it twice does no harm."""

    def abandon(self) -> None:
        """Stop without leaving a file that looks whole."""


class _Context:
    """`with` finishes the file, or drops it if an exception passes through."""

    def __enter__(self) -> Any:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()

    def close(self) -> None:
        """Finish."""

    def abandon(self) -> None:
        """Stop without leaving a file that looks whole."""


class PngSequence(_Context):
    """Writes frame_00000.png, frame_00001.png, ... into a folder, which is made if it is missing.

    A folder that already holds such frames is refused, unless `overwrite`: then its old frames are removed first.
    Raises `UserError` for that, and for a folder that cannot be written; `RunError` if writing fails later on.
    """

    def __init__(self, folder: str | Path, *, overwrite: bool = False, first: int = 0) -> None:
        self.folder, self.count, self._next = Path(folder), 0, first
        if self.folder.exists() and not self.folder.is_dir():
            raise UserError(f"{self.folder} is a file; name a folder for the frames")
        _probe(self.folder)
        old = [path for path in self.folder.iterdir() if _FRAME.fullmatch(path.name)]
        if old and not overwrite:
            raise UserError(
                f"folder {self.folder} already holds {len(old)} frames; choose another folder, or ask to overwrite them"
            )
        for path in old:
            path.unlink()

    def write(self, picture: Any) -> Path:
        """Write the next picture (h, w, 3) RGB bytes and return its path."""
        path = self.folder / f"frame_{self._next:05d}.png"
        _write_png(path, _picture(picture))
        self._next += 1
        self.count += 1
        return path


def have_h264() -> bool:
    """Whether films can be written as H.264 (the optional package `av`)."""
    return find_spec("av") is not None


class Film(_Context):
    """Writes an MP4 film: H.264 if the optional package `av` is there (unless `codec` says otherwise), else MPEG-4.

    path : ends in .mp4   rate : frames per second   codec : "auto", "h264" or "mpeg4"
    H.264 needs even sides: an odd last row or column is dropped. The file gets its name when the film is closed.
    Raises `UserError` for a wrong path, rate, codec or picture size, `RunError` if writing fails.
    """

    def __init__(self, path: str | Path, rate: float, *, codec: str = "auto", overwrite: bool = False) -> None:
        self.path, self.rate, self.count = Path(path), float(rate), 0
        if self.path.suffix.lower() != ".mp4":
            raise UserError(f"{self.path} does not end in .mp4, the film format that is written")
        if not 0.1 <= self.rate <= 1000.0:
            raise UserError(f"the film rate is {rate}; it must lie between 0.1 and 1000 frames per second")
        if codec not in ("auto", "h264", "mpeg4"):
            raise UserError(f"unknown codec {codec!r}; known: auto, h264, mpeg4")
        if codec == "h264" and not have_h264():
            raise UserError("codec h264 needs the package `av`: pip install 'faceanim[video]', or use codec mpeg4")
        if self.path.exists() and not overwrite:
            raise UserError(f"film {self.path} exists already; choose another name, or ask to overwrite it")
        _probe(self.path.parent)
        self.codec = ("h264" if have_h264() else "mpeg4") if codec == "auto" else codec
        self._part = self.path.with_name(f".{self.path.stem}.part.mp4")
        self._size: tuple[int, int] | None = None
        self._coder: _H264 | _Mpeg4 | None = None

    def write(self, picture: Any) -> None:
        """Add one picture (h, w, 3) RGB bytes; all must be of one size."""
        image = _picture(picture)
        size = (image.shape[1], image.shape[0])
        if self._size is None:
            self._size = size
            self._guarded(self._start, size)
        if size != self._size:
            raise UserError(f"frame {self.count} is {size[0]} x {size[1]} pixels; the film is {self._size}")
        assert self._coder is not None
        self._guarded(self._coder.write, image)
        self.count += 1

    def _start(self, size: tuple[int, int]) -> None:
        self._coder = (_H264 if self.codec == "h264" else _Mpeg4)(self._part, size, self.rate)

    def _guarded(self, action: Any, *arguments: Any) -> None:
        """Run one step of the encoder; its libraries raise exceptions of many kinds when the disk is full."""
        try:
            action(*arguments)
        except Exception as error:
            self.abandon()
            reason = getattr(error, "strerror", None) or str(error)
            raise RunError(
                f"film {self.path} could not be written: {reason}; free some space or choose another folder"
            ) from error

    def close(self) -> None:
        """Finish the film and give the file its name."""
        if self._coder is None:
            return
        coder, self._coder = self._coder, None
        self._guarded(coder.close)
        if not _whole(self._part, self.count):
            self.abandon()
            raise RunError(f"film {self.path} could not be written completely; is the disk full?")
        try:
            self._part.replace(self.path)
        except OSError as error:
            raise not_written(self.path, error) from error

    def abandon(self) -> None:
        """Drop what was written."""
        coder, self._coder = self._coder, None
        if coder is not None:
            with suppress(Exception):
                coder.close()
        with suppress(OSError):
            self._part.unlink()


def _whole(path: Path, count: int) -> bool:
    """Whether a film file can be opened, holds `count` pictures and its first one can be read."""
    if not path.is_file() or path.stat().st_size == 0:
        return False
    reader = cv2.VideoCapture(str(path))
    try:
        return bool(reader.isOpened()) and int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) == count and bool(reader.read()[0])
    finally:
        reader.release()


class _Mpeg4:
    """MPEG-4 part 2 through OpenCV."""

    def __init__(self, path: Path, size: tuple[int, int], rate: float) -> None:
        self._writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
        if not self._writer.isOpened():
            raise RunError(f"OpenCV could not start the film {path.name} ({size[0]} x {size[1]} pixels)")

    def write(self, picture: Bytes) -> None:
        self._writer.write(np.ascontiguousarray(picture[:, :, ::-1]))

    def close(self) -> None:
        self._writer.release()


class _H264:
    """H.264 through PyAV."""

    def __init__(self, path: Path, size: tuple[int, int], rate: float) -> None:
        from fractions import Fraction

        import av

        self._av = av
        self._container = av.open(str(path), mode="w")
        self._stream = self._container.add_stream("libx264", rate=Fraction(rate).limit_denominator(1001))
        self._stream.width, self._stream.height = size[0] & ~1, size[1] & ~1
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "16", "preset": "medium"}

    def write(self, picture: Bytes) -> None:
        even = np.ascontiguousarray(picture[: picture.shape[0] & ~1, : picture.shape[1] & ~1])
        frame = self._av.VideoFrame.from_ndarray(even, format="rgb24")
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        self._container.mux(self._stream.encode())
        self._container.close()


def side_by_side(pictures: Sequence[Any]) -> Bytes:
    """Return pictures of one height next to each other, (h, sum of widths, 3)."""
    images = [_picture(p) for p in pictures]
    if not images or any(p.shape[0] != images[0].shape[0] for p in images):
        raise UserError("pictures side by side must be at least one, all of the same height")
    return np.concatenate(images, axis=1)


def contact_sheet(
    rows: Sequence[Sequence[Any]],
    *,
    row_labels: Sequence[str] = (),
    column_labels: Sequence[str] = (),
    title: str = "",
    gap: int = 4,
) -> Bytes:
    """Return one picture of many: `rows` of pictures of one size (say views by times), labelled.

    Returns (h, w, 3) RGB bytes. Raises `UserError` if sizes or counts do not fit.
    """
    images = [[_picture(p) for p in row] for row in rows]
    if not images or not images[0] or any(len(row) != len(images[0]) for row in images):
        raise UserError("a contact sheet needs at least one row of pictures, all rows of the same length")
    shape = images[0][0].shape
    if any(p.shape != shape for row in images for p in row):
        raise UserError("all pictures of a contact sheet must have the same size")
    if (row_labels and len(row_labels) != len(images)) or (column_labels and len(column_labels) != len(images[0])):
        raise UserError("a contact sheet needs one label for each row and each column, or none")
    height, width = shape[0], shape[1]
    scale = max(0.4, text_scale(height))
    line = 2 * text_size("Mg", scale)[1] + 6
    left = max((text_size(label, scale)[0] for label in row_labels), default=0) + (12 if row_labels else 0)
    top = (int(1.6 * line) if title else 0) + (line if column_labels else 0)
    sheet = np.full((top + len(images) * (height + gap), left + len(images[0]) * (width + gap) - gap, 3), 255, np.uint8)
    if title:
        write_text(sheet, title, 6, line, scale=1.3 * scale, halo=False)
    for j, label in enumerate(column_labels):
        x = left + j * (width + gap) + (width - text_size(label, scale)[0]) // 2
        write_text(sheet, label, x, top - line // 4, scale=scale, halo=False)
    for i, row in enumerate(images):
        y = top + i * (height + gap)
        if row_labels:
            write_text(sheet, row_labels[i], 6, y + height // 2, scale=scale, halo=False)
        for j, picture in enumerate(row):
            x = left + j * (width + gap)
            sheet[y : y + height, x : x + width] = picture
    return sheet


def write_all(writer: Any, pictures: Iterable[Any]) -> int:
    """Send every picture to a `PngSequence` or `Film`, finish it, and return how many there were."""
    count = 0
    with writer:
        for picture in pictures:
            writer.write(picture)
            count += 1
    return count
