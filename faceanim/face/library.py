"""Loading heads by name from the asset folder; files are untrusted, so sizes are checked before anything is read."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from faceanim.ground.errors import AssetError, unknown_name

if TYPE_CHECKING:
    from faceanim.face.muscles import AnyMuscle

DENSITIES = ("coarse", "default", "fine")
FACES = ("default",)
_LARGEST_ASSET = 64 * 2**20
_LARGEST_LIST = 2**20


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


def read_muscles(path: str | Path) -> dict[str, AnyMuscle]:
    """Return the muscles of a TOML file of one's own; raise `AssetError` naming the file and what is wrong with it."""
    from faceanim.face.muscles import parse_muscles

    try:
        with Path(path).open("rb") as file:
            data = file.read(_LARGEST_LIST + 1)
        if len(data) > _LARGEST_LIST:
            raise AssetError(f"{path} is larger than {_LARGEST_LIST >> 20} MB; a list of muscles has some kB")
        table = parse_muscles(data.decode("utf-8"), str(path))
    except OSError as error:
        raise AssetError(f"{path} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise AssetError(f"{path} is not a text file in UTF-8; a list of muscles is TOML") from None
    if not table:
        raise AssetError(f"{path} holds no muscles; `faceanim muscles map` writes such a file")
    return table


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
