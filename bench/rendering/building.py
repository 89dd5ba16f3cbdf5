"""The building: rooms with everything in them, lit by day and by night."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.rendering import surfaces
from bench.rendering.furniture import Footprint, Surface, compute_lamp_positions, furnish
from bench.rendering.light import Lamp, Lighting, Occluders, compute_light
from bench.rendering.mipmap import Texture, sample
from bench.rendering.noise import draw_noise, pixels
from bench.rendering.raster import Doubles, Quad
from bench.rendering.rooms import ROOMS
from bench.types import Floats

GRID = 0.35  # metres between the points where light is computed, at full detail


@dataclass(frozen=True, eq=False)
class Building:
    """Everything static."""

    day: tuple[Quad, ...]
    night: tuple[Quad, ...]
    footprints: tuple[Footprint, ...]
    occluders: Occluders
    lightings: tuple[Lighting, Lighting]  # by day, by night
    sky: Texture

    def is_free(self, x: float, y: float, margin: float) -> bool:
        """Whether a point of the floor is that far from walls and furniture."""
        return any(room.contains(x, y, margin) for room in ROOMS) and all(
            item.distance(x, y) >= margin for item in self.footprints
        )

    def compute_light(self, points: Floats, normals: Floats, night: bool) -> Floats:
        """Compute the light that reaches surfaces. points, normals (n, 3) -> (n, 3)"""
        return compute_light(points, normals, self.occluders, (self.lightings[night],))[0]

    def compute_sky(self, directions: Floats, night: bool) -> Floats:
        """Compute the sky's light. (n, 3) unit vectors -> (n, 3) linear"""
        below = 1 + np.maximum(directions[:, 2], -0.5)
        u, v = (0.5 + 0.25 * directions[:, axis] / below for axis in (0, 1))
        light = sample(self.sky.levels[0], u, v)
        return light * np.array(self.lightings[night].sky, np.float32)


def build(seed: int, *, repeats: float, bare: float, detail: float) -> Building:
    """Furnish and light the floor plan.

    Parameters
    ----------
    repeats : fraction of pictures that repeat another one
    bare : fraction of wall positions left empty
    detail : texels per metre, where 1 is about one per pixel from 1.5 m away; below 1 light is coarser as well
    """
    all_surfaces, footprints = furnish(seed, repeats=repeats, bare=bare, detail=detail)
    solid = [surface for surface in all_surfaces if surface.solid]
    occluders = Occluders.of(*(np.stack([getattr(s, name) for s in solid]) for name in ("corner", "across", "down")))
    lightings = (_create_day_lighting(), _create_night_lighting(np.random.default_rng([seed, 1])))
    day, night = _light_surfaces(all_surfaces, occluders, lightings, GRID / min(detail, 1.0))
    sky = Texture.of(pixels(surfaces.colour_sky(draw_noise(np.random.default_rng([seed, 2]), (768, 768), 160, 6))))
    return Building(tuple(day), tuple(night), tuple(footprints), occluders, lightings, sky)


def _create_day_lighting() -> Lighting:
    lights = tuple(
        Lamp(at=(x, y, room.height - 0.25), colour=(2.2, 2.1, 1.9))
        for room in ROOMS
        if room.roofed
        for x, y in compute_lamp_positions(room)
    )
    return Lighting(
        lamps=lights, sun=(1.5, 1.4, 1.2), towards_sun=(-0.45, -0.35, 0.82), sky=(0.75, 0.8, 0.9), bounce=(0.3, 0.3, 0.29)
    )


def _create_night_lighting(rng: np.random.Generator) -> Lighting:
    lights = []
    for room in ROOMS:
        positions = compute_lamp_positions(room)[rng.integers(2) :: 2]
        strength = rng.uniform(0.5, 1.0)
        lights += [
            Lamp(at=(x, y, min(room.height, 3.6) - 0.4), colour=(strength, 0.72 * strength, 0.42 * strength))
            for x, y in positions
        ]
    return Lighting(
        lamps=tuple(lights), sun=(0, 0, 0), towards_sun=(0, 0, 1.0), sky=(0.008, 0.012, 0.024), bounce=(0.016, 0.013, 0.01)
    )


def _light_surfaces(
    all_surfaces: list[Surface], occluders: Occluders, lightings: tuple[Lighting, ...], spacing: float
) -> list[list[Quad]]:
    """Turn the surfaces into quads under each lighting."""
    grids = [_sample_grid(surface, spacing) for surface in all_surfaces]
    points = np.concatenate([grid.reshape(-1, 3) for grid in grids]).astype(np.float32)
    counts = [grid.shape[0] * grid.shape[1] for grid in grids]
    normals = np.stack([np.cross(surface.down, surface.across) for surface in all_surfaces])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lit = compute_light(points, np.repeat(normals, counts, axis=0).astype(np.float32), occluders, lightings)
    return [
        [
            _create_quad(surface, values.reshape(grid.shape), lighting)
            for surface, grid, values in zip(all_surfaces, grids, np.split(light, np.cumsum(counts)[:-1]), strict=True)
        ]
        for lighting, light in zip(lightings, lit, strict=True)
    ]


def _sample_grid(surface: Surface, spacing: float) -> Doubles:
    """Sample a grid of points on the surface. -> (h, w, 3)"""
    w, h = (int(np.clip(np.ceil(np.linalg.norm(edge) / spacing), 2, 40)) for edge in (surface.across, surface.down))
    u, v = np.meshgrid((np.arange(w) + 0.5) / w, (np.arange(h) + 0.5) / h)  # (h, w)
    return surface.corner + u[..., None] * surface.across + v[..., None] * surface.down


def _create_quad(surface: Surface, light: Floats, lighting: Lighting) -> Quad:
    if surface.glow is not None:
        light = np.full((2, 2, 3), surface.glow * np.array(lighting.bounce), np.float32)
    return Quad(
        corner=surface.corner,
        across=surface.across,
        down=surface.down,
        texture=surface.texture,
        light=light,
        window=surface.window,
    )
