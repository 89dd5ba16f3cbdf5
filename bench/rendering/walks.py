"""Positions and directions of cameras: references on walks around each room, and queries beside those walks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bench.rendering.building import Building
from bench.rendering.raster import Doubles
from bench.rendering.rooms import Room

LAPS = 2  # the first looks outwards at the walls nearby, the second across the room
MARGIN = 0.45  # metres from cameras to walls and furniture
NEAREST = 0.9  # metres: views of nearer surfaces are rejected
TRIES = 200


@dataclass(frozen=True, kw_only=True)
class Station:
    """The position and direction of a camera."""

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


def compute_station(room: Room, lap: int, fraction: float) -> Station:
    """Compute the station at a fraction of the way around a room, 0 to 1."""
    turn = 2 * np.pi * fraction
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


def generate_references(
    rooms: tuple[Room, ...], count: int, building: Building, seed: int
) -> Iterator[tuple[Room, int, Station]]:
    """Generate `count` stations in walking order, with room and lap, divided among the rooms by their perimeters."""
    edges = np.cumsum([0.0, *(room.perimeter for room in rooms for _ in range(LAPS))])
    numbers = np.round(edges / edges[-1] * count).astype(int)
    for stretch, (first, last) in enumerate(pairwise(numbers)):
        room, lap = rooms[stretch // LAPS], stretch % LAPS
        for number in range(first, last):
            rng = np.random.default_rng([seed, 5, number])
            planned = compute_station(room, lap, (number - first + 0.5) / (last - first))
            yield room, lap, _find_free_station(rng, planned, building, spread=0.15)


def generate_queries(
    rooms: tuple[Room, ...], count: int, building: Building, seed: int, viewpoint: float
) -> Iterator[tuple[Room, Station]]:
    """Generate `count` stations beside the walks; `viewpoint` scales their distance from the walks."""
    weights = np.array([room.perimeter for room in rooms])
    for number in range(count):
        rng = np.random.default_rng([seed, 6, number])
        room = rooms[rng.choice(len(rooms), p=weights / weights.sum())]
        planned = compute_station(room, int(rng.integers(LAPS)), rng.random())
        yield room, _find_free_station(rng, planned, building, spread=viewpoint)


def _find_free_station(rng: np.random.Generator, planned: Station, building: Building, spread: float) -> Station:
    """Find a free station with a view near the planned one."""
    for attempt in range(TRIES):
        wide = spread + attempt / 40  # if the walk is blocked, search farther away
        position = planned.centre + rng.normal(0, 1, 3) * wide * np.array([0.7, 0.7, 0.12])
        station = Station(
            x=float(position[0]),
            y=float(position[1]),
            z=float(np.clip(position[2], 1.2, 1.9)),
            heading=planned.heading + rng.normal(0, 0.35) * wide,
            pitch=float(np.clip(rng.normal(0.02, 0.06) * wide, -0.35, 0.35)),
            roll=float(np.clip(rng.normal(0, 0.035) * wide, -0.15, 0.15)),
        )
        if building.is_free(station.x, station.y, MARGIN) and _has_view(station, building):
            return station
    raise AssertionError("no free position near the walk; the floor plan leaves room everywhere")


def _has_view(station: Station, building: Building) -> bool:
    """Whether no near surface fills the view."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.35, 0.35, 3))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1) @ station.rotation
    starts = np.broadcast_to(station.centre, rays.shape)
    away = building.occluders.distance(starts.astype(np.float32), rays.astype(np.float32))
    return bool(away.min() > NEAREST and np.median(away) > 2 * NEAREST)
