"""Furnishes the floor plan: what the walls are made of, what hangs on them and what stands about, all drawn from one seed."""

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
from bench.rendering.rooms import DOORS, ROOMS, UP, Room, Wall, walls
from bench.types import Bytes

WALL, FLOOR, PICTURE = 180.0, 160.0, 400.0  # texels a metre
CLEAR = 1.1  # metres around what stands in a room
HANGING = 0.03  # metres between a wall and the face of what hangs on it

_T = TypeVar("_T")
Make = Callable[[np.random.Generator, Size, float], Bytes]


@dataclass(frozen=True, eq=False)
class Surface:
    """A quad that has not been lit."""

    corner: Doubles  # (3,)
    across: Doubles  # (3,)
    down: Doubles  # (3,)
    texture: Callable[[], Texture]
    window: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    solid: bool = True  # stops light
    glow: float | None = None  # shines by itself, this bright


@dataclass(frozen=True)
class Footprint:
    """The floor that something stands on: a turned rectangle."""

    x: float
    y: float
    half: tuple[float, float]
    turn: float  # radians

    def distance(self, x: float, y: float) -> float:
        """Metres from a point outside; 0 inside."""
        c, s = np.cos(self.turn), np.sin(self.turn)
        along, beside = c * (x - self.x) + s * (y - self.y), -s * (x - self.x) + c * (y - self.y)
        return float(np.hypot(max(abs(along) - self.half[0], 0.0), max(abs(beside) - self.half[1], 0.0)))


def furnish(seed: int, *, repeats: float, bare: float, detail: float) -> tuple[list[Surface], list[Footprint]]:
    """All surfaces, without light, and what stands on the floor; the parameters are those of `build`."""
    furnished = _Furnisher(np.random.default_rng([seed, 0]), seed, repeats, bare, detail)
    indoors = iter(np.random.default_rng([seed, 4]).permutation(len(WALLS)).tolist() * 2)
    for room in ROOMS:
        furnished.room(room, WALLS[next(indoors)] if room.roofed else surfaces.stones)
    furnished.doorways()
    return furnished.surfaces, furnished.standing


def lamps(room: Room) -> list[tuple[float, float]]:
    """Where lamps hang: a grid about 3 m wide."""
    columns, rows = (max(1, round(side / 3)) for side in room.size)
    return [
        (room.west + room.size[0] * (i + 0.5) / columns, room.south + room.size[1] * (j + 0.5) / rows)
        for i in range(columns)
        for j in range(rows)
    ]


class _Furnisher:
    """Collects surfaces; every texture has a seed of its own, and is painted when it is first looked at."""

    def __init__(self, rng: np.random.Generator, seed: int, repeats: float, bare: float, detail: float) -> None:
        self.surfaces: list[Surface] = []
        self.standing: list[Footprint] = []
        self._rng, self._seed, self._repeats, self._bare, self._detail = rng, seed, repeats, bare, detail
        self._painted = 0
        self._pictures: list[tuple[float, Callable[[], Texture]]] = []  # width / height, texture

    def room(self, room: Room, make: Make) -> None:
        self._floor(room)
        for wall in walls(room):
            texture = self._paint(make, (wall.room.height, wall.length), WALL)
            for left, right, bottom, top in wall.pieces():
                window = left / wall.length, 1 - top / room.height, (right - left) / wall.length, (top - bottom) / room.height
                self._panel(wall, left, right, bottom, top, texture, window=window)
                if bottom == 0:  # a skirting board
                    board = self._paint(surfaces.wood, (0.14, right - left), WALL)
                    self._panel(wall, left, right, 0.0, 0.14, board, out=0.015, solid=False)
            for start, stop in wall.free():
                self._fill(wall, start, stop)
            if not room.roofed:
                self._upper_floor(wall)
        self._stand_about(room)

    def doorways(self) -> None:
        """The insides of the openings."""
        for door in DOORS:
            wide, deep = door.east - door.west, door.north - door.south
            through_south = deep < wide
            texture = self._paint(surfaces.wood, (door.height, min(wide, deep)), WALL)
            corners = {
                "north": ((door.west, door.north), (wide, 0.0)),
                "east": ((door.east, door.north), (0.0, -deep)),
                "south": ((door.east, door.south), (-wide, 0.0)),
                "west": ((door.west, door.south), (0.0, deep)),
            }
            for side in ("east", "west") if through_south else ("north", "south"):
                (x, y), (dx, dy) = corners[side]
                self._add(np.array([x, y, door.height]), np.array([dx, dy, 0.0]), -UP * door.height, texture)
            lintel = self._paint(surfaces.wood, (deep, wide), WALL)
            top = np.array([door.west, door.south, door.height])
            self._add(top, np.array([wide, 0.0, 0.0]), np.array([0.0, deep, 0.0]), lintel)
            sill = self._paint(surfaces.stones, (deep, wide), WALL)
            self._add(np.array([door.west, door.north, 0.0]), np.array([wide, 0.0, 0.0]), np.array([0.0, -deep, 0.0]), sill)

    def _floor(self, room: Room) -> None:
        rng = self._rng
        (wide, deep), x, y = room.size, room.west, room.south
        make = _choose(rng, FLOORS if room.roofed else GROUNDS)
        across, down = np.array([wide, 0.0, 0.0]), np.array([0.0, -deep, 0.0])
        self._add(np.array([x, room.north, 0.0]), across, down, self._paint(make, (deep, wide), FLOOR))
        if room.roofed:
            ceiling = self._paint(_choose(rng, (surfaces.plaster, surfaces.boards)), (deep, wide), FLOOR / 2)
            self._add(np.array([x, y, room.height]), across, -down, ceiling)
            white = self._paint(surfaces.plaster, (0.4, 0.4), WALL)
            for lx, ly in lamps(room):
                corner = np.array([lx - 0.3, ly - 0.3, room.height - 0.05])
                self._add(corner, np.array([0.6, 0.0, 0.0]), np.array([0.0, 0.6, 0.0]), white, solid=False, glow=13.0)
            rug = self._paint(surfaces.carpet, (deep * 0.4, wide * 0.45), FLOOR)
            self._add(np.array([x + 0.25 * wide, room.north - 0.3 * deep, 0.01]), across * 0.45, down * 0.4, rug, solid=False)
        else:
            lawn = self._paint(surfaces.ground, (deep * 0.4, wide * 0.4), FLOOR)
            self._add(np.array([x + 0.3 * wide, room.north - 0.3 * deep, 0.02]), across * 0.4, down * 0.4, lawn, solid=False)

    def _fill(self, wall: Wall, start: float, stop: float) -> None:
        """Hang pictures along a stretch of wall, or stand a bookcase before it."""
        rng = self._rng
        at = start + rng.uniform(0.15, 0.4)
        while stop - at > 0.55:
            wide = min(rng.uniform(0.5, 1.6), stop - at - 0.1)
            if wall.room.roofed and wide > 1.1 and rng.random() < 0.18:
                self._bookcase(wall, at, wide)
            elif rng.random() >= self._bare:
                self._hang(wall, at, wide)
            at += wide + rng.uniform(0.1, 0.45)

    def _hang(self, wall: Wall, at: float, wide: float) -> None:
        """One picture, or two or three above each other."""
        rng = self._rng
        bottom = rng.uniform(0.7, 1.1)
        limit = min(wall.room.height - 0.3, 3.1)
        while limit - bottom > 0.4:
            tall = min(wide * rng.uniform(0.6, 1.5), limit - bottom, 1.9)
            texture = self._picture(wide, tall)
            self._panel(wall, at, at + wide, bottom, bottom + tall, texture, out=HANGING, solid=False)
            bottom += tall + rng.uniform(0.1, 0.25)
            if rng.random() < 0.3:
                break

    def _upper_floor(self, wall: Wall) -> None:
        rng = self._rng
        at = rng.uniform(0.5, 1.0)
        while at + 1.3 < wall.length:
            texture = self._paint(surfaces.window, (1.7, 1.2), WALL)
            self._panel(wall, at, at + 1.2, 3.9, 5.6, texture, out=0.02, solid=False)
            if rng.random() < 0.4:  # a banner between windows
                self._panel(wall, at + 1.35, at + 1.85, 3.4, 5.9, self._picture(0.5, 2.5), out=0.15, solid=False)
            at += 1.2 + rng.uniform(0.7, 1.1)

    def _bookcase(self, wall: Wall, at: float, wide: float) -> None:
        tall, deep = self._rng.uniform(1.8, 2.3), 0.35
        front = self._paint(surfaces.shelves, (tall, wide), PICTURE * 0.75)
        centre = wall.at(at + wide / 2, 0.0, deep / 2)
        self._box(centre, (wide, deep, tall), float(np.arctan2(wall.along[1], wall.along[0])), surfaces.wood, faces={0: front})

    def _stand_about(self, room: Room) -> None:
        rng = self._rng
        for item in _choose(rng, (INDOORS, INDOORS[::-1])) if room.roofed else OUTDOORS:
            for _ in range(40):
                x, y = rng.uniform(room.west, room.east), rng.uniform(room.south, room.north)
                clear = all(np.hypot(*(door.centre - (x, y))) > 2.2 for door in DOORS)
                if room.holds(x, y, 1.6) and clear and all(other.distance(x, y) > 2 * CLEAR for other in self.standing):
                    item(self, np.array([x, y, 0.0]), rng.uniform(0, np.pi))
                    break

    def _screen(self, at: Doubles, turn: float) -> None:
        """A free-standing screen with pictures on both sides."""
        wide, tall = self._rng.uniform(1.6, 2.4), self._rng.uniform(1.9, 2.2)
        both = {side: self._sheet(wide, tall) for side in (0, 2)}
        self._box(at, (wide, 0.1, tall), turn, surfaces.wood, faces=both)

    def _plinth(self, at: Doubles, turn: float) -> None:
        self._box(at, (0.5, 0.5, 1.0), turn, _marbled)
        self._box(at + UP, (0.32, 0.32, 0.5), turn + 0.6, _abstract, footprint=False)

    def _bench(self, at: Doubles, turn: float) -> None:
        self._box(at, (1.6, 0.5, 0.45), turn, surfaces.boards)

    def _cabinet(self, at: Doubles, turn: float) -> None:
        self._box(at, (1.1, 0.6, 0.95), turn, surfaces.wood, faces={0: self._sheet(1.1, 0.95)})

    def _hedge(self, at: Doubles, turn: float) -> None:
        self._box(at, (1.5, 1.0, 0.45), turn, surfaces.stones)
        self._box(at + 0.45 * UP, (1.35, 0.85, 0.6), turn, surfaces.leaves, footprint=False)

    def _kiosk(self, at: Doubles, turn: float) -> None:
        """A column of eight sides, covered in posters."""
        radius, tall = 0.75, 2.6
        edges = turn + np.arange(9) * np.pi / 4
        rim = at + radius * np.stack([np.cos(edges), np.sin(edges), 0 * edges], axis=1) + tall * UP  # (9, 3)
        for left, right in pairwise(rim):
            self._add(left, right - left, -UP * tall, self._sheet(float(np.linalg.norm(right - left)), tall))
        self.standing.append(Footprint(at[0], at[1], (radius * 0.8, radius * 0.8), turn))

    def _sheet(self, wide: float, tall: float) -> Callable[[], Texture]:
        """A board with a few pictures on it."""

        def board(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
            canvas = surfaces.plaster(rng, size, scale)
            h, w = size
            for _ in range(max(1, int(h * w / scale**2 * 2.5))):
                side = rng.uniform(0.3, 0.75, 2) * scale
                ph, pw = min(int(side[0]), h - 4), min(int(side[1]), w - 4)
                top, left = rng.integers(0, h - ph), rng.integers(0, w - pw)
                canvas[top : top + ph, left : left + pw] = artworks.picture(rng, (ph, pw))
            return canvas

        return self._paint(board, (tall, wide), PICTURE * 0.8)

    def _box(
        self,
        at: Doubles,
        size: tuple[float, float, float],
        turn: float,
        make: Make,
        faces: dict[int, Callable[[], Texture]] | None = None,
        footprint: bool = True,
    ) -> None:
        """A box upon `at`; `size` is length, depth, height, face 0 the long one that looks against its own y."""
        long, deep, tall = size
        x = np.array([np.cos(turn), np.sin(turn), 0.0])
        y = np.array([-np.sin(turn), np.cos(turn), 0.0])
        top = at + UP * tall
        sides = [(x, long, y, deep), (y, deep, -x, long), (-x, long, -y, deep), (-y, deep, x, long)]
        for number, (along, length, behind, depth) in enumerate(sides):
            corner = top - along * length / 2 - behind * depth / 2
            texture = (faces or {}).get(number) or self._paint(make, (tall, length), WALL)
            self._add(corner, along * length, -UP * tall, texture)
        self._add(top - x * long / 2 + y * deep / 2, x * long, -y * deep, self._paint(make, (deep, long), WALL))
        if footprint:
            self.standing.append(Footprint(float(at[0]), float(at[1]), (long / 2, deep / 2), turn))

    def _panel(
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
        self._add(wall.at(left, top, out), wall.along * (right - left), -UP * (top - bottom), texture, window, solid)

    def _add(
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

    def _picture(self, wide: float, tall: float) -> Callable[[], Texture]:
        """A new picture, or one of like shape that hangs elsewhere."""
        alike = [texture for shape, texture in self._pictures if abs(np.log(shape * tall / wide)) < 0.15]
        if alike and self._rng.random() < self._repeats:
            return alike[self._rng.integers(len(alike))]
        texture = self._paint(lambda rng, size, scale: artworks.picture(rng, size), (tall, wide), PICTURE)
        self._pictures.append((wide / tall, texture))
        return texture

    def _paint(self, make: Make, size: tuple[float, float], scale: float) -> Callable[[], Texture]:
        """A texture of (height, width) metres, painted when it is first needed."""
        self._painted += 1
        key = [self._seed, 3, self._painted]
        scale *= self._detail
        h, w = (max(8, round(side * scale)) for side in size)
        return cache(lambda: Texture.of(make(np.random.default_rng(key), (h, w), scale)))


def _marbled(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    return artworks.marble(rng, size)


def _abstract(rng: np.random.Generator, size: Size, scale: float) -> Bytes:
    return artworks.blobs(rng, size)


def _choose(rng: np.random.Generator, among: tuple[_T, ...]) -> _T:
    return among[rng.integers(len(among))]


WALLS: tuple[Make, ...] = (surfaces.plaster, surfaces.wallpaper, surfaces.bricks, surfaces.plaster)  # indoors
FLOORS: tuple[Make, ...] = (surfaces.boards, surfaces.tiles)
GROUNDS: tuple[Make, ...] = (surfaces.cobbles, surfaces.ground)
INDOORS = (_Furnisher._screen, _Furnisher._plinth, _Furnisher._bench, _Furnisher._cabinet, _Furnisher._screen)
OUTDOORS = (
    _Furnisher._kiosk,
    _Furnisher._hedge,
    _Furnisher._bench,
    _Furnisher._plinth,
    _Furnisher._screen,
    _Furnisher._hedge,
    _Furnisher._kiosk,
)
