"""Materials of walls, floors, ceilings and furniture. Each is a function of a random generator and a size in pixels.

`scale` is the number of pixels per metre, so that bricks and boards have their real size.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from bench.images.photographs import decode, list_ground_textures
from bench.rendering.noise import Size, draw_noise, draw_palette, draw_voronoi, pixels, to_colour
from bench.types import Bytes, Floats


def draw_plaster(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw a plastered wall with roughness, stains and some cracks."""
    base = draw_palette(rng, 1, (0.03, 0.3))[0] * 0.35 + 150
    tone = 2.5 * draw_noise(rng, size, 0.03 * scale, 3, 0.8) + 7 * draw_noise(rng, size, 1.2 * scale, 5)
    canvas = np.ascontiguousarray(pixels(base + tone[..., None]))
    for _ in range(int(rng.poisson(size[0] * size[1] / scale**2 / 6))):
        path = np.cumsum(rng.normal(0, 0.03 * scale, (24, 2)), axis=0) + rng.uniform(0, 1, 2) * size[::-1]
        cv2.polylines(canvas, [path.astype(np.int32)], False, to_colour(base * rng.uniform(0.6, 0.85)), 1, cv2.LINE_AA)
    return canvas


def draw_wallpaper(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw a repeated motif on slightly uneven paper."""
    side = int(scale * rng.uniform(0.25, 0.5))
    palette = draw_palette(rng, 4, (0.1, 0.5))
    tile = np.full((side, side, 3), palette[0] * 0.35 + 140, np.uint8)
    half = draw_noise(rng, (side, side - side // 2), side / 2, 4)
    motif = np.concatenate([half[:, : side // 2][:, ::-1], half], axis=1)
    for level, ink in zip((0.7, 1.3), palette[1:3], strict=True):
        tile[motif > level] = to_colour(ink * 0.4 + 110)
    canvas = (
        _repeat_tile(tile, size)
        + 3 * draw_noise(rng, size, 0.02 * scale, 2)[..., None]
        + 4 * draw_noise(rng, size, scale, 3)[..., None]
    )
    return pixels(canvas)


def draw_bricks(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw courses of bricks with mortar, each brick with its own tone."""
    return _draw_courses(rng, size, scale, (0.24, 0.08), np.array([150.0, 88.0, 66.0]) * rng.uniform(0.8, 1.1), 16)


def draw_stones(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw large hewn blocks."""
    return _draw_courses(rng, size, scale, (0.7, 0.35), np.array([176.0, 166.0, 148.0]) * rng.uniform(0.8, 1.1), 12)


def draw_floorboards(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw floor boards, with grain along them."""
    return _draw_courses(rng, size, scale, (1.5, 0.14), np.array([142.0, 104.0, 66.0]) * rng.uniform(0.7, 1.15), 13, grain=8.0)


def draw_tiles(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw square tiles of two colours, veined, no two alike."""
    side = max(4, int(scale * rng.uniform(0.3, 0.5)))
    y, x = np.mgrid[: size[0], : size[1]]
    row, column = y // side, x // side
    tones = rng.normal(0, 7, (int(row.max()) + 1, int(column.max()) + 1))[row, column]
    pair = draw_palette(rng, 2, (0.03, 0.3)) * 0.5 + np.array([[110.0], [40.0]])
    canvas = pair[(row + column) % 2] + tones[..., None]
    veins = np.abs(draw_noise(rng, size, 0.5 * scale, 6, 0.65))
    canvas += 30 * np.clip(0.35 - veins, 0, 1)[..., None] * rng.choice([-1, 2])
    canvas[(y % side < 2) | (x % side < 2)] *= 0.75
    return pixels(canvas + 4 * draw_noise(rng, size, 0.05 * scale, 3)[..., None])


def draw_carpet(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw a symmetric woven pattern with a border."""
    h, w = size
    quarter = draw_noise(rng, (h - h // 2, w - w // 2), 0.35 * scale, 5, 0.6)
    half = np.concatenate([quarter[:, : w // 2][:, ::-1], quarter], axis=1)
    field = np.concatenate([half[: h // 2][::-1], half])
    palette = draw_palette(rng, 6, (0.3, 0.85)) * 0.8
    steps = np.digitize(field, np.quantile(field, [0.15, 0.35, 0.6, 0.8, 0.93]))
    canvas = palette[steps]
    edge = int(0.15 * scale)
    for inset in (0, edge // 2, edge):
        cv2.rectangle(canvas, (inset, inset), (w - 1 - inset, h - 1 - inset), to_colour(palette[inset % 5]), max(2, edge // 8))
    return pixels(canvas + 9 * draw_noise(rng, size, 3, 2)[..., None])


def draw_cobbles(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw rounded stones of many greys, with earth between."""
    number, distance, seeds = draw_voronoi(rng, size, max(4, int(size[0] * size[1] / (0.13 * scale) ** 2)))
    tones = rng.normal(135, 24, (len(seeds), 1)) + rng.normal(0, 5, (len(seeds), 3))
    dome = np.clip(1.15 - (distance / (0.085 * scale)) ** 2, 0.35, 1.1)
    return pixels(tones[number] * dome[..., None] + 6 * draw_noise(rng, size, 0.04 * scale, 4)[..., None])


def draw_ground(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Tile a photograph of grass or gravel, 1.2 m wide, and hide its repetition under changes of tone."""
    image = _load_grounds()[rng.integers(2)]
    side = int(1.2 * scale)
    tile = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA).astype(np.float32)
    tint = np.array([0.72, 0.9, 0.5]) if rng.random() < 0.5 else np.array([1.0, 0.93, 0.82])
    patches, _, seeds = draw_voronoi(rng, size, max(2, int(size[0] * size[1] / side**2 * 3)))
    # Each patch shows another part of the photograph, so that no two are the same.
    shift = rng.integers(0, side, (len(seeds), 2))
    y, x = np.mgrid[: size[0], : size[1]]
    laid = tile[(y + shift[patches, 0]) % side, (x + shift[patches, 1]) % side]
    return pixels(laid * tint * (1 + 0.15 * draw_noise(rng, size, 2 * scale, 4))[..., None])


def draw_wood(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw wood with its grain along the longer side."""
    base = np.array([132.0, 92.0, 58.0]) * rng.uniform(0.5, 1.25)
    h, w = size
    stretched = (
        draw_noise(rng, (h, max(1, w // 12)), 0.12 * scale, 5, 0.75)
        if w > h
        else draw_noise(rng, (max(1, h // 12), w), 0.12 * scale, 5, 0.75)
    )
    return pixels(base * (1 + 0.16 * cv2.resize(stretched, (w, h), interpolation=cv2.INTER_CUBIC))[..., None])


def draw_shelves(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw a bookcase: backs of books of many colours and heights, with lettering."""
    canvas = np.ascontiguousarray((draw_wood(rng, size, scale) * 0.5).astype(np.uint8))
    h, w = size
    shelf = int(0.34 * scale)
    for bottom in range(shelf, h + shelf // 2, shelf):
        x = int(0.04 * scale)
        while x < w - 0.05 * scale:
            thick, tall = max(2, int(scale * rng.uniform(0.015, 0.055))), int(shelf * rng.uniform(0.6, 0.9))
            back = draw_palette(rng, 1, (0.1, 0.85))[0] * rng.uniform(0.4, 1.0)
            cv2.rectangle(canvas, (x, bottom - tall), (x + thick, bottom - 3), to_colour(back), -1)
            cv2.line(canvas, (x, bottom - tall), (x, bottom - 3), to_colour(back * 0.45), 1)
            for band in rng.uniform(0.1, 0.9, rng.integers(1, 6)):
                at = int(bottom - tall * band)
                cv2.rectangle(
                    canvas, (x + 1, at), (x + thick - 1, at + int(rng.integers(1, 6))), to_colour((back + 120) % 255), -1
                )
            x += thick + 1
            if rng.random() < 0.06:
                x += int(0.1 * scale)
        cv2.rectangle(canvas, (0, bottom - 3), (w, bottom + 3), (60, 44, 30), -1)
    return pixels(canvas + 5 * draw_noise(rng, size, 6, 2)[..., None])


def draw_window(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw panes that reflect a sky, between glazing bars and a surround."""
    h, w = size
    glass = colour_sky(draw_noise(rng, size, h, 5)) * rng.uniform(0.45, 0.7)
    canvas = np.ascontiguousarray(pixels(glass))
    bars = to_colour(draw_palette(rng, 1, (0.05, 0.5))[0] * 0.5 + 100)
    thick = max(2, int(0.05 * scale))
    for x in np.linspace(0, w, int(rng.integers(3, 5))):
        cv2.line(canvas, (int(x), 0), (int(x), h), bars, thick)
    for y in np.linspace(0, h, int(rng.integers(3, 6))):
        cv2.line(canvas, (0, int(y)), (w, int(y)), bars, thick)
    cv2.rectangle(canvas, (0, 0), (w - 1, h - 1), bars, 3 * thick)
    return pixels(canvas + 4 * draw_noise(rng, size, 5, 3)[..., None])


def draw_leaves(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    """Draw a clipped hedge."""
    canvas = np.full((*size, 3), (30, 44, 22), np.uint8)
    for _ in range(int(size[0] * size[1] / (0.035 * scale) ** 2)):
        at = int(rng.uniform(0, size[1])), int(rng.uniform(0, size[0]))
        ink = to_colour(np.array([70, 120, 50]) * rng.uniform(0.4, 1.5) + rng.normal(0, 8, 3).clip(-20, 20))
        axes = int(0.03 * scale) + 1, int(0.013 * scale) + 1
        cv2.ellipse(canvas, at, axes, rng.uniform(0, 180), 0, 360, ink, -1, cv2.LINE_AA)
    return canvas


def colour_sky(clouds: Floats) -> Floats:
    """Colour clouds from blue to white. (h, w) -> (h, w, 3)"""
    fraction = np.clip(0.5 + 0.4 * clouds, 0, 1)[..., None]
    return np.array([120.0, 160.0, 215.0]) * (1 - fraction) + np.array([245.0, 245.0, 248.0]) * fraction


def _draw_courses(
    rng: np.random.Generator,
    size: Size,
    scale: float,
    piece: tuple[float, float],
    base: np.ndarray,
    spread: float,
    grain: float = 1.0,
) -> Bytes:
    """Draw rows of pieces, `piece` = (length, height) in metres, each row shifted; every piece has its own tone and grain."""
    h, w = size
    long, tall = max(4, int(piece[0] * scale)), max(3, int(piece[1] * scale))
    y, x = np.mgrid[:h, :w]
    row = y // tall
    shift = rng.integers(0, long, int(row.max()) + 1)[row]
    column = (x + shift) // long
    tones = rng.normal(0, spread, (int(row.max()) + 1, int(column.max()) + 1))[row, column]
    fine = draw_noise(rng, (h, max(8, int(w / grain))), 0.06 * scale, 4, 0.8)
    rough = cv2.resize(fine, (w, h), interpolation=cv2.INTER_CUBIC) + 0.7 * draw_noise(rng, size, scale, 4)
    canvas = base + (tones + 5 * rough)[..., None] * np.array([1.0, 0.85, 0.75])
    joint = max(1, int(0.012 * scale))
    gap = (y % tall < joint) | ((x + shift) % long < joint)
    canvas[gap] = canvas[gap] * 0.55 + (25 if grain > 1 else 70)
    return pixels(canvas)


def _repeat_tile(tile: Bytes, size: Size) -> Floats:
    h, w = size
    th, tw = tile.shape[:2]
    return np.tile(tile, (-(-h // th), -(-w // tw), 1))[:h, :w].astype(np.float32)


@cache
def _load_grounds() -> tuple[Bytes, ...]:
    return tuple(np.asarray(decode(source.path)[0]) for source in list_ground_textures())
