"""Where cameras stand and where they look: reference walks around each room, and queries beside those walks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bench.rendering.building import Building
from bench.rendering.raster import Doubles
from bench.rendering.rooms import Room

LAPS = 2  # the first looks outwards at the walls nearby, the second across the room
MARGIN = 0.45  # metres that a camera keeps from things
NEAREST = 0.9  # metres: a view that looks at something nearer is not taken
TRIES = 200


@dataclass(frozen=True, kw_only=True)
class Station:
    """A place and a direction."""

    x: float  # metres
    y: float
    z: float
    heading: float  # radians from east towards north
    pitch: float  # radians, up is positive
    roll: float  # radians, clockwise as the camera sees it

    @property
    def centre(self) -> Doubles:
        return np.array([self.x, self.y, self.z])

    @property
    def rotation(self) -> Doubles:
        """(3, 3) world to camera; x right, y down, z forward"""
        c, s = np.cos(self.heading), np.sin(self.heading)
        forward = np.array([c * np.cos(self.pitch), s * np.cos(self.pitch), np.sin(self.pitch)])
        right = np.array([s, -c, 0.0])
        down = np.cross(forward, right)
        turned = np.cos(self.roll) * right + np.sin(self.roll) * down
        return np.stack([turned, np.cross(forward, turned), forward])


def on_walk(room: Room, lap: int, share: float) -> Station:
    """The station at `share` of the way around a room, 0 to 1."""
    turn = 2 * np.pi * share
    # A rounded rectangle, halfway between the middle of the room and its walls.
    x, y = (np.sign(value) * abs(value) ** 0.7 for value in (np.cos(turn), np.sin(turn)))
    reach = 0.55 if lap == 0 else 0.72
    outwards = np.arctan2(y * room.size[1], x * room.size[0])
    return Station(
        x=(room.west + room.east) / 2 + reach * x * room.size[0] / 2,
        y=(room.south + room.north) / 2 + reach * y * room.size[1] / 2,
        z=1.55,
        heading=float(outwards + (0.3 if lap == 0 else np.pi - 0.25)),
        pitch=0.0,
        roll=0.0,
    )


def references(rooms: tuple[Room, ...], count: int, building: Building, seed: int) -> Iterator[tuple[Room, int, Station]]:
    """`count` stations, shared among the rooms by their perimeters, in the order in which they are walked, with room and lap."""
    edges = np.cumsum([0.0, *(room.perimeter for room in rooms for _ in range(LAPS))])
    numbers = np.round(edges / edges[-1] * count).astype(int)
    for stretch, (first, last) in enumerate(pairwise(numbers)):
        room, lap = rooms[stretch // LAPS], stretch % LAPS
        for number in range(first, last):
            rng = np.random.default_rng([seed, 5, number])
            planned = on_walk(room, lap, (number - first + 0.5) / (last - first))
            yield room, lap, _beside(rng, planned, building, spread=0.15)


def queries(
    rooms: tuple[Room, ...], count: int, building: Building, seed: int, viewpoint: float
) -> Iterator[tuple[Room, Station]]:
    """`count` stations anywhere beside the walks; `viewpoint` scales how far."""
    weights = np.array([room.perimeter for room in rooms])
    for number in range(count):
        rng = np.random.default_rng([seed, 6, number])
        room = rooms[rng.choice(len(rooms), p=weights / weights.sum())]
        planned = on_walk(room, int(rng.integers(LAPS)), rng.random())
        yield room, _beside(rng, planned, building, spread=viewpoint)


def _beside(rng: np.random.Generator, planned: Station, building: Building, spread: float) -> Station:
    """A station near the planned one that is free and has a view."""
    for attempt in range(TRIES):
        wide = spread + attempt / 40  # where the walk is blocked, look farther and farther around
        place = planned.centre + rng.normal(0, 1, 3) * wide * np.array([0.7, 0.7, 0.12])
        found = Station(
            x=float(place[0]),
            y=float(place[1]),
            z=float(np.clip(place[2], 1.2, 1.9)),
            heading=planned.heading + rng.normal(0, 0.35) * wide,
            pitch=float(np.clip(rng.normal(0.02, 0.06) * wide, -0.35, 0.35)),
            roll=float(np.clip(rng.normal(0, 0.035) * wide, -0.15, 0.15)),
        )
        if building.free(found.x, found.y, MARGIN) and _has_view(found, building):
            return found
    raise AssertionError("no free place near the walk; the floor plan leaves room everywhere")


def _has_view(station: Station, building: Building) -> bool:
    """Whether nothing fills the view from close by."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.35, 0.35, 3))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1) @ station.rotation
    starts = np.broadcast_to(station.centre, rays.shape)
    away = building.occluders.distance(starts.astype(np.float32), rays.astype(np.float32))
    return bool(away.min() > NEAREST and np.median(away) > 2 * NEAREST)
