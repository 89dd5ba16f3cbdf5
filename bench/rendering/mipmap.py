"""Textures with mip-maps, sampled between two levels against aliasing (Williams, SIGGRAPH 1983)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bench.types import Bytes, Floats

SMALLEST = 4  # texels: the shorter side of the last level
ROW = 4096  # samples a row: cv2.remap takes images, and no side of one may exceed 32,767
GAMMA = 2.2


@dataclass(frozen=True, eq=False)
class Texture:
    """An image and its successive halves."""

    levels: tuple[Bytes, ...]  # (h, w, 3) uint8, display-encoded, each half the one before

    @classmethod
    def of(cls, pixels: Bytes) -> Texture:
        """Build a texture from (h, w, 3) uint8."""
        levels = [pixels]
        while min(levels[-1].shape[:2]) >= 2 * SMALLEST:
            h, w = levels[-1].shape[:2]
            levels.append(np.asarray(cv2.resize(levels[-1], (w // 2, h // 2), interpolation=cv2.INTER_AREA), np.uint8))
        return cls(tuple(levels))

    @property
    def texels(self) -> int:
        h, w = self.levels[0].shape[:2]
        return h * w

    def sample(self, u: Floats, v: Floats, fineness: Floats) -> Floats:
        """Sample linear light at (u, v), each from 0 to 1 over the texture; `fineness` is the level, where 0 is the finest.

        u, v, fineness (n,) -> (n, 3)
        """
        level = np.clip(fineness, 0, len(self.levels) - 1.001)
        whole = level.astype(np.int32)
        values = np.empty((len(u), 3), np.float32)
        for index in np.flatnonzero(np.bincount(whole)).tolist():
            rows = np.flatnonzero(whole == index)
            fine = sample(self.levels[index], u[rows], v[rows])
            coarse = sample(self.levels[min(index + 1, len(self.levels) - 1)], u[rows], v[rows])
            fraction = (level[rows] - index)[:, None]
            values[rows] = fine + fraction * (coarse - fine)
        return values


def to_linear(pixels: Bytes) -> Floats:
    """Convert display-encoded values to linear light, 0 to 1."""
    return _LINEAR[pixels]


_LINEAR = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)


def sample(image: np.ndarray, u: Floats, v: Floats) -> Floats:
    """Sample bilinearly at (u, v), each from 0 to 1 over the image; uint8 is converted to linear light.

    image (h, w, c) uint8 or float32; u, v (n,) -> (n, c)
    """
    h, w = image.shape[:2]
    count = len(u)
    rows = -(-count // ROW)
    x, y = np.zeros((2, rows * ROW), np.float32)
    np.multiply(u, w, out=x[:count])
    np.multiply(v, h, out=y[:count])
    x -= 0.5  # OpenCV's centre of the first pixel is 0
    y -= 0.5
    maps = x.reshape(rows, ROW), y.reshape(rows, ROW)
    samples = cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    values: np.ndarray = samples.reshape(rows * ROW, -1)[:count]
    return to_linear(values) if image.dtype == np.uint8 else values
