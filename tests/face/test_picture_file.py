"""Pictures from users: what is read, and what is refused before it is decoded."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from faceanim.face.picture_file import read_picture
from faceanim.ground.errors import AssetError

RNG = np.random.default_rng(1)
PICTURE = RNG.integers(0, 255, (96, 128, 3), dtype=np.uint8)


def _encoded(picture: np.ndarray, suffix: str = ".png") -> bytes:
    done, data = cv2.imencode(suffix, picture)
    assert done
    return data.tobytes()


def _png_of(width: int, height: int) -> bytes:
    """Return the beginning of a PNG file that says it is so large."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = struct.pack(">I", 1000) + b"IDAT" + bytes(64)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head)) + data


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".jpg"])
def test_pictures_are_read_as_rgb(tmp_path: Path, suffix: str) -> None:
    """From files and from bytes, in the right order of channels."""
    data = _encoded(PICTURE[:, :, ::-1], suffix)
    (tmp_path / f"picture{suffix}").write_bytes(data)
    for source in (data, tmp_path / f"picture{suffix}"):
        picture = read_picture(source)
        assert picture.shape == PICTURE.shape and picture.dtype == np.uint8
        if suffix != ".jpg":
            np.testing.assert_array_equal(picture, PICTURE)


BAD = {
    "empty": (b"", "empty"),
    "text": (b"this is no picture, whatever its name says", "no picture"),
    "grey": (_encoded(PICTURE[:, :, 0]), "three channels"),
    "deep": (_encoded(PICTURE.astype(np.uint16) * 256), "16"),
    "deep grey": (_encoded(PICTURE[:, :, 0].astype(np.uint16)), "16"),
    "alpha": (_encoded(np.dstack([PICTURE, PICTURE[:, :, :1]])), "alpha"),
    "cut short": (_encoded(PICTURE)[:9000], "damaged"),
    "JPEG cut short": (_encoded(PICTURE, ".jpg")[:2000], "damaged"),
    "huge": (_png_of(20_000, 20_000), "at most"),
    "wide": (_png_of(9_000, 100), "at most"),
    "tiny": (_encoded(PICTURE[:10, :10]), "at least"),
    "garbled": (_encoded(PICTURE)[:60] + bytes(2000), "damaged"),
}


@pytest.mark.parametrize("name", BAD)
def test_other_files_are_refused_with_the_way_out(tmp_path: Path, name: str) -> None:
    """One clear sentence that names the file, from files and from bytes."""
    data, word = BAD[name]
    path = tmp_path / "picture.png"
    path.write_bytes(data)
    for source in (data, path):
        with pytest.raises(AssetError, match=word) as caught:
            read_picture(source)
        assert ("the picture" if isinstance(source, bytes) else str(path)) in str(caught.value)


def test_missing_files_and_folders_are_refused(tmp_path: Path) -> None:
    """As what they are."""
    for path in (tmp_path / "none.png", tmp_path):
        with pytest.raises(AssetError, match="cannot be read"):
            read_picture(path)
