"""Random fields and colours for textures."""

from __future__ import annotations

import cv2
import numpy as np

from bench.types import Bytes, Floats

Size = tuple[int, int]  # height, width


def draw_noise(rng: np.random.Generator, size: Size, coarsest: float, octaves: int, falloff: float = 0.5) -> Floats:
    """Draw fractal noise of zero mean and unit deviation: octaves of ever finer random grids, each `falloff` times as strong.

    `coarsest` is the largest feature, in pixels. -> (h, w)
    """
    h, w = size
    total = np.zeros(size, np.float32)
    for octave in range(octaves):
        cell = max(1.0, coarsest / 2**octave)
        grid = rng.standard_normal((int(h / cell) + 3, int(w / cell) + 3), dtype=np.float32)
        shift = rng.uniform(0, cell, 2)
        transform = np.array([[cell, 0, -shift[0]], [0, cell, -shift[1]]])
        smooth = cv2.INTER_CUBIC if cell > 1 else cv2.INTER_NEAREST
        total += falloff**octave * cv2.warpAffine(grid, transform, (w, h), flags=smooth, borderMode=cv2.BORDER_REPLICATE)
    total -= total.mean()
    return total / max(float(total.std()), 1e-6)


def draw_voronoi(rng: np.random.Generator, size: Size, count: int) -> tuple[np.ndarray, Floats, np.ndarray]:
    """Draw Voronoi cells of random seeds. -> each pixel's cell (h, w), its distance to the seed (h, w), the seeds (count, 2)"""
    h, w = size
    seeds = np.unique(np.stack([rng.integers(0, w, count), rng.integers(0, h, count)], axis=1), axis=0)  # (n, 2) x, y
    seeds = rng.permutation(seeds)
    seed_map = np.full(size, 255, np.uint8)
    seed_map[seeds[:, 1], seeds[:, 0]] = 0
    distance, labels = cv2.distanceTransformWithLabels(seed_map, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    numbers = np.zeros(labels.max() + 1, np.int32)
    numbers[labels[seeds[:, 1], seeds[:, 0]]] = np.arange(len(seeds))
    return numbers[labels], np.asarray(distance, np.float32), seeds


def draw_palette(rng: np.random.Generator, count: int, saturation: tuple[float, float] = (0.1, 0.75)) -> Floats:
    """Draw a palette of a few related hues. -> (count, 3) float32 display-encoded, 0 to 255"""
    hue = (rng.choice(rng.uniform(0, 180, 3), count) + rng.normal(0, 7, count)) % 180
    hsv = np.stack([hue, rng.uniform(*saturation, count) * 255, rng.uniform(0.2, 0.95, count) * 255], axis=1)
    return cv2.cvtColor(hsv.astype(np.uint8)[None], cv2.COLOR_HSV2RGB)[0].astype(np.float32)


def interpolate_colours(values: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """Interpolate colours along a palette. values (h, w), 0 to 1; palette (n, 3) -> (h, w, 3)"""
    position = np.clip(values, 0, 1) * (len(palette) - 1)
    low = np.minimum(position.astype(np.int32), len(palette) - 2)
    fraction = (position - low)[..., None]
    return palette[low] * (1 - fraction) + palette[low + 1] * fraction


def pixels(values: np.ndarray) -> Bytes:
    """Clip and round to uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def to_colour(row: np.ndarray) -> tuple[int, int, int]:
    """Convert one colour for OpenCV's drawing functions."""
    red, green, blue = (int(value) for value in row)
    return red, green, blue
