"""Artworks on the walls of the gallery: each is a function of a random generator and a size, and no two are alike."""

from __future__ import annotations

import string
from collections.abc import Callable
from functools import cache

import cv2
import numpy as np

from bench.images.photographs import decode, list_objects
from bench.rendering.noise import Size, draw_noise, draw_palette, draw_voronoi, interpolate_colours, pixels, to_colour
from bench.types import Bytes

FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_PLAIN,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_SCRIPT_COMPLEX,
)
LETTERS = np.array(list(string.ascii_letters + string.digits + "&?!%#"))
SUBPIXELS = 1 << 6  # OpenCV's sub-pixel drawing counts in 1/64


def draw_picture(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw a framed picture of a random kind. -> (h, w, 3) uint8"""
    kind = KINDS[rng.integers(len(KINDS))]
    return add_frame(rng, kind(rng, size))


def draw_photograph(rng: np.random.Generator, size: Size) -> Bytes:
    """Cut a random part of that shape from one of the libraries' photographs."""
    images = _load_photographs()
    image = images[rng.integers(len(images))]
    h, w = size
    zoom = rng.uniform(0.55, 1.0) * min(image.shape[0] / h, image.shape[1] / w)
    ch, cw = max(1, int(h * zoom)), max(1, int(w * zoom))
    top, left = rng.integers(0, image.shape[0] - ch + 1), rng.integers(0, image.shape[1] - cw + 1)
    cut = image[top : top + ch, left : left + cw]
    if rng.random() < 0.5:
        cut = cut[:, ::-1]
    tinted = cv2.resize(cut, (w, h), interpolation=cv2.INTER_AREA if zoom > 1 else cv2.INTER_CUBIC) * rng.uniform(0.75, 1.0, 3)
    return pixels(tinted)


@cache
def _load_photographs() -> tuple[Bytes, ...]:
    return tuple(np.asarray(decode(source.path)[0]) for source in list_objects())


def draw_strokes(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw an abstract picture: curved strokes of a few colours, large ones first."""
    h, w = size
    palette = draw_palette(rng, 9)
    canvas = np.ascontiguousarray(pixels(interpolate_colours(0.5 + 0.25 * draw_noise(rng, size, max(size) / 2, 3), palette[:3])))
    for stroke in range(int(rng.integers(60, 160))):
        length = max(size) * rng.uniform(0.05, 0.5) / (1 + stroke / 40)
        turn = np.cumsum(rng.normal(0, 0.35, 8)) + rng.uniform(0, 2 * np.pi)
        path = np.cumsum(np.stack([np.cos(turn), np.sin(turn)], axis=1) * length / 8, axis=0) + rng.uniform(0, 1, 2) * (w, h)
        thickness = max(1, int(length * rng.uniform(0.02, 0.25)))
        cv2.polylines(
            canvas,
            [(path * SUBPIXELS).astype(np.int32)],
            False,
            to_colour(palette[rng.integers(9)]),
            thickness,
            cv2.LINE_AA,
            shift=6,
        )
    return _add_grain(rng, canvas, 4)


def draw_landscape(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw ridges behind each other under a cloudy sky, and trees before them."""
    h, w = size
    palette = draw_palette(rng, 6)
    sky = 0.5 + 0.3 * draw_noise(rng, size, w / 2, 5) + np.linspace(-0.3, 0.3, h, dtype=np.float32)[:, None]
    canvas = interpolate_colours(sky, palette[:2] * 0.5 + 120)
    down = np.arange(h, dtype=np.float32)[:, None]
    layers = int(rng.integers(4, 8))
    for layer in range(layers):
        ridge = h * (0.35 + 0.55 * layer / layers) + h * 0.09 * draw_noise(rng, (1, w), w / 3, 7, 0.55)[0]
        below = down > ridge
        texture = draw_noise(rng, size, h / (6 + 3 * layer), 5, 0.65)
        ground = palette[2 + layer % 4] * (0.35 + 0.5 * (layers - layer) / layers)
        shade = 1 + 0.28 * texture + 0.3 * np.clip((ridge - down) / h, -1, 0)
        canvas = np.where(below[..., None], ground * shade[..., None], canvas)
    canvas = np.ascontiguousarray(pixels(canvas))
    for _ in range(int(rng.integers(6, 30))):
        x, foot, tall = rng.uniform(0, w), h * rng.uniform(0.55, 1.0), h * rng.uniform(0.06, 0.3)
        shade = to_colour(palette[rng.integers(2, 6)] * rng.uniform(0.2, 0.7))
        cv2.line(canvas, (int(x), int(foot)), (int(x), int(foot - tall)), shade, max(1, int(tall / 14)), cv2.LINE_AA)
        for _ in range(9):
            at = int(x + rng.normal(0, tall / 6)), int(foot - tall * rng.uniform(0.4, 1.05))
            cv2.ellipse(canvas, at, (int(tall / 7) + 1, int(tall / 10) + 1), rng.uniform(0, 180), 0, 360, shade, -1, cv2.LINE_AA)
    return _add_grain(rng, canvas, 3)


def draw_blocks(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw rectangles from repeated splits, some filled, with dark lines between."""
    h, w = size
    canvas = np.full((h, w, 3), draw_palette(rng, 1)[0] * 0.3 + 170, np.uint8)
    palette = draw_palette(rng, 6, (0.3, 0.95))
    rectangles = [(0, 0, w, h)]
    for _ in range(int(rng.integers(25, 90))):
        index = int(rng.choice(len(rectangles), p=_compute_weights(rectangles)))
        x, y, rw, rh = rectangles.pop(index)
        part = rng.uniform(0.25, 0.75)
        if rw > rh:
            rectangles += [(x, y, int(rw * part), rh), (x + int(rw * part), y, rw - int(rw * part), rh)]
        else:
            rectangles += [(x, y, rw, int(rh * part)), (x, y + int(rh * part), rw, rh - int(rh * part))]
    line = max(1, int(min(size) * rng.uniform(0.004, 0.015)))
    for x, y, rw, rh in rectangles:
        if rng.random() < 0.6:
            cv2.rectangle(canvas, (x, y), (x + rw, y + rh), to_colour(palette[rng.integers(6)]), -1)
        cv2.rectangle(canvas, (x, y), (x + rw, y + rh), (25, 22, 20), line)
        if rng.random() < 0.3:
            cv2.circle(
                canvas, (x + rw // 2, y + rh // 2), max(2, min(rw, rh) // 3), to_colour(palette[rng.integers(6)]), -1, cv2.LINE_AA
            )
    return _add_grain(rng, canvas, 3)


def _compute_weights(rectangles: list[tuple[int, int, int, int]]) -> np.ndarray:
    areas = np.array([rw * rh for _, _, rw, rh in rectangles], np.float64) + 1
    return areas / areas.sum()


def draw_mosaic(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw Voronoi cells with joints, coloured by smooth noise."""
    number, distance, seeds = draw_voronoi(rng, size, int(rng.integers(120, 700)))
    drift = draw_noise(rng, size, max(size) / 3, 3)[seeds[:, 1], seeds[:, 0]]
    palette = interpolate_colours(0.5 + 0.3 * drift[None], draw_palette(rng, 5, (0.2, 0.9)))[0] + rng.normal(
        0, 22, (len(seeds), 3)
    )
    joint = cv2.morphologyEx(number.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    canvas = palette[number] * (1.08 - 0.012 * distance[..., None])
    canvas[joint] = rng.uniform(20, 90)
    return _add_grain(rng, pixels(canvas), 2)


def draw_marble(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw veins: the ridges of turbulent noise."""
    bent = draw_noise(rng, size, max(size) / 2, 6, 0.6)
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    turn = rng.uniform(0, np.pi)
    along = (x * np.cos(turn) + y * np.sin(turn)) / max(size) * rng.uniform(10, 30)
    veins = np.abs(np.sin(along + 2.5 * bent)) ** rng.uniform(0.25, 0.6)
    return _add_grain(rng, pixels(interpolate_colours(veins, draw_palette(rng, 4, (0.05, 0.5)))), 2)


def draw_poster(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw a headline, a picture of shapes, and lines of random words."""
    h, w = size
    palette = draw_palette(rng, 5, (0.1, 0.95))
    canvas = np.full((h, w, 3), palette[0] * 0.4 + 140, np.uint8)
    band = int(h * rng.uniform(0.35, 0.6))
    canvas[:band] = draw_blobs(rng, (band, w))
    line = band
    while line < h:
        tall = rng.choice([0.035, 0.05, 0.09]) * h
        line += int(tall * 1.5)
        ink = palette[rng.integers(1, 5)] * 0.6
        _draw_words(rng, canvas, (int(w * 0.05), line), tall, int(w * 0.9), ink)
    _draw_words(rng, canvas, (int(w * 0.05), int(h * 0.16)), h * 0.11, int(w * 0.9), palette[0] * 0.2 + rng.choice([0, 200]))
    return _add_grain(rng, canvas, 2)


def draw_text(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw a page of text in rows of changing height."""
    h, w = size
    paper, ink = (235, 25) if rng.random() < 0.7 else (30, 230)
    canvas = np.full((h, w, 3), draw_palette(rng, 1)[0] * 0.08 + paper * 0.92, np.uint8)
    line, tall = 0, h * rng.uniform(0.03, 0.06)
    while line < h:
        if rng.random() < 0.25:
            tall = h * rng.uniform(0.03, 0.13)
        line += int(tall * 1.45)
        _draw_words(rng, canvas, (int(w * 0.04), line), tall, int(w * 0.92), np.full(3, ink) + rng.normal(0, 15, 3))
    return _add_grain(rng, canvas, 2)


def _draw_words(rng: np.random.Generator, canvas: Bytes, at: tuple[int, int], tall: float, wide: int, ink: np.ndarray) -> None:
    font = FONTS[rng.integers(len(FONTS))]
    scale = tall / cv2.getTextSize("Hg", font, 1.0, 1)[0][1]
    words: list[str] = []
    while cv2.getTextSize(" ".join(words), font, scale, 1)[0][0] < wide * rng.uniform(0.7, 1.1) and len(words) < 40:
        words.append("".join(rng.choice(LETTERS, rng.integers(2, 9))))
    bold = max(1, int(tall * rng.uniform(0.06, 0.16)))
    cv2.putText(canvas, " ".join(words), at, font, scale, to_colour(np.clip(ink, 0, 255)), bold, cv2.LINE_AA)


def draw_blobs(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw overlapping discs, polygons and rings."""
    h, w = size
    palette = draw_palette(rng, 8, (0.2, 0.95))
    canvas = np.ascontiguousarray(pixels(interpolate_colours(0.5 + 0.3 * draw_noise(rng, size, max(size), 2), palette[:2])))
    for _ in range(int(rng.integers(20, 70))):
        at, r = (int(rng.uniform(0, w)), int(rng.uniform(0, h))), int(min(size) * rng.uniform(0.02, 0.22)) + 2
        ink = to_colour(palette[rng.integers(8)])
        match rng.integers(4):
            case 0:
                cv2.circle(canvas, at, r, ink, -1, cv2.LINE_AA)
            case 1:
                cv2.circle(canvas, at, r, ink, max(1, r // 5), cv2.LINE_AA)
            case 2:
                turn = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 8)))
                cv2.fillPoly(canvas, [(at + r * np.stack([np.cos(turn), np.sin(turn)], 1)).astype(np.int32)], ink, cv2.LINE_AA)
            case _:
                cv2.ellipse(canvas, at, (r, r // 3 + 1), rng.uniform(0, 180), 0, 360, ink, -1, cv2.LINE_AA)
    return _add_grain(rng, canvas, 2)


def draw_street_map(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw the map of a town: plots between crooked streets, a river, names."""
    number, _, seeds = draw_voronoi(rng, size, int(rng.integers(40, 140)))
    plots, _, _ = draw_voronoi(rng, size, 1200)
    base = draw_palette(rng, 3, (0.05, 0.35)) * 0.45 + 130
    canvas = base[0] + rng.normal(0, 9, (plots.max() + 1, 1))[plots]
    kernel = np.ones((3, 3), np.uint8)
    small = cv2.morphologyEx(plots.astype(np.float32), cv2.MORPH_GRADIENT, kernel) > 0
    streets = cv2.morphologyEx(number.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)) > 0
    canvas[small] = base[1] * 0.75
    canvas[streets] = 245
    canvas[np.abs(draw_noise(rng, size, max(size) / 1.5, 3)) < 0.06] = (110, 150, 190)
    canvas = np.ascontiguousarray(pixels(canvas))
    for x, y in seeds[:: max(1, len(seeds) // 18)]:
        _draw_words(rng, canvas, (int(x), int(y)), max(7.0, size[0] * 0.022), int(size[1] * 0.14), np.full(3, 40.0))
    return _add_grain(rng, canvas, 2)


def draw_julia(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw a Julia set, z -> z² + c, coloured by its escape time."""
    h, w = size
    turn = rng.uniform(0, 2 * np.pi)
    c = np.complex64(0.7885 * np.exp(1j * turn)) + np.complex64(rng.normal(0, 0.02))
    zoom = rng.uniform(0.5, 1.2)
    y, x = np.mgrid[-1 : 1 : h * 1j, -w / h : w / h : w * 1j].astype(np.float32) * zoom
    z = (x + rng.normal(0, 0.2) + 1j * (y + rng.normal(0, 0.2))).astype(np.complex64)
    smallest = np.full(size, 4.0, np.float32)
    escaped = np.zeros(size, np.float32)
    for _ in range(28):
        z = z * z + c
        magnitude = np.minimum(np.abs(z), 1e3)
        z[magnitude >= 1e3] = 1e3
        smallest = np.minimum(smallest, magnitude)
        escaped += magnitude < 2
    return _add_grain(rng, pixels(interpolate_colours((escaped / 28 + np.sqrt(smallest)) % 1.0, draw_palette(rng, 7))), 2)


def draw_engraving(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw hatching whose line width follows smooth noise."""
    tone = 0.5 + 0.28 * draw_noise(rng, size, max(size) / 3, 6, 0.6)
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    canvas = np.ones(size, np.float32)
    for turn in rng.uniform(0, np.pi, 2):
        bend = 6 * draw_noise(rng, size, max(size) / 2, 3)
        waves = 0.5 + 0.5 * np.sin((x * np.cos(turn) + y * np.sin(turn) + bend) * rng.uniform(0.5, 0.9))
        canvas *= np.clip(0.5 + 4 * (waves - tone), 0, 1)
    return _add_grain(
        rng,
        pixels(interpolate_colours(0.2 + 0.8 * canvas, draw_palette(rng, 2, (0.05, 0.4)) * 0.3 + np.array([[15.0], [170.0]]))),
        3,
    )


def draw_ornament(rng: np.random.Generator, size: Size) -> Bytes:
    """Draw a mirrored blot on paper, like a leaf or a butterfly."""
    h, w = size
    half = draw_noise(rng, (h, w - w // 2), max(size) / 3, 6, 0.62)
    field = np.concatenate([half[:, : w // 2][:, ::-1], half], axis=1)
    y, x = np.mgrid[-1 : 1 : h * 1j, -1 : 1 : w * 1j].astype(np.float32)
    inside = field + 1.2 - 2.2 * np.sqrt(x * x + y * y) > 0
    paper = draw_palette(rng, 1)[0] * 0.15 + 190
    canvas = np.where(inside[..., None], interpolate_colours(0.5 + 0.3 * field, draw_palette(rng, 6, (0.2, 0.9))), paper)
    edge = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    canvas[edge] = 30
    return _add_grain(rng, pixels(canvas), 3)


def _add_grain(rng: np.random.Generator, canvas: np.ndarray, strength: float) -> Bytes:
    """Add a fine grain and a slow change of tone, as of canvas or paper."""
    size = canvas.shape[0], canvas.shape[1]
    grain = strength * draw_noise(rng, size, 6, 3, 0.8) + 2 * strength * draw_noise(rng, size, max(size) / 2, 2)
    return pixels(canvas + grain[..., None])


def add_frame(rng: np.random.Generator, canvas: Bytes) -> Bytes:
    """Put the picture in a frame or a white border, or leave it bare; the size stays."""
    h, w = canvas.shape[:2]
    edge = max(3, int(min(h, w) * rng.uniform(0.03, 0.09)))
    kind = rng.integers(4)
    if kind == 0:
        return canvas
    border = np.full_like(canvas, rng.uniform(215, 245)) if kind == 1 else _draw_moulding(rng, (h, w), edge, kind == 2)
    border[edge : h - edge, edge : w - edge] = cv2.resize(canvas, (w - 2 * edge, h - 2 * edge), interpolation=cv2.INTER_AREA)
    return border


def _draw_moulding(rng: np.random.Generator, size: Size, edge: int, dark: bool) -> Bytes:
    """Draw a bevelled frame, lit from above."""
    h, w = size
    wood = (np.array([70, 48, 32]) if dark else np.array([176, 140, 72])) * rng.uniform(0.6, 1.15)
    y, x = np.mgrid[:h, :w].astype(np.float32)
    top, bottom, left, right = y, h - 1 - y, x, w - 1 - x
    depth = np.minimum(np.minimum(top, bottom), np.minimum(left, right))
    facing = np.where(depth == top, 0.25, np.where(depth == bottom, -0.3, np.where(depth == left, 0.08, -0.08)))
    profile = np.cos(depth / edge * np.pi * rng.choice([1, 2, 3]))
    grain = 0.08 * draw_noise(rng, size, edge, 3)
    return pixels(wood * (1 + facing * profile + grain)[..., None])


KINDS: tuple[Callable[[np.random.Generator, Size], Bytes], ...] = (
    draw_photograph,
    draw_strokes,
    draw_landscape,
    draw_blocks,
    draw_mosaic,
    draw_marble,
    draw_poster,
    draw_text,
    draw_blobs,
    draw_street_map,
    draw_julia,
    draw_engraving,
    draw_ornament,
)
