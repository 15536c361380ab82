"""Procedural textures of the synthetic room, drawn from a seed and prefiltered for any distance.

A texture is a function (rng, rows, columns, texel in metres) -> albedo [rows, columns], about 0 to 255. It has
edges, and fractal noise for the fine detail that photometric alignment needs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

LEVELS = 8
"""Mip levels of every texture."""
_BORDER = 2
_MOST_TEXELS = 1800


@dataclass(frozen=True)
class Atlas:
    """All mip levels of all faces' textures in one image of grey levels (float32).

    corner: [F, LEVELS, 2] (column, row) of each level's first texel; texel: [F] edge of a level-0 texel in metres.
    """

    image: np.ndarray
    corner: np.ndarray
    texel: np.ndarray


def paint(kinds: Sequence[str], sizes: np.ndarray, light: np.ndarray, seed: int) -> Atlas:
    """Draw, light and prefilter the textures of F rectangles and pack their mip levels.

    Args:
        kinds: Names of textures, keys of `TEXTURES`.
        sizes: [F, 2] metres along a texture's rows and along its columns.
        light: [F] factors on the albedo.
        seed: Seed; each rectangle's texture depends on it and on the rectangle's index.
    """
    longest = sizes.max(axis=1)
    texel = np.maximum(np.where(longest > 2.2, 0.004, 0.003), longest / _MOST_TEXELS)
    levels: list[np.ndarray] = []
    for index, kind in enumerate(kinds):
        columns, rows = (max(8, math.ceil(size / texel[index])) for size in sizes[index])
        albedo = TEXTURES[kind](np.random.default_rng([seed, index]), rows, columns, float(texel[index]))
        levels += _mip_levels(np.clip(albedo, 12, 243).astype(np.float32) * np.float32(light[index]))
    image, corners = _pack(levels)
    return Atlas(image, corners.reshape(len(kinds), LEVELS, 2), texel)


def _mip_levels(texture: np.ndarray) -> list[np.ndarray]:
    """Mip levels, each of half the size of the one before and blurred by a Gaussian with a sigma of one of its texels.

    Texel c of a level is centred at (c + 1/2) 2^level - 1/2 in the texture's texels.
    """
    levels = [cv2.GaussianBlur(texture, (0, 0), 1.0, borderType=cv2.BORDER_REPLICATE)]
    for _ in range(LEVELS - 1):
        # variance 4 is wanted and 1 is there (fine texels squared); averaging 2 x 2 adds 1/4
        fine = cv2.GaussianBlur(levels[-1], (0, 0), math.sqrt(3 - 0.25), borderType=cv2.BORDER_REPLICATE)
        rows, columns = fine.shape
        fine = cv2.copyMakeBorder(fine, 0, rows % 2, 0, columns % 2, cv2.BORDER_REPLICATE)
        levels.append(cv2.resize(fine, (fine.shape[1] // 2, fine.shape[0] // 2), interpolation=cv2.INTER_AREA))
    return levels


def _pack(images: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Pack images with replicated borders on shelves of one image; also return each one's first texel (column, row)."""
    width = max(2048, max(image.shape[1] for image in images) + 2 * _BORDER)
    corners = np.zeros((len(images), 2), np.int64)
    left = top = shelf = 0
    for index in sorted(range(len(images)), key=lambda i: -images[i].shape[0]):
        rows, columns = (length + 2 * _BORDER for length in images[index].shape)
        if left + columns > width:
            left, top, shelf = 0, top + shelf, 0
        corners[index] = left + _BORDER, top + _BORDER
        left, shelf = left + columns, max(shelf, rows)
    atlas = np.zeros((top + shelf, width), np.float32)
    for image, (column, row) in zip(images, corners - _BORDER, strict=True):
        bordered = cv2.copyMakeBorder(image, _BORDER, _BORDER, _BORDER, _BORDER, cv2.BORDER_REPLICATE)
        atlas[row : row + bordered.shape[0], column : column + bordered.shape[1]] = bordered
    return atlas, corners


def _fractal(
    rng: np.random.Generator, rows: int, columns: int, octaves: int, roughness: float = 0.75, stretch: int = 0
) -> np.ndarray:
    """Fractal value noise of zero mean and unit deviation; [rows, columns].

    Amplitude falls by 2^roughness from one octave to the next finer; the pattern is 2^stretch times longer along a row.
    """
    noise = np.zeros((1, 1), np.float32)
    for octave in range(octaves, -1, -1):
        shape = (max(2, math.ceil(rows / 2**octave)), max(2, math.ceil(columns / 2 ** (octave + stretch))))
        fresh = rng.standard_normal(shape, dtype=np.float32) * np.float32(2.0 ** (roughness * octave))
        noise = cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_LINEAR) + fresh
    noise = cv2.resize(noise, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return (noise - noise.mean()) / max(float(noise.std()), 1e-6)


def _wood(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    grain = _fractal(rng, rows, columns, 5, 0.5, 4) if columns >= rows else _fractal(rng, columns, rows, 5, 0.4, 4).T
    return 140 + rng.uniform(-8, 8) + 16 * grain + 13 * _fractal(rng, rows, columns, 6, 0.25)


def _floor(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    """Planks of 14 cm, cut at random lengths, each with its own brightness, with dark joints."""
    image = 125 + 13 * _fractal(rng, rows, columns, 5, 0.4, 4) + 16 * _fractal(rng, rows, columns, 7, 0.25)
    plank = max(2, round(0.14 / texel))
    for top in range(0, rows, plank):
        left = -int(rng.integers(0, round(1.2 / texel)))
        while left < columns:
            right = left + int(rng.uniform(0.7, 1.4) / texel)
            image[top : top + plank, max(left, 0) : max(right, 0)] += rng.uniform(-24, 24)
            image[top : top + plank, max(right - 2, 0) : max(right, 0)] -= 45
            left = right
        image[top : top + 2] -= 45
    return image


def _wallpaper(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    """Plaster with stripes of uneven width above a skirting board."""
    image = 155 + 22 * _fractal(rng, rows, columns, 8, 0.35)
    left = 0
    while left < columns:
        right = left + int(rng.uniform(0.06, 0.25) / texel)
        image[:, left:right] += rng.uniform(-14, 14)
        left = right
    skirting = round(0.12 / texel)
    image[-skirting:] -= 60
    return image


def _ceiling(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    """Panels of 60 cm."""
    image = 185 + 14 * _fractal(rng, rows, columns, 7, 0.4)
    panel = max(2, round(0.6 / texel))
    for top in range(0, rows, panel):
        for left in range(0, columns, panel):
            image[top : top + panel, left : left + panel] += rng.uniform(-10, 10)
    image[::panel] -= 50
    image[:, ::panel] -= 50
    return image


def _books(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    """Spines of 1.5 to 5 cm, each with bands and a title block."""
    image = 35 + 4 * _fractal(rng, rows, columns, 4)
    left = 0
    while left < columns:
        right = left + max(3, round(rng.uniform(0.015, 0.05) / texel))
        top = round(rows * rng.uniform(0.0, 0.25))
        image[top:, left:right] = rng.uniform(50, 220) + 5 * rng.standard_normal((rows - top, 1))
        for _ in range(int(rng.integers(1, 4))):
            row = int(rng.uniform(top, rows))
            image[row : row + max(2, round(rng.uniform(0.005, 0.05) / texel)), left + 1 : right - 1] = rng.uniform(
                30, 240
            )
        image[top:, right - 1 : right] = 25
        left = right
    return image + 4 * _fractal(rng, rows, columns, 4)


def _picture(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    """A picture in a dark frame."""
    return _framed(rng, rows, columns, texel, 45.0)


def _screen(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    """A screen. Its casing is about as bright as the wall: contrast at an occluding edge biases plain least squares."""
    return _framed(rng, rows, columns, texel, 150.0)


def _framed(rng: np.random.Generator, rows: int, columns: int, texel: float, frame_grey: float) -> np.ndarray:
    """Overlapping shapes on a cloudy background, framed."""
    image = np.ascontiguousarray(130 + 35 * _fractal(rng, rows, columns, 8, 0.9))
    for _ in range(24):
        centre = (int(rng.uniform(0, columns)), int(rng.uniform(0, rows)))
        radius = rng.uniform(0.03, 0.22, 2) * min(rows, columns)
        grey, angle = float(rng.uniform(20, 240)), float(rng.uniform(0, 180))
        if rng.random() < 0.5:
            cv2.ellipse(image, centre, (int(radius[0]), int(radius[1])), angle, 0, 360, grey, -1)
        else:
            corners = cv2.boxPoints((centre, (2 * radius[0], 2 * radius[1]), angle))
            cv2.fillPoly(image, [corners.astype(np.int32)], grey)
    image += 10 * _fractal(rng, rows, columns, 5, 0.3)
    frame = max(1, round(0.03 / texel))
    cv2.rectangle(image, (0, 0), (columns - 1, rows - 1), frame_grey, 2 * frame)
    return image


def _fabric(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    return 105 + 16 * _fractal(rng, rows, columns, 7, 0.35) + 8 * _fractal(rng, rows, columns, 2, 0.3)


def _checker(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    return _tiles(rng, rows, columns, 0.05 / texel) + 6 * _fractal(rng, rows, columns, 5)


def _rug(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    return _tiles(rng, rows, columns, 0.17 / texel) + 12 * _fractal(rng, rows, columns, 5, 0.4)


def _tiles(rng: np.random.Generator, rows: int, columns: int, edge: float) -> np.ndarray:
    """A checkerboard of squares of `edge` texels, each with its own brightness."""
    row, column = (np.arange(rows) / edge).astype(int), (np.arange(columns) / edge).astype(int)
    greys = rng.uniform(-25, 25, (row[-1] + 1, column[-1] + 1))
    greys += np.where(np.add.outer(np.arange(row[-1] + 1), np.arange(column[-1] + 1)) % 2 == 0, 85, 150)
    return greys[row][:, column].astype(np.float32)


def _carton(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    """Cardboard with tape across the middle and a label of text lines."""
    image = 135 + 16 * _fractal(rng, rows, columns, 6, 0.35)
    image[:, columns // 2 - columns // 16 : columns // 2 + columns // 16] += 35
    top, left = int(rows * rng.uniform(0.15, 0.45)), int(columns * rng.uniform(0.08, 0.45))
    height, width = int(rows * 0.4), int(columns * 0.45)
    image[top : top + height, left : left + width] = 225
    line = max(2, round(0.018 / texel))
    for row in range(top + line, top + height - line, 2 * line):
        image[row : row + line, left + line : left + line + int((width - 2 * line) * rng.uniform(0.4, 1.0))] = 45
    return image


def _drawers(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    """Wooden fronts with dark gaps and handles."""
    image = _wood(rng, rows, columns, texel)
    front = max(4, round(0.33 / texel))
    for top in range(0, rows, front):
        image[top : top + front] += rng.uniform(-14, 14)
        image[top : top + 3] -= 60
        middle, handle = top + front // 2, round(0.07 / texel)
        image[middle : middle + max(2, round(0.02 / texel)), columns // 2 - handle : columns // 2 + handle] = 40
    return image


def _keys(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    return 0.6 * _tiles(rng, rows, columns, 0.019 / texel) - 10 + 4 * _fractal(rng, rows, columns, 3)


def _plain(rng: np.random.Generator, rows: int, columns: int, texel: float) -> np.ndarray:
    return 110 + 8 * _fractal(rng, rows, columns, 5)


TEXTURES: dict[str, Callable[[np.random.Generator, int, int, float], np.ndarray]] = {
    "wood": _wood,
    "floor": _floor,
    "wallpaper": _wallpaper,
    "ceiling": _ceiling,
    "books": _books,
    "picture": _picture,
    "screen": _screen,
    "fabric": _fabric,
    "checker": _checker,
    "rug": _rug,
    "carton": _carton,
    "drawers": _drawers,
    "keys": _keys,
    "plain": _plain,
}
