"""Textures of a character's surfaces, looked up by rays.

v runs down, texel centres are at +0.5, textures repeat; colours are in linear light.
"""

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.motion.character import Surface

Floats = NDArray[np.floating[Any]]  # float32
Ints = NDArray[np.int64]

# Texels along a side, about 2 mm on a person; larger textures are reduced.
MAX_TEXELS = 1024
FLAT_NORMAL = (0.0, 0.0, 1.0)  # a normal map's neutral value


def linear(srgb: Floats) -> Floats:
    """Linear light of sRGB in [0, 1]."""
    # The standard's curve, linear near black.
    curve = ((srgb + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(srgb <= 0.04045, srgb / np.float32(12.92), curve)


def srgb(light: Floats) -> Floats:
    """sRGB of linear light in [0, 1], the inverse of `linear`."""
    curve = 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, curve)


class Textures:
    """All surfaces with their mip levels in one array, so that one lookup serves all rays."""

    def __init__(self, surfaces: tuple[Surface, ...]) -> None:
        pyramids = [list(_pyramid(surface)) for surface in surfaces]
        self.levels = np.array([len(levels) for levels in pyramids])

        # The first texel and the size of each level of each surface.
        shape = (len(pyramids), self.levels.max())
        self._start = np.zeros(shape, np.int64)
        self._size = np.ones((*shape, 2), np.int64)
        texels = []
        count = 0
        for m, levels in enumerate(pyramids):
            for k, level in enumerate(levels):
                height, width = level.shape[:2]
                self._start[m, k] = count
                self._size[m, k] = (width, height)
                texels.append(level.reshape(-1, 8))
                count += height * width
        self._texels = np.concatenate(texels)

    def size(self, surface: Ints) -> Ints:
        """``[N, 2]`` width and height in texels of surfaces ``[N]``."""
        return self._size[surface, 0]

    def __call__(
        self, surface: Ints, uv: Floats, level: Ints
    ) -> tuple[Floats, Floats, Floats]:
        """Linear RGB ``[N, 3]``, coverage ``[N]`` and tangent-space normals ``[N, 3]``, bilinear.

        Args:
            surface: ``[N]`` index into the surfaces.
            uv: ``[N, 2]`` texture coordinates.
            level: ``[N]`` mip level, clamped to those that exist.
        """
        level = np.clip(level, 0, self.levels[surface] - 1)
        start = self._start[surface, level]
        size = self._size[surface, level]

        # The texel up and left of each point, and the point's place between it and the next.
        at = (uv - np.floor(uv)) * size.astype(np.float32) - np.float32(0.5)
        corner = np.floor(at)
        share = at - corner
        x = share[:, :1]
        y = share[:, 1:]

        # Textures repeat.
        low = corner.astype(np.int64)
        high = low + 1
        low = np.where(low < 0, size - 1, low)
        high = np.where(high >= size, 0, high)

        # The four texels around each point, weighted.
        top = start + low[:, 1] * size[:, 0]
        bottom = start + high[:, 1] * size[:, 0]
        left = low[:, 0]
        right = high[:, 0]

        # Bilinear between four texels.
        out = self._texels[top + left] * ((1 - x) * (1 - y))
        out += self._texels[top + right] * (x * (1 - y))
        out += self._texels[bottom + left] * ((1 - x) * y)
        out += self._texels[bottom + right] * (x * y)
        return out[:, :3], out[:, 3], out[:, 4:7]


def _pyramid(surface: Surface) -> Iterator[Floats]:
    """``[h, w, 8]`` texels of every level, each half the size of the last, down to one texel.

    Linear RGB, coverage, normal, and one unused channel that keeps texels aligned in memory.
    """
    # The first level, reduced to at most `MAX_TEXELS` a side.
    h, w = surface.colour.shape[:2]
    shrink = max(1.0, max(h, w) / MAX_TEXELS)
    h = max(1, round(h / shrink))
    w = max(1, round(w / shrink))

    # Colour and normal in one array; colours are averaged as light, not as
    # bytes.
    texels = np.zeros((h, w, 8), np.float32)
    colour = surface.colour.astype(np.float32) / 255
    colour[..., :3] = linear(colour[..., :3])
    texels[..., :4] = _resize(colour, w, h)
    texels[..., 4:7] = FLAT_NORMAL
    if surface.normal is not None:
        normal = surface.normal.astype(np.float32) / 127.5 - 1
        texels[..., 4:7] = _resize(normal, w, h)
    yield texels

    # OpenCV resizes at most four channels at once.
    while h > 1 or w > 1:
        h = max(1, h // 2)
        w = max(1, w // 2)
        first = _resize(texels[..., :4], w, h)
        last = _resize(texels[..., 4:], w, h)
        texels = np.concatenate([first, last], axis=2)
        yield texels


def _resize(texels: Floats, width: int, height: int) -> NDArray[Any]:
    return cv2.resize(texels, (width, height), interpolation=cv2.INTER_AREA)
