"""Furnishes the floor plan: wall materials, pictures and furniture, all drawn from one seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TypeVar

import numpy as np

from bench.rendering import artworks, surfaces
from bench.rendering.mipmap import Texture
from bench.rendering.noise import Size
from bench.rendering.raster import Doubles
from bench.rendering.rooms import DOORS, ROOMS, UP, Room, Wall, list_walls
from bench.types import Bytes

WALL, FLOOR, PICTURE = 180.0, 160.0, 400.0  # texels a metre
CLEAR = 1.1  # metres around furniture
HANGING = 0.03  # metres between a wall and the face of a picture

_T = TypeVar("_T")
Draw = Callable[[np.random.Generator, Size, float], Bytes]


@dataclass(frozen=True, eq=False)
class Surface:
    """A quad without lighting."""

    corner: Doubles  # (3,)
    across: Doubles  # (3,)
    down: Doubles  # (3,)
    texture: Callable[[], Texture]
    window: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    solid: bool = True  # stops light
    glow: float | None = None  # brightness of a light source


@dataclass(frozen=True)
class Footprint:
    """The floor under a piece of furniture: a rotated rectangle."""

    x: float
    y: float
    half: tuple[float, float]
    turn: float  # radians

    def distance(self, x: float, y: float) -> float:
        """Return the metres to a point outside; 0 inside."""
        c, s = np.cos(self.turn), np.sin(self.turn)
        along, beside = c * (x - self.x) + s * (y - self.y), -s * (x - self.x) + c * (y - self.y)
        return float(np.hypot(max(abs(along) - self.half[0], 0.0), max(abs(beside) - self.half[1], 0.0)))


def furnish(seed: int, *, repeats: float, bare: float, detail: float) -> tuple[list[Surface], list[Footprint]]:
    """Create all surfaces, without light, and the footprints of furniture; the parameters are those of `build`."""
    furnished = _Furnisher(np.random.default_rng([seed, 0]), seed, repeats, bare, detail)
    indoors = iter(np.random.default_rng([seed, 4]).permutation(len(WALLS)).tolist() * 2)
    for room in ROOMS:
        furnished.furnish_room(room, WALLS[next(indoors)] if room.roofed else surfaces.draw_stones)
    furnished.add_doorways()
    return furnished.surfaces, furnished.footprints


def compute_lamp_positions(room: Room) -> list[tuple[float, float]]:
    """Compute the positions of lamps: a grid about 3 m wide."""
    columns, rows = (max(1, round(side / 3)) for side in room.size)
    return [
        (room.west + room.size[0] * (i + 0.5) / columns, room.south + room.size[1] * (j + 0.5) / rows)
        for i in range(columns)
        for j in range(rows)
    ]


class _Furnisher:
    """Collects surfaces. Every texture has its own seed, and is drawn on first use."""

    def __init__(self, rng: np.random.Generator, seed: int, repeats: float, bare: float, detail: float) -> None:
        self.surfaces: list[Surface] = []
        self.footprints: list[Footprint] = []
        self._rng, self._seed, self._repeats, self._bare, self._detail = rng, seed, repeats, bare, detail
        self._texture_count = 0
        self._pictures: list[tuple[float, Callable[[], Texture]]] = []  # width / height, texture

    def furnish_room(self, room: Room, draw: Draw) -> None:
        self._add_floor(room)
        for wall in list_walls(room):
            texture = self._create_texture(draw, (wall.room.height, wall.length), WALL)
            for left, right, bottom, top in wall.pieces():
                window = left / wall.length, 1 - top / room.height, (right - left) / wall.length, (top - bottom) / room.height
                self._add_panel(wall, left, right, bottom, top, texture, window=window)
                if bottom == 0:  # a skirting board
                    board = self._create_texture(surfaces.draw_wood, (0.14, right - left), WALL)
                    self._add_panel(wall, left, right, 0.0, 0.14, board, out=0.015, solid=False)
            for start, stop in wall.free_stretches():
                self._fill_wall(wall, start, stop)
            if not room.roofed:
                self._add_upper_floor(wall)
        self._add_furniture(room)

    def add_doorways(self) -> None:
        """Add the insides of the openings."""
        for door in DOORS:
            wide, deep = door.east - door.west, door.north - door.south
            through_south = deep < wide
            texture = self._create_texture(surfaces.draw_wood, (door.height, min(wide, deep)), WALL)
            corners = {
                "north": ((door.west, door.north), (wide, 0.0)),
                "east": ((door.east, door.north), (0.0, -deep)),
                "south": ((door.east, door.south), (-wide, 0.0)),
                "west": ((door.west, door.south), (0.0, deep)),
            }
            for side in ("east", "west") if through_south else ("north", "south"):
                (x, y), (dx, dy) = corners[side]
                self._add_surface(np.array([x, y, door.height]), np.array([dx, dy, 0.0]), -UP * door.height, texture)
            lintel = self._create_texture(surfaces.draw_wood, (deep, wide), WALL)
            top = np.array([door.west, door.south, door.height])
            self._add_surface(top, np.array([wide, 0.0, 0.0]), np.array([0.0, deep, 0.0]), lintel)
            sill = self._create_texture(surfaces.draw_stones, (deep, wide), WALL)
            self._add_surface(
                np.array([door.west, door.north, 0.0]), np.array([wide, 0.0, 0.0]), np.array([0.0, -deep, 0.0]), sill
            )

    def _add_floor(self, room: Room) -> None:
        rng = self._rng
        (wide, deep), x, y = room.size, room.west, room.south
        draw = _choose(rng, FLOORS if room.roofed else GROUNDS)
        across, down = np.array([wide, 0.0, 0.0]), np.array([0.0, -deep, 0.0])
        self._add_surface(np.array([x, room.north, 0.0]), across, down, self._create_texture(draw, (deep, wide), FLOOR))
        if room.roofed:
            ceiling = self._create_texture(
                _choose(rng, (surfaces.draw_plaster, surfaces.draw_floorboards)), (deep, wide), FLOOR / 2
            )
            self._add_surface(np.array([x, y, room.height]), across, -down, ceiling)
            white = self._create_texture(surfaces.draw_plaster, (0.4, 0.4), WALL)
            for lx, ly in compute_lamp_positions(room):
                corner = np.array([lx - 0.3, ly - 0.3, room.height - 0.05])
                self._add_surface(corner, np.array([0.6, 0.0, 0.0]), np.array([0.0, 0.6, 0.0]), white, solid=False, glow=13.0)
            rug = self._create_texture(surfaces.draw_carpet, (deep * 0.4, wide * 0.45), FLOOR)
            self._add_surface(
                np.array([x + 0.25 * wide, room.north - 0.3 * deep, 0.01]), across * 0.45, down * 0.4, rug, solid=False
            )
        else:
            lawn = self._create_texture(surfaces.draw_ground, (deep * 0.4, wide * 0.4), FLOOR)
            self._add_surface(
                np.array([x + 0.3 * wide, room.north - 0.3 * deep, 0.02]), across * 0.4, down * 0.4, lawn, solid=False
            )

    def _fill_wall(self, wall: Wall, start: float, stop: float) -> None:
        """Hang pictures along a stretch of wall, or place a bookcase before it."""
        rng = self._rng
        at = start + rng.uniform(0.15, 0.4)
        while stop - at > 0.55:
            wide = min(rng.uniform(0.5, 1.6), stop - at - 0.1)
            if wall.room.roofed and wide > 1.1 and rng.random() < 0.18:
                self._add_bookcase(wall, at, wide)
            elif rng.random() >= self._bare:
                self._hang_pictures(wall, at, wide)
            at += wide + rng.uniform(0.1, 0.45)

    def _hang_pictures(self, wall: Wall, at: float, wide: float) -> None:
        """Hang one picture, or two or three above each other."""
        rng = self._rng
        bottom = rng.uniform(0.7, 1.1)
        limit = min(wall.room.height - 0.3, 3.1)
        while limit - bottom > 0.4:
            tall = min(wide * rng.uniform(0.6, 1.5), limit - bottom, 1.9)
            texture = self._choose_picture(wide, tall)
            self._add_panel(wall, at, at + wide, bottom, bottom + tall, texture, out=HANGING, solid=False)
            bottom += tall + rng.uniform(0.1, 0.25)
            if rng.random() < 0.3:
                break

    def _add_upper_floor(self, wall: Wall) -> None:
        rng = self._rng
        at = rng.uniform(0.5, 1.0)
        while at + 1.3 < wall.length:
            texture = self._create_texture(surfaces.draw_window, (1.7, 1.2), WALL)
            self._add_panel(wall, at, at + 1.2, 3.9, 5.6, texture, out=0.02, solid=False)
            if rng.random() < 0.4:  # a banner between windows
                self._add_panel(wall, at + 1.35, at + 1.85, 3.4, 5.9, self._choose_picture(0.5, 2.5), out=0.15, solid=False)
            at += 1.2 + rng.uniform(0.7, 1.1)

    def _add_bookcase(self, wall: Wall, at: float, wide: float) -> None:
        tall, deep = self._rng.uniform(1.8, 2.3), 0.35
        front = self._create_texture(surfaces.draw_shelves, (tall, wide), PICTURE * 0.75)
        centre = wall.point_at(at + wide / 2, 0.0, deep / 2)
        self._add_box(
            centre, (wide, deep, tall), float(np.arctan2(wall.along[1], wall.along[0])), surfaces.draw_wood, faces={0: front}
        )

    def _add_furniture(self, room: Room) -> None:
        rng = self._rng
        for item in _choose(rng, (INDOORS, INDOORS[::-1])) if room.roofed else OUTDOORS:
            for _ in range(40):
                x, y = rng.uniform(room.west, room.east), rng.uniform(room.south, room.north)
                clear = all(np.hypot(*(door.centre - (x, y))) > 2.2 for door in DOORS)
                if room.contains(x, y, 1.6) and clear and all(other.distance(x, y) > 2 * CLEAR for other in self.footprints):
                    item(self, np.array([x, y, 0.0]), rng.uniform(0, np.pi))
                    break

    def _add_screen(self, at: Doubles, turn: float) -> None:
        """Add a free-standing screen with pictures on both sides."""
        wide, tall = self._rng.uniform(1.6, 2.4), self._rng.uniform(1.9, 2.2)
        both = {side: self._create_pinboard(wide, tall) for side in (0, 2)}
        self._add_box(at, (wide, 0.1, tall), turn, surfaces.draw_wood, faces=both)

    def _add_plinth(self, at: Doubles, turn: float) -> None:
        self._add_box(at, (0.5, 0.5, 1.0), turn, _draw_marble)
        self._add_box(at + UP, (0.32, 0.32, 0.5), turn + 0.6, _draw_blobs, footprint=False)

    def _add_bench(self, at: Doubles, turn: float) -> None:
        self._add_box(at, (1.6, 0.5, 0.45), turn, surfaces.draw_floorboards)

    def _add_cabinet(self, at: Doubles, turn: float) -> None:
        self._add_box(at, (1.1, 0.6, 0.95), turn, surfaces.draw_wood, faces={0: self._create_pinboard(1.1, 0.95)})

    def _add_hedge(self, at: Doubles, turn: float) -> None:
        self._add_box(at, (1.5, 1.0, 0.45), turn, surfaces.draw_stones)
        self._add_box(at + 0.45 * UP, (1.35, 0.85, 0.6), turn, surfaces.draw_leaves, footprint=False)

    def _add_kiosk(self, at: Doubles, turn: float) -> None:
        """Add a column of eight sides, covered in posters."""
        radius, tall = 0.75, 2.6
        edges = turn + np.arange(9) * np.pi / 4
        rim = at + radius * np.stack([np.cos(edges), np.sin(edges), 0 * edges], axis=1) + tall * UP  # (9, 3)
        for left, right in pairwise(rim):
            self._add_surface(left, right - left, -UP * tall, self._create_pinboard(float(np.linalg.norm(right - left)), tall))
        self.footprints.append(Footprint(at[0], at[1], (radius * 0.8, radius * 0.8), turn))

    def _create_pinboard(self, wide: float, tall: float) -> Callable[[], Texture]:
        """Create a pinboard with a few pictures."""

        def draw(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
            canvas = surfaces.draw_plaster(rng, size, scale)
            h, w = size
            for _ in range(max(1, int(h * w / scale**2 * 2.5))):
                side = rng.uniform(0.3, 0.75, 2) * scale
                ph, pw = min(int(side[0]), h - 4), min(int(side[1]), w - 4)
                top, left = rng.integers(0, h - ph), rng.integers(0, w - pw)
                canvas[top : top + ph, left : left + pw] = artworks.draw_picture(rng, (ph, pw))
            return canvas

        return self._create_texture(draw, (tall, wide), PICTURE * 0.8)

    def _add_box(
        self,
        at: Doubles,
        size: tuple[float, float, float],
        turn: float,
        draw: Draw,
        faces: dict[int, Callable[[], Texture]] | None = None,
        footprint: bool = True,
    ) -> None:
        """Add a box on `at`; `size` is length, depth, height, and face 0 the long one that faces its own -y."""
        long, deep, tall = size
        x = np.array([np.cos(turn), np.sin(turn), 0.0])
        y = np.array([-np.sin(turn), np.cos(turn), 0.0])
        top = at + UP * tall
        sides = [(x, long, y, deep), (y, deep, -x, long), (-x, long, -y, deep), (-y, deep, x, long)]
        for number, (along, length, behind, depth) in enumerate(sides):
            corner = top - along * length / 2 - behind * depth / 2
            texture = (faces or {}).get(number) or self._create_texture(draw, (tall, length), WALL)
            self._add_surface(corner, along * length, -UP * tall, texture)
        self._add_surface(top - x * long / 2 + y * deep / 2, x * long, -y * deep, self._create_texture(draw, (deep, long), WALL))
        if footprint:
            self.footprints.append(Footprint(float(at[0]), float(at[1]), (long / 2, deep / 2), turn))

    def _add_panel(
        self,
        wall: Wall,
        left: float,
        right: float,
        bottom: float,
        top: float,
        texture: Callable[[], Texture],
        out: float = 0.0,
        window: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0),
        solid: bool = True,
    ) -> None:
        self._add_surface(
            wall.point_at(left, top, out), wall.along * (right - left), -UP * (top - bottom), texture, window, solid
        )

    def _add_surface(
        self,
        corner: Doubles,
        across: Doubles,
        down: Doubles,
        texture: Callable[[], Texture],
        window: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0),
        solid: bool = True,
        glow: float | None = None,
    ) -> None:
        self.surfaces.append(Surface(corner, across, down, texture, window, solid, glow))

    def _choose_picture(self, wide: float, tall: float) -> Callable[[], Texture]:
        """Create a picture, or repeat one of similar shape."""
        similar = [texture for shape, texture in self._pictures if abs(np.log(shape * tall / wide)) < 0.15]
        if similar and self._rng.random() < self._repeats:
            return similar[self._rng.integers(len(similar))]
        texture = self._create_texture(lambda rng, size, scale: artworks.draw_picture(rng, size), (tall, wide), PICTURE)
        self._pictures.append((wide / tall, texture))
        return texture

    def _create_texture(self, draw: Draw, size: tuple[float, float], scale: float) -> Callable[[], Texture]:
        """Create a texture of (height, width) metres, drawn on first use."""
        self._texture_count += 1
        key = [self._seed, 3, self._texture_count]
        scale *= self._detail
        h, w = (max(8, round(side * scale)) for side in size)
        return cache(lambda: Texture.of(draw(np.random.default_rng(key), (h, w), scale)))


def _draw_marble(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    return artworks.draw_marble(rng, size)


def _draw_blobs(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    return artworks.draw_blobs(rng, size)


def _choose(rng: np.random.Generator, options: tuple[_T, ...]) -> _T:
    return options[rng.integers(len(options))]


WALLS: tuple[Draw, ...] = (surfaces.draw_plaster, surfaces.draw_wallpaper, surfaces.draw_bricks, surfaces.draw_plaster)  # indoors
FLOORS: tuple[Draw, ...] = (surfaces.draw_floorboards, surfaces.draw_tiles)
GROUNDS: tuple[Draw, ...] = (surfaces.draw_cobbles, surfaces.draw_ground)
INDOORS = (_Furnisher._add_screen, _Furnisher._add_plinth, _Furnisher._add_bench, _Furnisher._add_cabinet, _Furnisher._add_screen)
OUTDOORS = (
    _Furnisher._add_kiosk,
    _Furnisher._add_hedge,
    _Furnisher._add_bench,
    _Furnisher._add_plinth,
    _Furnisher._add_screen,
    _Furnisher._add_hedge,
    _Furnisher._add_kiosk,
)
