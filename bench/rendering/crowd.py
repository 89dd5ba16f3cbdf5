"""People in view, upright, each turned towards the camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.rendering.building import Building
from bench.rendering.cutouts import Person
from bench.rendering.mipmap import Texture
from bench.rendering.raster import Doubles, PinholeCamera, Quad
from bench.rendering.rooms import UP

NEAR, FAR = 1.4, 5.5  # metres from the camera
CLEARANCE = 0.3  # metres from people to walls and furniture


def gather_people(
    rng: np.random.Generator, cast: Sequence[Person], mean: float, camera: PinholeCamera, building: Building, night: bool
) -> list[Quad]:
    """Place `mean` people on average; those who would stand in a wall or in furniture are left out."""
    feet_of_camera = camera.centre * (1 - UP)
    forward = camera.rotation[2]
    half = np.arctan(camera.size[0] / 2 / camera.calibration[0, 0])
    present = []
    for _ in range(rng.poisson(mean)):
        person = cast[int(rng.integers(len(cast)))]
        bearing = np.arctan2(forward[1], forward[0]) + rng.uniform(-0.9, 0.9) * half
        feet = feet_of_camera + rng.uniform(NEAR, FAR) * np.array([np.cos(bearing), np.sin(bearing), 0.0])
        if building.is_free(feet[0], feet[1], CLEARANCE):
            present.append(_create_quad(person, feet, feet_of_camera - feet, building, night))
    return present


def _create_quad(person: Person, feet: Doubles, towards: Doubles, building: Building, night: bool) -> Quad:
    towards = towards / np.linalg.norm(towards)
    across = np.cross(UP, towards) * person.wide  # to the right, as the camera sees it
    chest_and_knees = feet + np.array([[1.4], [0.6]]) * UP + 0.05 * towards  # (2, 3)
    light = building.compute_light(chest_and_knees.astype(np.float32), np.stack([towards, towards]).astype(np.float32), night)
    texture = Texture.of(person.pixels)
    return Quad(
        corner=feet + person.tall * UP - across / 2,
        across=across,
        down=-UP * person.tall,
        texture=lambda: texture,
        light=light[:, None],
        opacity=person.opacity,
    )
