"""Lighting of a scene: lamps and the sun with shadows, and ambient light sampled by rays.

The light that walls reflect is the same everywhere in a room. Corners, and points close to other surfaces, are darker.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.rendering.raster import Doubles, Mask
from bench.types import Floats

RAYS = 32  # around each point
REACH = 1.5  # metres: surfaces farther away give the full light of a room
BLOCK = 1 << 18  # intersections per block, so that they fit the processor's cache
MIN_STRENGTH = 0.015  # of a lamp's light at one metre: less is ignored
OFFSET = 2e-3  # metres from the surface to the start of a ray


@dataclass(frozen=True, kw_only=True)
class Lamp:
    """A point that shines in all directions."""

    at: tuple[float, float, float]  # metres
    colour: tuple[float, float, float]  # light on a surface that faces it at one metre


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """All light sources."""

    lamps: tuple[Lamp, ...]
    sun: tuple[float, float, float]  # light on a surface that faces the sun
    towards_sun: tuple[float, float, float]
    sky: tuple[float, float, float]  # the light of the sky, all around
    bounce: tuple[float, float, float]  # the light of a room, all around


@dataclass(frozen=True, eq=False)
class Occluders:
    """Parallelograms that stop light, from either side."""

    corner: Floats  # (Q, 3)
    normal: Floats  # (Q, 3)
    u: Floats  # (Q, 3) dual to the edges: u . (p - corner) runs from 0 to 1 across the quad
    v: Floats  # (Q, 3)

    @classmethod
    def of(cls, corners: Doubles, across: Doubles, down: Doubles) -> Occluders:
        """Each (Q, 3)."""
        normal = np.cross(down, across)
        inverse = np.linalg.inv(np.stack([across, down, normal], axis=2))  # (Q, 3, 3)
        rows = [array.astype(np.float32) for array in (corners, normal, inverse[:, 0], inverse[:, 1])]
        return cls(*rows)

    def distance(self, origins: Floats, directions: Floats) -> Floats:
        """Return the distance of each ray to the first quad, in units of its direction, or infinity. (n, 3), (n, 3) -> (n,)"""
        step = max(1, BLOCK // len(self.corner))
        parts = [self._distance(origins[i : i + step], directions[i : i + step]) for i in range(0, max(1, len(origins)), step)]
        return np.concatenate(parts)

    def _distance(self, origins: Floats, directions: Floats) -> Floats:
        facing = directions @ self.normal.T  # (n, Q)
        facing[np.abs(facing) < 1e-9] = 1e-9
        away = ((self.normal * self.corner).sum(1) - origins @ self.normal.T) / facing
        across = origins @ self.u.T - (self.u * self.corner).sum(1) + away * (directions @ self.u.T)
        down = origins @ self.v.T - (self.v * self.corner).sum(1) + away * (directions @ self.v.T)
        hit: Mask = (away > 0) & (across >= 0) & (across <= 1) & (down >= 0) & (down <= 1)
        return np.where(hit, away, np.inf).min(axis=1)


def compute_light(points: Floats, normals: Floats, occluders: Occluders, lightings: tuple[Lighting, ...]) -> list[Floats]:
    """Compute the light on points of surfaces under each lighting. points, normals (n, 3) -> [(n, 3)]

    The ambient rays are traced once for all lightings.
    """
    starts = points + OFFSET * normals
    ambient = _compute_ambient_light(starts, normals, occluders)
    results = []
    for lighting in lightings:
        total = ambient @ np.array([lighting.sky, lighting.bounce])
        sun = np.broadcast_to(100 * np.array(lighting.towards_sun, np.float32), points.shape)
        total += _compute_direct_light(starts, normals, occluders, sun, far=True).astype(np.float64) * np.array(lighting.sun)
        for lamp in lighting.lamps:
            towards = np.array(lamp.at, np.float32) - starts
            total += _compute_direct_light(starts, normals, occluders, towards, far=False).astype(np.float64) * np.array(
                lamp.colour
            )
        results.append(total.astype(np.float32))
    return results


def _compute_ambient_light(starts: Floats, normals: Floats, occluders: Occluders) -> Floats:
    """Compute the fractions of the sky, and of the lit room, visible from each point. (n, 3) -> (n, 2)"""
    turns = np.arange(RAYS) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt((np.arange(RAYS) + 0.5) / RAYS)  # so that rays are as dense as the cosine is large
    local = np.stack([radius * np.cos(turns), radius * np.sin(turns), np.sqrt(1 - radius**2)], axis=1).astype(np.float32)
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]).astype(np.float32)
    first = np.cross(helper, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    fractions = np.zeros((len(starts), 2), np.float32)
    for a, b, c in local:
        direction = a * first + b * second + c * normals
        away = occluders.distance(starts, direction)
        outside = np.isinf(away)
        fractions[:, 0] += outside & (direction[:, 2] > 0)
        fractions[:, 1] += np.where(outside, 0.4, np.minimum(away, REACH) / REACH)
    return (fractions / RAYS).astype(np.float32)


def _compute_direct_light(starts: Floats, normals: Floats, occluders: Occluders, towards: Floats, far: bool) -> Floats:
    """Compute Lambert's cosine, over the squared distance unless the source is far; 0 in shadow. -> (n, 1)"""
    away = np.linalg.norm(towards, axis=1)
    cosine = (normals * towards).sum(axis=1) / away
    strength = np.where(cosine > 0, cosine if far else cosine / np.maximum(away, 0.3) ** 2, 0)
    strength[strength < MIN_STRENGTH] = 0
    lit = np.flatnonzero(strength)
    shadowed = lit[occluders.distance(starts[lit], towards[lit]) < 1]
    strength[shadowed] = 0
    return strength[:, None].astype(np.float32)
