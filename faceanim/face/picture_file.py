"""Pictures from users' files: size and format are checked before anything is decoded."""

from __future__ import annotations

import warnings
from io import BytesIO
from pathlib import Path

import numpy as np

from faceanim.ground.errors import AssetError

FORMATS = ("PNG", "JPEG", "BMP")
LARGEST_SIDE, SMALLEST_SIDE = 4096, 64
"""Sides of a picture that is read [pixel]."""
LARGEST_FILE = 64 * 2**20
"""Bytes of a file that is read."""
_PNG, _PNG_DEPTH = b"\x89PNG\r\n\x1a\n", 24
"""How a PNG file begins, and the byte that holds its bits per channel."""


def read_picture(source: str | Path | bytes) -> np.ndarray:
    """Return a picture (h, w, 3) RGB bytes from a PNG, JPEG or BMP file, or from the bytes of one.

    Raises `AssetError` for a file that is missing, empty, truncated, no picture, larger or smaller than is read, or not
    in three channels of 8 bits.
    """
    name = "the picture" if isinstance(source, bytes) else str(source)
    return _decoded(_data(source, name), name)


def _data(source: str | Path | bytes, name: str) -> bytes:
    if isinstance(source, bytes):
        data = source[: LARGEST_FILE + 1]
    else:
        try:
            with Path(source).open("rb") as file:
                data = file.read(LARGEST_FILE + 1)
        except OSError as error:
            raise AssetError(f"{name} cannot be read: {error.strerror or error}") from error
    if not data:
        raise AssetError(f"{name} is empty; save the picture again")
    if len(data) > LARGEST_FILE:
        raise AssetError(f"{name} is larger than {LARGEST_FILE >> 20} MB, the most that is read")
    return data


def _decoded(data: bytes, name: str) -> np.ndarray:
    from PIL import Image, UnidentifiedImageError

    deep = data.startswith(_PNG) and data[_PNG_DEPTH : _PNG_DEPTH + 1] == b"\x10"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(BytesIO(data), formats=FORMATS) as picture:
                mode = "I;16" if deep else picture.mode
                _reject(picture.size, mode, "transparency" in picture.info, name)
                picture.load()
                return np.array(picture.convert("RGB"))
    except UnidentifiedImageError:
        raise AssetError(f"{name} is no picture that can be read; save it as PNG or JPEG") from None
    except Image.DecompressionBombError:
        raise AssetError(f"{name} has too many pixels; at most {LARGEST_SIDE} x {LARGEST_SIDE} are read") from None
    except AssetError:
        raise
    except (OSError, ValueError, SyntaxError, EOFError, IndexError, TypeError) as error:
        raise AssetError(f"{name} is damaged or cut short ({error}); save the picture again") from error


def _reject(size: tuple[int, int], mode: str, transparent: bool, name: str) -> None:
    """Raise `AssetError` for what is not read, before a pixel is decoded."""
    wide, high = size
    if max(size) > LARGEST_SIDE:
        raise AssetError(
            f"{name} has {wide} x {high} pixels; at most {LARGEST_SIDE} x {LARGEST_SIDE} are read; shrink it"
        )
    if min(size) < SMALLEST_SIDE:
        raise AssetError(f"{name} has {wide} x {high} pixels; at least {SMALLEST_SIDE} x {SMALLEST_SIDE} are needed")
    if mode in ("RGBA", "LA", "PA", "La", "RGBa") or transparent:
        raise AssetError(f"{name} has a transparent (alpha) channel; flatten it and save it as 8-bit RGB")
    if mode.startswith(("I", "F")):
        raise AssetError(f"{name} has 16 or more bits in a channel; save it with 8 bits in each of red, green and blue")
    if mode not in ("RGB", "P"):
        wanted = "three channels (red, green, blue) are needed"
        raise AssetError(f"{name} is not in colour but in mode {mode}; {wanted}: save it as 8-bit RGB")
