"""Loading heads by name from the asset folder; files are untrusted, so sizes are checked before anything is read."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from faceanim.ground.errors import AssetError, unknown_name

DENSITIES = ("coarse", "default", "fine")
FACES = ("default",)
_LARGEST_ASSET = 64 * 2**20


def asset_folder() -> Path:
    """Return the folder of the built-in assets (inside the package once installed, beside it in a checkout)."""
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "assets", package.parent / "assets"):
        if folder.is_dir():
            return folder
    raise AssetError(f"the assets folder is missing beside {package}; reinstall faceanim")


def asset_text(name: str) -> str:
    """Return a text asset; raise `AssetError` if it is missing, unreadable or not UTF-8."""
    path = asset_folder() / name
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise AssetError(f"asset {path} cannot be read ({error}); reinstall faceanim") from error


def asset_arrays(name: str) -> dict[str, np.ndarray]:
    """Return the arrays of an npz asset; raise `AssetError` if it is missing, broken or unreasonably large."""
    path = asset_folder() / name
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _LARGEST_ASSET:
            raise AssetError(f"asset {path} unpacks to {size / 2**20:.0f} MB; at most {_LARGEST_ASSET >> 20} are read")
        with np.load(path, allow_pickle=False) as data:
            return {key: data[key] for key in data.files}
    except AssetError:
        raise
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zipfile.LargeZipFile) as error:
        raise AssetError(f"asset {path} is missing or broken ({error}); reinstall faceanim") from error


def faces() -> tuple[str, ...]:
    """Return the names of the built-in faces."""
    return FACES


def load_face(name: str = "default", density: str = "default") -> Any:
    """Return the built-in `Face` called `name` at a density ("coarse", "default", "fine").

    Raises `UserError` for unknown names and `AssetError` for a broken installation.
    """
    from faceanim.face.face import Face

    if name not in FACES:
        raise unknown_name("face", name, FACES)
    if density not in DENSITIES:
        raise unknown_name("density", density, DENSITIES)
    return Face.from_assets(name, density)
