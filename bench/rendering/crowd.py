"""People who happen to stand in view, upright, each turned towards the camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.rendering.building import Building
from bench.rendering.cutouts import Person
from bench.rendering.mipmap import Texture
from bench.rendering.raster import Doubles, Eye, Quad
from bench.rendering.rooms import UP

NEAR, FAR = 1.4, 5.5  # metres from the camera
ROOM = 0.3  # metres that people keep from things


def gather(
    rng: np.random.Generator, cast: Sequence[Person], mean: float, eye: Eye, building: Building, night: bool
) -> list[Quad]:
    """About `mean` people; those who would stand in a wall or in furniture stay away."""
    feet_of_camera = eye.centre * (1 - UP)
    forward = eye.rotation[2]
    half = np.arctan(eye.size[0] / 2 / eye.calibration[0, 0])
    present = []
    for _ in range(rng.poisson(mean)):
        person = cast[int(rng.integers(len(cast)))]
        bearing = np.arctan2(forward[1], forward[0]) + rng.uniform(-0.9, 0.9) * half
        feet = feet_of_camera + rng.uniform(NEAR, FAR) * np.array([np.cos(bearing), np.sin(bearing), 0.0])
        if building.free(feet[0], feet[1], ROOM):
            present.append(_figure(person, feet, feet_of_camera - feet, building, night))
    return present


def _figure(person: Person, feet: Doubles, towards: Doubles, building: Building, night: bool) -> Quad:
    towards = towards / np.linalg.norm(towards)
    across = np.cross(UP, towards) * person.wide  # to the right, as the camera sees it
    chest_and_knees = feet + np.array([[1.4], [0.6]]) * UP + 0.05 * towards  # (2, 3)
    light = building.falls(chest_and_knees.astype(np.float32), np.stack([towards, towards]).astype(np.float32), night)
    texture = Texture.of(person.pixels)
    return Quad(
        corner=feet + person.tall * UP - across / 2,
        across=across,
        down=-UP * person.tall,
        texture=lambda: texture,
        light=light[:, None],
        opacity=person.opacity,
    )
