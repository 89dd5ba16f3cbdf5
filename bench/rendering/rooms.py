"""The floor plan: a courtyard and four rooms around it, with doors between them. Lengths in metres; x east, y north, z up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.rendering.raster import Doubles

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Room:
    """A rectangle of floor, and how high its walls are."""

    name: str
    west: float
    south: float
    east: float
    north: float
    height: float
    roofed: bool = True

    @property
    def size(self) -> tuple[float, float]:
        return self.east - self.west, self.north - self.south

    @property
    def perimeter(self) -> float:
        return 2 * sum(self.size)

    def contains(self, x: float, y: float, margin: float = 0.0) -> bool:
        return self.west + margin <= x <= self.east - margin and self.south + margin <= y <= self.north - margin


@dataclass(frozen=True)
class Door:
    """An opening that leads through the walls between two rooms."""

    west: float
    south: float
    east: float
    north: float
    height: float = 2.4

    @property
    def centre(self) -> Doubles:
        """(2,)"""
        return np.array([self.west + self.east, self.south + self.north]) / 2


COURTYARD = Room("courtyard", 0.0, 0.0, 14.0, 11.0, 6.5, roofed=False)
ROOMS = (
    COURTYARD,
    Room("north-west", -0.6, 11.4, 6.6, 17.4, 3.6),
    Room("north-east", 7.0, 11.4, 14.4, 18.0, 4.2),
    Room("east", 14.4, -0.5, 20.4, 11.0, 3.8),
    Room("west", -6.9, 1.5, -0.4, 10.0, 3.4),
)
DOORS = (
    Door(2.2, 11.0, 4.0, 11.4),
    Door(9.6, 11.0, 12.0, 11.4, 3.0),
    Door(14.0, 4.6, 14.4, 6.6, 2.7),
    Door(-0.4, 4.8, 0.0, 6.4),
    Door(6.6, 14.2, 7.0, 16.0),
)


@dataclass(frozen=True, eq=False)
class Wall:
    """One side of a room as seen from within: `corner` is its top left, `along` the unit vector to its right."""

    room: Room
    corner: Doubles  # (3,)
    along: Doubles  # (3,)
    length: float
    openings: tuple[tuple[float, float, float], ...]  # from, to (along the wall), height

    @property
    def normal(self) -> Doubles:
        """Into the room."""
        return np.cross(-UP, self.along)

    def point_at(self, along: float, height: float, out: float = 0.0) -> Doubles:
        """Return the point `along` the wall, at a height above the floor, `out` from the wall into the room."""
        floor = self.corner - UP * self.corner[2]
        return floor + self.along * along + UP * height + self.normal * out

    def pieces(self) -> list[tuple[float, float, float, float]]:
        """Return the wall without its openings, as rectangles (from, to, bottom, top)."""
        rectangles, start = [], 0.0
        for left, right, high in sorted(self.openings):
            rectangles += [(start, left, 0.0, self.room.height), (left, right, high, self.room.height)]
            start = right
        return [*rectangles, (start, self.length, 0.0, self.room.height)]

    def free_stretches(self) -> list[tuple[float, float]]:
        """Return the stretches between openings and corners, free for pictures and furniture."""
        edges = [0.0, *(edge for left, right, _ in sorted(self.openings) for edge in (left, right)), self.length]
        return list(zip(edges[::2], edges[1::2], strict=True))


def list_walls(room: Room) -> list[Wall]:
    """List the north, east, south and west wall of a room."""
    h = room.height
    sides = (
        ((room.west, room.north, h), (1.0, 0.0, 0.0), room.size[0]),
        ((room.east, room.north, h), (0.0, -1.0, 0.0), room.size[1]),
        ((room.east, room.south, h), (-1.0, 0.0, 0.0), room.size[0]),
        ((room.west, room.south, h), (0.0, 1.0, 0.0), room.size[1]),
    )
    return [_create_wall(room, np.array(corner), np.array(along), length) for corner, along, length in sides]


def _create_wall(room: Room, corner: Doubles, along: Doubles, length: float) -> Wall:
    normal = np.cross(-UP, along)
    openings = []
    for door in DOORS:
        ends = np.array([[door.west, door.south, 0.0], [door.east, door.north, 0.0]])
        beside = (ends - corner) @ along  # (2,)
        beyond = (ends - corner) @ normal  # (2,) negative outside the room
        if abs(beyond.max()) < 1e-9 and beside.max() > 0 and beside.min() < length:
            openings.append((float(beside.min()), float(beside.max()), door.height))
    return Wall(room, corner, along, length, tuple(openings))
