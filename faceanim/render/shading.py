"""What surfaces look like: textures, materials, lights and background, packed into tables for the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from faceanim.ground.arrays import Floats
from faceanim.ground.errors import AssetError, UserError
from faceanim.kernels import raster as k

Bytes = NDArray[np.uint8]
Colour = tuple[float, float, float]


def linear(colour: Any) -> Floats:
    """Return linear light for sRGB values in [0, 1] (IEC 61966-2-1)."""
    c = np.asarray(colour, dtype=np.float64)
    return np.where(c <= 0.04045, c / 12.92, ((np.maximum(c, 0.04045) + 0.055) / 1.055) ** 2.4)


def srgb(light: Any) -> Floats:
    """Return sRGB values for linear light in [0, 1]."""
    c = np.asarray(light, dtype=np.float64)
    return np.where(c <= 0.0031308, 12.92 * c, 1.055 * np.maximum(c, 0.0031308) ** (1.0 / 2.4) - 0.055)


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture and its box-filtered halvings: `levels`, each (h, w, 3) sRGB bytes, the first row on top (v = 1)."""

    levels: tuple[Bytes, ...]

    @classmethod
    def of(cls, picture: Any) -> Texture:
        """Build the levels from `picture` (h, w, 3) RGB bytes; averages are taken in linear light."""
        base = np.ascontiguousarray(picture)
        if base.ndim != 3 or base.shape[2] != 3 or base.dtype != np.uint8 or min(base.shape[:2]) < 1:
            raise UserError(f"a texture must be (h, w, 3) bytes; this one is {base.shape} of {base.dtype}")
        fine = 1 << 14
        decode = linear(np.arange(256) / 255.0).astype(np.float32)
        encode = np.round(255.0 * srgb(np.arange(fine + 1) / fine)).astype(np.uint8)
        levels, light = [base], decode[base]
        while min(light.shape[:2]) > 1:
            h, w = light.shape[0] // 2, light.shape[1] // 2
            rows = light[0 : 2 * h : 2] + light[1 : 2 * h : 2]
            light = np.float32(0.25) * (rows[:, 0 : 2 * w : 2] + rows[:, 1 : 2 * w : 2])
            levels.append(encode[(light * np.float32(fine) + np.float32(0.5)).astype(np.int32)])
        return cls(tuple(levels))

    @classmethod
    def read(cls, path: str | Path) -> Texture:
        """Read a PNG or JPEG file; raise `AssetError` if that fails."""
        raw = np.fromfile(path, dtype=np.uint8) if Path(path).is_file() else np.zeros(0, np.uint8)
        picture = cv2.imdecode(raw, cv2.IMREAD_COLOR) if raw.size else None
        if picture is None:
            raise AssetError(f"texture {path} is missing or is not a picture that can be read")
        return cls.of(picture[:, :, ::-1])


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface reflects light.

    colour : sRGB in [0, 1], used without a texture   texture : needs uv   vertex_colour : take the item's colours
    specular : reflectance straight on (skin 0.028, tooth 0.05, cornea 0.04; 0 = none)   gloss : [0, 1], 1 = mirror
    matte : [0, 1], how much less dark parts shine (hair on skin)
    wrap : how far diffuse light reaches round, red, green, blue   two_sided : draw back sides, darkened by `back`
    glow : part of the ambient light that reaches places closed to the sky, red, green, blue
    shade_radius : [mm] of the contact shade that nearer surfaces throw (0 = none), `shade` its strength in [0, 1]
    wire : width of triangle edges drawn on top [pixel]   flat : 0 lit, 1 plain colour without any light
    casts : throws a shadow of the key light
    layer : 0 opaque; a higher layer has its own depth and is blended over the lower ones
    """

    colour: Colour = (0.8, 0.8, 0.8)
    texture: Texture | None = None
    vertex_colour: bool = False
    specular: float = 0.03
    gloss: float = 0.4
    wrap: Colour = (0.0, 0.0, 0.0)
    two_sided: bool = False
    back: float = 0.5
    matte: float = 0.0
    glow: Colour = (0.0, 0.0, 0.0)
    shade_radius: float = 0.0
    shade: float = 0.0
    wire: float = 0.0
    flat: float = 0.0
    casts: bool = False
    layer: int = 0

    def row(self, textures: list[Texture]) -> Floats:
        """Return the kernel's numbers, adding the texture to `textures` if it is new."""
        out = np.zeros(k.N_MATERIAL)
        if self.texture is not None and not self.vertex_colour:
            if not any(t is self.texture for t in textures):
                textures.append(self.texture)
            out[k.M_TEXTURE] = next(i for i, t in enumerate(textures) if t is self.texture)
        out[k.M_SOURCE] = 2.0 if self.vertex_colour else 0.0 if self.texture is None else 1.0
        out[k.M_SPECULAR] = self.specular
        out[k.M_ROUGH] = max(1.0 - self.gloss, 0.02) ** 2
        out[k.M_WRAP : k.M_WRAP + 3] = self.wrap
        out[k.M_SIDED], out[k.M_BACK] = float(self.two_sided), self.back
        out[k.M_SHADE_RADIUS], out[k.M_SHADE] = self.shade_radius, self.shade
        out[k.M_MATTE] = self.matte
        out[k.M_GLOW : k.M_GLOW + 3] = self.glow
        out[k.M_WIRE], out[k.M_FLAT], out[k.M_LAYER] = self.wire, self.flat, self.layer
        return out


@dataclass(frozen=True)
class Light:
    """A distant light: `direction` towards it (right, up, towards the viewer), linear `colour`."""

    direction: Colour
    colour: Colour


@dataclass(frozen=True)
class Lighting:
    """The lights of a portrait, which stand still relative to the camera; all colours linear.

    lights : up to three   sky, ground : ambient light from above and below
    mirror : surroundings seen at grazing angles
    """

    lights: tuple[Light, ...] = (
        Light((-0.50, 0.55, 0.80), (0.95, 0.89, 0.81)),
        Light((0.85, 0.10, 0.45), (0.20, 0.195, 0.20)),
    )
    sky: Colour = (0.27, 0.275, 0.29)
    ground: Colour = (0.19, 0.145, 0.12)
    mirror: Colour = (0.30, 0.32, 0.36)

    def __post_init__(self) -> None:
        if len(self.lights) > k.LIGHTS:
            raise UserError(f"{len(self.lights)} lights were given; at most {k.LIGHTS} are supported")

    def mirrored(self) -> Lighting:
        """Return the same lights with left and right exchanged."""
        lights = tuple(Light((-q.direction[0], q.direction[1], q.direction[2]), q.colour) for q in self.lights)
        return Lighting(lights, self.sky, self.ground, self.mirror)

    def table(self) -> Floats:
        """Return (LIGHTS, 6): unit direction in camera space and colour; black where there is no light."""
        out = np.zeros((k.LIGHTS, 6))
        out[:, 2] = -1.0
        for row, light in zip(out, self.lights, strict=False):
            d = np.array(light.direction) * (1.0, 1.0, -1.0)
            row[:3], row[3:] = d / np.linalg.norm(d), light.colour
        return out


@dataclass(frozen=True)
class Background:
    """A vertical gradient between two sRGB colours in [0, 1]."""

    top: Colour = (0.80, 0.815, 0.83)
    bottom: Colour = (0.55, 0.565, 0.585)

    def rows(self, height: int) -> Floats:
        """Return linear light for each row of the picture, (height, 3)."""
        s = (np.arange(height) + 0.5)[:, None] / height
        s = s * s * (3.0 - 2.0 * s)
        return linear((1.0 - s) * np.array(self.top) + s * np.array(self.bottom))


@dataclass(frozen=True, eq=False)
class Look:
    """Lighting and background of a picture; `shadow`: whether the key light throws shadows."""

    lighting: Lighting = field(default_factory=Lighting)
    background: Background = field(default_factory=Background)
    shadow: bool = True


def encode_table() -> Bytes:
    """Return sRGB bytes for linear light in [0, ENCODE_TOP), with a soft shoulder above 0.8."""
    x = (np.arange(k.ENCODE) + 0.5) * (k.ENCODE_TOP / k.ENCODE)
    over = np.maximum(x - 0.8, 0.0)
    return np.round(255.0 * srgb(np.where(x > 0.8, 0.8 + 0.2 * (1.0 - np.exp(-over / 0.2)), x))).astype(np.uint8)


@lru_cache(maxsize=4)
def _texel_tables(textures: tuple[Texture, ...]) -> tuple[NDArray[np.uint32], NDArray[np.int32], NDArray[np.int32]]:
    """Pack all mip levels: words of three 10-bit square roots, (first, width, height) of each level, their number."""
    root = np.round(1023.0 * np.sqrt(linear(np.arange(256) / 255.0))).astype(np.uint32)
    count = np.array([len(t.levels) for t in textures] or [0], dtype=np.int32)
    level = np.zeros((len(count), max(int(count.max()), 1), 3), dtype=np.int32)
    parts: list[NDArray[np.uint32]] = [np.zeros(1, np.uint32)]
    first = 1
    for i, texture in enumerate(textures):
        for j, picture in enumerate(texture.levels):
            h, w = picture.shape[:2]
            level[i, j] = first, w, h
            red, green, blue = (root[picture[..., c]].ravel() for c in range(3))
            parts.append(red | green << np.uint32(10) | blue << np.uint32(20))
            first += h * w
    return np.concatenate(parts), level, count


def paint_tables(materials: Sequence[Material], look: Look, height: int) -> k.Paint:
    """Pack materials (one row each), their textures, the lights and the background for the kernels."""
    textures: list[Texture] = []
    rows = np.array([m.row(textures) for m in materials])
    texel, level, count = _texel_tables(tuple(textures))
    light = look.lighting
    return k.Paint(
        material=np.ascontiguousarray(rows),
        material32=np.ascontiguousarray(rows, dtype=np.float32),
        light=light.table().astype(np.float32),
        ambient=np.array([light.sky, light.ground, light.mirror], dtype=np.float32),
        texel=texel,
        level=level,
        level_count=count,
        encode=encode_table().astype(np.int32),
        background=look.background.rows(height),
    )
