"""What is written on top of a picture: text, a colour bar with its numbers, a legend."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from faceanim.render.colormap import Scale
from faceanim.render.shading import Bytes

_FONT = cv2.FONT_HERSHEY_SIMPLEX
INK = (35, 38, 42)
PAPER = (246, 247, 248)


def text_scale(height: int) -> float:
    """Return the font scale that suits a picture of that height [pixel]."""
    return max(0.34, 0.42 * height / 512.0)


def write_text(
    picture: Bytes, text: str, x: int, y: int, *, scale: float = 0.42, halo: bool = True, bold: bool = False
) -> None:
    """Write `text` with its lower left corner at pixel (x, y), dark on a light halo, into `picture` (h, w, 3)."""
    weight = 2 if bold else 1
    if halo:
        for dx, dy in ((-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)):
            cv2.putText(picture, text, (x + dx, y + dy), _FONT, scale, PAPER, weight, cv2.LINE_AA)
    cv2.putText(picture, text, (x, y), _FONT, scale, INK, weight, cv2.LINE_AA)


def text_size(text: str, scale: float) -> tuple[int, int]:
    """Return width and height [pixel] of a written `text`."""
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, 1)
    return int(width), int(height)


def _number(value: float, step: float) -> str:
    decimals = next((d for d in range(9) if abs(round(step, d) - step) <= 1e-6 * step), 9) if step > 0 else 0
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def ticks(low: float, high: float, wanted: int = 4) -> list[float]:
    """Return about `wanted` round numbers that divide [low, high]."""
    if not high > low:
        return [low]
    raw = (high - low) / wanted
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min((m for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= raw * 0.999), default=10.0)
    first = np.ceil(low / step - 1e-9)
    return [float(k * step) for k in np.arange(first, np.floor(high / step + 1e-9) + 1)]


def draw_colour_bar(picture: Bytes, scale: Scale) -> None:
    """Draw an upright colour bar with numbers and label along the right border of `picture` (h, w, 3)."""
    height, width = picture.shape[:2]
    font = text_scale(height)
    bar_w, top, bottom = max(8, height // 40), int(0.16 * height), int(0.84 * height)
    marks = ticks(scale.low, scale.high)
    step = marks[1] - marks[0] if len(marks) > 1 else 1.0
    label_w = max(text_size(_number(m, step), font)[0] for m in marks)
    left = width - label_w - bar_w - max(10, height // 40)
    values = np.linspace(scale.high, scale.low, bottom - top)
    picture[top:bottom, left : left + bar_w] = np.round(255.0 * scale.colours(values))[:, None]
    cv2.rectangle(picture, (left - 1, top - 1), (left + bar_w, bottom), INK, 1)
    for mark in marks:
        y = round(bottom - 1 - (mark - scale.low) / (scale.high - scale.low or 1.0) * (bottom - top - 1))
        cv2.line(picture, (left + bar_w, y), (left + bar_w + 3, y), INK, 1)
        write_text(picture, _number(mark, step), left + bar_w + 6, y + int(10 * font), scale=font)
    text_w, text_h = text_size(scale.label, font)
    write_text(picture, scale.label, max(width - text_w - 6, 2), top - text_h, scale=font)


def draw_legend(picture: Bytes, entries: Sequence[tuple[str, tuple[float, float, float]]]) -> None:
    """Draw a swatch and a name for each (name, sRGB colour) in the lower left corner of `picture` (h, w, 3)."""
    height = picture.shape[0]
    font = text_scale(height)
    line = round(46 * font)
    y = height - line * len(entries) - line // 3
    for name, colour in entries:
        size = int(0.6 * line)
        ink = tuple(round(255 * c) for c in colour)
        cv2.rectangle(picture, (8, y), (8 + size, y + size), ink, -1)
        cv2.rectangle(picture, (8, y), (8 + size, y + size), INK, 1)
        write_text(picture, name, 8 + size + 7, y + size - 1, scale=font)
        y += line


def draw_title(picture: Bytes, text: str) -> None:
    """Write a title line at the upper left of `picture` (h, w, 3)."""
    font = 1.15 * text_scale(picture.shape[0])
    write_text(picture, text, 10, 10 + text_size(text, font)[1], scale=font)
