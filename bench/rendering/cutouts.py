"""Cut-outs of people for the foreground: drawn ones, each in different clothes, and three from photographs.

People in the map and people in queries differ: other draws, other photographs.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bench.images.photographs import decode, list_people
from bench.rendering.artworks import draw_blobs, draw_mosaic, draw_text
from bench.rendering.noise import draw_noise, draw_palette, pixels, to_colour
from bench.types import Bytes, Floats

TALL, WIDE = 480, 224  # pixels of a cut-out

Ink = tuple[int, int, int]

# Outlines in the pixels of the photographs, traced by hand.
ASTRONAUT = (
    (205, 22), (237, 15), (262, 24), (286, 42), (297, 60), (298, 90), (285, 108), (268, 118), (260, 140), (266, 160), (290, 196),
    (300, 230), (322, 243), (342, 264), (352, 300), (360, 330), (400, 322), (450, 338), (488, 378), (505, 430), (503, 490),
    (495, 511), (26, 511), (22, 470), (19, 390), (26, 345), (40, 305), (62, 250), (90, 227), (113, 203), (124, 180), (150, 157),
    (186, 150), (184, 125), (172, 110), (156, 94), (152, 66), (170, 42),
)  # fmt: skip
CAMERAMAN = (
    (235, 70), (192, 69), (172, 87), (161, 106), (115, 122), (60, 158), (20, 206), (3, 284), (10, 335), (75, 415), (98, 430),
    (105, 511), (153, 511), (152, 470), (168, 400), (190, 345), (225, 297), (262, 305), (303, 283), (306, 250), (292, 228),
    (306, 232), (325, 238), (365, 228), (366, 200), (352, 190), (330, 176), (305, 178), (281, 180), (267, 172), (261, 155),
    (268, 140), (258, 130), (269, 112),
)  # fmt: skip
ADMIRAL = (
    (256, 20), (230, 27), (205, 40), (180, 62), (172, 88), (155, 104), (148, 126), (150, 165), (158, 195), (160, 260), (172, 290),
    (196, 305), (201, 322), (147, 350), (100, 362), (62, 376), (44, 405), (40, 450), (40, 599), (504, 599), (502, 450),
    (498, 408), (480, 386), (422, 362), (345, 322), (340, 300), (352, 285), (362, 262), (366, 225), (374, 205), (374, 160),
    (371, 100), (352, 84), (335, 52), (300, 30),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Person:
    """A picture of a person with its opacity."""

    pixels: Bytes  # (h, w, 3)
    opacity: Floats  # (h, w) 0 to 1
    tall: float  # metres

    @property
    def wide(self) -> float:
        """Metres."""
        h, w = self.opacity.shape
        return self.tall * w / h


def create_map_people(rng: np.random.Generator, count: int) -> list[Person]:
    """Create the people of reference views."""
    _, cameraman, _ = (np.asarray(decode(source.path)[0]) for source in list_people())
    sepia = pixels(cameraman * np.array([1.0, 0.93, 0.82]))
    return [_cut_out(sepia, CAMERAMAN, tall=1.5), *(draw_person(rng) for _ in range(count - 1))]


def create_query_people(rng: np.random.Generator, count: int) -> list[Person]:
    """Create the people of query views."""
    astronaut, _, admiral = (np.asarray(decode(source.path)[0]) for source in list_people())
    # Each twice, in other trousers: photographed faces show what an attack recovers.
    busts = [_stand_bust(rng, *bust) for bust in ((astronaut, ASTRONAUT, 196), (admiral, ADMIRAL, 140)) for _ in range(2)]
    return busts + [draw_person(rng) for _ in range(count - len(busts))]


def draw_person(rng: np.random.Generator) -> Person:
    """Draw a person from head to shoes."""
    canvas, opacity = np.zeros((TALL, WIDE, 3), np.uint8), np.zeros((TALL, WIDE), np.uint8)
    _draw_legs(rng, canvas, opacity, top=250)
    skin = to_colour(np.array([236.0, 192.0, 162.0]) * rng.uniform(0.4, 1.0))
    _draw_torso(rng, canvas, opacity, skin)
    _draw_head(rng, canvas, opacity, skin)
    return _create_person(rng, canvas, opacity, rng.uniform(1.6, 1.85))


def _create_person(rng: np.random.Generator, canvas: Bytes, opacity: Bytes, tall: float) -> Person:
    folds = 1 + 0.1 * draw_noise(rng, canvas.shape[:2], 60, 5, 0.7)
    return Person(pixels(canvas * folds[..., None]), _scale_opacity(opacity), tall)


def _scale_opacity(opacity: Bytes) -> Floats:
    """Scale 0 to 255 to 0 to 1."""
    return (opacity / 255).astype(np.float32)


def _fill(canvas: Bytes, opacity: Bytes, outline: list[tuple[float, float]], cloth: Bytes | Ink) -> None:
    """Fill a closed, rounded outline with a cloth."""
    points = np.array(outline, np.float32)
    shape = np.zeros(opacity.shape, np.uint8)
    cv2.fillPoly(shape, [points.astype(np.int32)], 255, cv2.LINE_AA)
    shape = ((cv2.GaussianBlur(shape, (0, 0), 3) > 127) * 255).astype(np.uint8)
    inside = shape > 0
    canvas[inside] = cloth[inside] if isinstance(cloth, np.ndarray) else cloth
    edge = inside & (cv2.erode(shape, np.ones((5, 5), np.uint8)) == 0)
    canvas[edge] = (canvas[edge] * 0.6).astype(np.uint8)
    np.maximum(opacity, shape, out=opacity)


def _draw_cloth(rng: np.random.Generator) -> Bytes:
    """Draw a plain, striped, checked, printed or flowered cloth. -> (TALL, WIDE, 3)"""
    size = TALL, WIDE
    first, second = draw_palette(rng, 2, (0.1, 0.9))
    y, x = np.mgrid[:TALL, :WIDE]
    stripe = int(rng.integers(6, 22))
    match rng.integers(6):
        case 0:
            return pixels(first + 4 * draw_noise(rng, size, 4, 2)[..., None])
        case 1:
            return np.where(((y // stripe) % 2 == 0)[..., None], first, second).astype(np.uint8)
        case 2:
            return pixels((first * ((y // stripe) % 2)[..., None] + second * ((x // stripe) % 2)[..., None]) / 2 + 40)
        case 3:
            cloth = np.full((*size, 3), first, np.uint8)
            cloth[115:195, 72:152] = draw_text(rng, (80, 80)) if rng.random() < 0.5 else draw_blobs(rng, (80, 80))
            return cloth
        case 4:
            return draw_blobs(rng, size)
        case _:
            return draw_mosaic(rng, size)


def _draw_torso(rng: np.random.Generator, canvas: Bytes, opacity: Bytes, skin: Ink) -> None:
    cloth = _draw_cloth(rng)
    slim = rng.uniform(0.82, 1.1)

    def at(x: float, y: float) -> tuple[float, float]:
        return WIDE / 2 + x * slim, y

    for side in (-1, 1):
        swing = rng.uniform(0, 22)
        hand = at(side * (72 + swing), 262)
        cv2.circle(canvas, (int(hand[0]), int(hand[1])), 10, skin, -1, cv2.LINE_AA)
        cv2.circle(opacity, (int(hand[0]), int(hand[1])), 10, 255, -1, cv2.LINE_AA)
        sleeve = [
            (40, 84),
            (62, 96),
            (78 + swing * 0.6, 180),
            (84 + swing, 256),
            (64 + swing, 258),
            (56 + swing * 0.4, 190),
            (40, 130),
        ]
        _fill(canvas, opacity, [at(side * x, y) for x, y in sleeve], cloth)
    trunk = [(-18, 74), (18, 74), (52, 86), (58, 120), (48, 190), (52, 268), (-52, 268), (-48, 190), (-58, 120), (-52, 86)]
    _fill(canvas, opacity, [at(x, y) for x, y in trunk], cloth)


def _draw_legs(rng: np.random.Generator, canvas: Bytes, opacity: Bytes, top: int) -> None:
    cloth = pixels(
        draw_palette(rng, 1, (0.05, 0.5))[0] * rng.uniform(0.2, 0.8) + 5 * draw_noise(rng, (TALL, WIDE), 4, 2)[..., None]
    )
    middle = WIDE / 2
    for side in (-1, 1):
        stride = rng.uniform(4, 26)
        leg = [(0, top), (50, top), (48 + stride * 0.4, 360), (38 + stride, 458), (12 + stride, 458), (10 + stride * 0.3, 360)]
        shoe = [(10 + stride, 452), (40 + stride, 452), (54 + stride, 476), (10 + stride, 476)]
        _fill(canvas, opacity, [(middle + side * x, y) for x, y in shoe], to_colour(draw_palette(rng, 1)[0] * 0.4))
        _fill(canvas, opacity, [(middle + side * x, y) for x, y in leg], cloth)


def _draw_head(rng: np.random.Generator, canvas: Bytes, opacity: Bytes, skin: Ink) -> None:
    x, y = WIDE // 2, 42
    hair = to_colour(np.array([120.0, 84.0, 52.0]) * rng.uniform(0.15, 1.5))
    for layer, ink in ((canvas, hair), (opacity, 255)):
        cv2.ellipse(layer, (x, y - 4), (29, 36 + int(rng.integers(0, 3))), 0, 0, 360, ink, -1, cv2.LINE_AA)
        cv2.rectangle(layer, (x - 11, y + 20), (x + 11, y + 42), skin if layer is canvas else 255, -1)
    cv2.ellipse(canvas, (x, y + 5), (23, 31), 0, 0, 360, skin, -1, cv2.LINE_AA)
    dark = to_colour(np.array(skin) * 0.35)
    for side in (-1, 1):
        cv2.ellipse(canvas, (x + 9 * side, y + 1), (5, 3), 0, 0, 360, (240, 240, 240), -1, cv2.LINE_AA)
        cv2.circle(canvas, (x + 9 * side, y + 1), 2, (30, 25, 20), -1, cv2.LINE_AA)
        cv2.line(canvas, (x + 4 * side, y - 7), (x + 14 * side, y - 8 + int(rng.integers(0, 3))), dark, 2, cv2.LINE_AA)
    cv2.line(canvas, (x, y + 3), (x + 2, y + 13), dark, 1, cv2.LINE_AA)
    cv2.ellipse(canvas, (x, y + 20), (8, 3), 0, 0, 180, (150, 60, 60), 2, cv2.LINE_AA)
    if rng.random() < 0.35:
        for side in (-1, 1):
            cv2.circle(canvas, (x + 9 * side, y + 1), 7, (20, 20, 20), 1, cv2.LINE_AA)


def _cut_out(photograph: Bytes, outline: tuple[tuple[int, int], ...], tall: float) -> Person:
    """Cut out the inside of the outline, cropped to it."""
    points = np.array(outline)
    opacity = np.zeros(photograph.shape[:2], np.uint8)
    cv2.fillPoly(opacity, [points], 255, cv2.LINE_AA)
    (left, top), (right, bottom) = points.min(axis=0), points.max(axis=0) + 1
    area = slice(top, bottom), slice(left, right)
    return Person(np.ascontiguousarray(photograph[area]), _scale_opacity(opacity[area]), tall)


def _stand_bust(rng: np.random.Generator, photograph: Bytes, outline: tuple[tuple[int, int], ...], wide: int) -> Person:
    """Put a photographed bust, `wide` pixels wide, on drawn legs."""
    bust = _cut_out(photograph, outline, tall=0.0)
    h, w = bust.opacity.shape
    tall = round(h * wide / w)
    canvas, opacity = np.zeros((TALL, WIDE, 3), np.uint8), np.zeros((TALL, WIDE), np.uint8)
    _draw_legs(rng, canvas, opacity, top=tall - 20)
    left = (WIDE - wide) // 2
    area = slice(0, tall), slice(left, left + wide)
    bust_opacity = cv2.resize(bust.opacity, (wide, tall), interpolation=cv2.INTER_AREA)
    solid = bust_opacity > 0.5
    canvas[area][solid] = cv2.resize(bust.pixels, (wide, tall), interpolation=cv2.INTER_AREA)[solid]
    opacity[area][solid] = 255
    return Person(canvas, _scale_opacity(opacity), tall=1.78)
