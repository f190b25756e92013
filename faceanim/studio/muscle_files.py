"""Muscles from files that a page sends: nobody's word is taken for what they hold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from faceanim.face.muscles import AnyMuscle, one_sided, parse_muscles
from faceanim.ground.errors import AssetError, RunError

if TYPE_CHECKING:
    from faceanim.face.face import Face

LARGEST_TEXT, LARGEST_PICTURE = 1 << 20, 32 << 20
"""Bytes of a list of muscles and of a picture that are looked at."""
MOST_MUSCLES = 400
_PICTURES = (b"\x89PNG", b"\xff\xd8\xff", b"BM")


def read_upload(name: str, content: bytes, face: Face, places: Any = None) -> tuple[dict[str, AnyMuscle], list[str]]:
    """Return the one-sided muscles of an uploaded picture or TOML text, and what is wrong with the picture.

    Raises `AssetError` or `UserError` saying what is wrong with a file that gives no muscles.
    """
    shown = _shown(name)
    if content[:8].startswith(_PICTURES):
        if len(content) > LARGEST_PICTURE:
            raise AssetError(
                f"{shown} has {len(content) >> 20} MB; pictures of at most {LARGEST_PICTURE >> 20} MB are read"
            )
        return _from_picture(content, face, places)
    if len(content) > LARGEST_TEXT:
        raise AssetError(f"{shown} has {len(content) >> 10} kB; a list of muscles has at most {LARGEST_TEXT >> 10} kB")
    if name.lower().endswith((".png", ".jpg", ".jpeg", ".bmp")):
        raise AssetError(f"{shown} is not a picture, whatever its name says; save it as PNG")
    try:
        table = parse_muscles(content.decode("utf-8"), shown)
    except UnicodeDecodeError:
        raise AssetError(f"{shown} is neither a PNG picture nor a text in TOML") from None
    if not table:
        raise AssetError(f"{shown} holds no muscles")
    rows = one_sided(table)
    if len(rows) > MOST_MUSCLES:
        raise AssetError(f"{shown} holds {len(rows)} muscles; at most {MOST_MUSCLES} are read")
    return rows, []


def _from_picture(content: bytes, face: Face, places: Any) -> tuple[dict[str, AnyMuscle], list[str]]:
    from faceanim.face.muscle_image import map_picture
    from faceanim.face.picture_file import read_picture

    found = map_picture(read_picture(content), face, places=places)
    return one_sided(found.table), [fault.message for fault in found.faults]


def _shown(name: str) -> str:
    """Return a file's name as it may be shown: short, and without anything that is not plain text."""
    plain = "".join(c for c in name.replace("\\", "/").rpartition("/")[2] if c.isprintable() and c not in "<>[]`*_#")
    return f"the file {plain[:60]!r}" if plain else "the file"


def png_bytes(picture: np.ndarray) -> bytes:
    """Return `picture` (h, w, 3) RGB bytes as a PNG file."""
    import cv2

    done, data = cv2.imencode(".png", np.ascontiguousarray(picture[:, :, ::-1]))
    if not done:
        raise RunError("the picture could not be encoded as PNG")
    return bytes(data.tobytes())
