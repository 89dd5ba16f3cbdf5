"""Draws planar quads into a pinhole camera: which one each sample sees is decided by the exact intersection of ray and plane.

World: metres. Camera: x right, y down, z forward (COLMAP's, so the centre of the top-left pixel is (0.5, 0.5)). A quad is
{corner + u across + v down : 0 <= u, v <= 1}, seen from the side that across x down points away from. Written
K (R X + t) = z (x, y, 1), a point of it has (u, v, 1) = z H (x, y, 1) with H = (K [R across, R down, R corner + t])^-1, so
u/z, v/z and 1/z are linear over the image: three additions a sample decide whether it is hit, and by which quad first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.rendering.mipmap import Texture, sample
from bench.types import Floats

SAMPLES = 2  # a pixel is the mean of SAMPLES x SAMPLES rays
NEAR = 0.05  # metres
NOTHING = 0xFFFF

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Box = tuple[slice, slice]  # rows, columns


@dataclass(frozen=True, kw_only=True, eq=False)
class Quad:
    """A parallelogram with a texture, whose top-left corner is `corner`."""

    corner: Doubles  # (3,) metres
    across: Doubles  # (3,) from the texture's left to its right
    down: Doubles  # (3,) from its top to its bottom
    texture: Callable[[], Texture]
    light: Floats  # (h, w, 3) linear, how bright white would be, over the quad
    window: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)  # the part of the texture: left, top, width, height
    opacity: Floats | None = None  # (h, w) 0 to 1; None is opaque everywhere

    @cached_property
    def normal(self) -> Doubles:
        """(3,) of unit length, towards those who see it"""
        normal = np.cross(self.down, self.across)
        return normal / np.linalg.norm(normal)

    @cached_property
    def corners(self) -> Doubles:
        """(4, 3) in order around the quad"""
        return self.corner + np.array([0 * self.across, self.across, self.across + self.down, self.down])


@dataclass(frozen=True, kw_only=True, eq=False)
class Eye:
    """A pinhole camera and where it stands."""

    calibration: Doubles  # (3, 3)
    rotation: Doubles  # (3, 3) world to camera
    translation: Doubles  # (3,) world to camera
    size: tuple[int, int]  # width, height in pixels

    @property
    def centre(self) -> Doubles:
        return -self.rotation.T @ self.translation


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawing:
    """What a camera saw, before its sensor."""

    light: Floats  # (H, W, 3) linear
    depth: Floats  # (H, W) metres along the optical axis; infinite where nothing was hit, something between at edges
    foreground: Mask  # (H, W) where most samples hit one of the foreground quads


def draw(eye: Eye, quads: Sequence[Quad], foreground: Sequence[Quad], sky: Callable[[Floats], Floats]) -> Drawing:
    """Draw `quads` with `foreground` before, behind or among them; `sky` gives the light from directions (n, 3) -> (n, 3)."""
    width, height = eye.size
    shape = height * SAMPLES, width * SAMPLES
    nearness = np.zeros(shape, np.float32)  # 1/z of what is seen so far
    seen = np.full(shape, NOTHING, np.uint16)
    everything = [*quads, *foreground]
    inverses = {}
    for index, quad in enumerate(everything):
        box = _bounds(eye, quad)
        if box is not None:
            inverses[index] = _inverse(eye, quad)
            _cover(quad, inverses[index], box, index, nearness, seen)
    light = _shade(eye, everything, inverses, seen, sky)
    people = ((seen >= len(quads)) & (seen != NOTHING)).astype(np.float32)
    with np.errstate(divide="ignore"):
        depth = np.asarray(1 / _mean(nearness), np.float32)  # 1/z is linear on a plane, so this is exact at the pixel's centre
    return Drawing(light=_mean(light), depth=depth, foreground=_mean(people) > 0.5)


def _mean(values: Floats) -> Floats:
    """The mean over each pixel's samples."""
    height, width = values.shape[:2]
    return np.asarray(cv2.resize(values, (width // SAMPLES, height // SAMPLES), interpolation=cv2.INTER_AREA))


def _bounds(eye: Eye, quad: Quad) -> Box | None:
    """The rows and columns of samples that the quad may cover; None if there are none, or it is seen from behind or edge-on."""
    if quad.normal @ (eye.centre - quad.corner) < 1e-6:
        return None
    corners = quad.corners @ eye.rotation.T + eye.translation  # (4, 3)
    before = corners[:, 2] >= NEAR
    if not before.any():
        return None
    points = corners if before.all() else _cut(corners)
    pixels = points @ eye.calibration.T
    pixels = pixels[:, :2] / pixels[:, 2:] * SAMPLES
    limits = np.array(eye.size) * SAMPLES
    left, top = np.clip(np.floor(pixels.min(axis=0) - 1), 0, limits).astype(int).tolist()
    right, bottom = np.clip(np.ceil(pixels.max(axis=0) + 1), 0, limits).astype(int).tolist()
    if left >= right or top >= bottom:
        return None
    return slice(top, bottom), slice(left, right)


def _cut(corners: Doubles) -> Doubles:
    """What a polygon leaves in front of the near plane. (4, 3) in the camera's frame -> (n, 3)"""
    following = np.roll(corners, -1, axis=0)
    crossing = (corners[:, 2] < NEAR) != (following[:, 2] < NEAR)
    a, b = corners[crossing], following[crossing]
    share = (NEAR - a[:, 2]) / (b[:, 2] - a[:, 2])
    return np.concatenate([corners[corners[:, 2] >= NEAR], a + (b - a) * share[:, None]])


def _inverse(eye: Eye, quad: Quad) -> Doubles:
    """H (3, 3), from a sample's column and row to (u, v, 1) / z."""
    seen = eye.rotation @ np.stack([quad.across, quad.down, quad.corner], axis=1)  # (3, 3)
    seen[:, 2] += eye.translation
    to_pixels = np.array([[1 / SAMPLES, 0, 0.5 / SAMPLES], [0, 1 / SAMPLES, 0.5 / SAMPLES], [0, 0, 1]])
    return np.linalg.inv(eye.calibration @ seen) @ to_pixels


def _cover(quad: Quad, inverse: Doubles, box: Box, index: int, nearness: Floats, seen: NDArray[np.uint16]) -> None:
    """Enter the quad where it is nearer than what is there."""
    rows, columns = box
    x = np.arange(columns.start, columns.stop)
    y = np.arange(rows.start, rows.stop)
    # u/z, v/z and 1/z, each a row plus a column.
    u, v, w = ((a * x).astype(np.float32)[None, :] + (b * y + c).astype(np.float32)[:, None] for a, b, c in inverse)  # (h, w)
    hit = (w > nearness[box]) & (u >= 0) & (v >= 0) & (u <= w) & (v <= w) & (w < 1 / NEAR)
    if quad.opacity is not None and hit.any():
        where = np.flatnonzero(hit)
        solid = sample(quad.opacity, u.ravel()[where] / w.ravel()[where], v.ravel()[where] / w.ravel()[where])
        hit.ravel()[where] = solid[:, 0] > 0.5
    nearness[box][hit] = w[hit]
    seen[box][hit] = index


def _shade(
    eye: Eye, quads: list[Quad], inverses: dict[int, Doubles], seen: NDArray[np.uint16], sky: Callable[[Floats], Floats]
) -> Floats:
    """The light of each sample, (H, W, 3), sampled only where its quad is seen."""
    width = seen.shape[1]
    order = np.argsort(seen, axis=None, kind="stable")
    numbers, starts = np.unique(seen.ravel()[order], return_index=True)
    light = np.empty((seen.size, 3), np.float32)
    for number, samples in zip(numbers, np.split(order, starts[1:]), strict=True):
        y, x = np.divmod(samples, width)
        if number == NOTHING:
            light[samples] = sky(_directions(eye, x, y))
            continue
        quad, inverse = quads[number], inverses[number]
        u, v, w = ((a * x + b * y + c).astype(np.float32) for a, b, c in inverse)
        u /= w
        v /= w
        light[samples] = _lit(quad, inverse, u, v, w)
    return light.reshape(*seen.shape, 3)


def _lit(quad: Quad, inverse: Doubles, u: Floats, v: Floats, w: Floats) -> Floats:
    """-> (n, 3)"""
    texture = quad.texture()
    left, top, wide, tall = quad.window
    # det H z^3 is the area of (u, v) that one sample covers; half its logarithm counts halvings of the side.
    area = np.float32(abs(np.linalg.det(inverse)) * texture.texels * wide * tall)
    fineness = np.float32(0.5) * np.log2(area / (w * w * w))
    return texture.sample(left + wide * u, top + tall * v, fineness) * sample(quad.light, u, v)


def _directions(eye: Eye, x: NDArray[Any], y: NDArray[Any]) -> Floats:
    """Unit vectors in the world of the rays through samples. (n,), (n,) -> (n, 3)"""
    pixels = np.stack([(x + 0.5) / SAMPLES, (y + 0.5) / SAMPLES, np.ones(len(x))])  # (3, n)
    rays = (eye.rotation.T @ np.linalg.inv(eye.calibration) @ pixels).T
    return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
