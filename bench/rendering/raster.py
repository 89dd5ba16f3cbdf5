"""Draws planar quads into a pinhole camera: the exact intersections of ray and plane decide which quad a sample shows.

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
    light: Floats  # (h, w, 3) linear brightness of white, over the quad
    window: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)  # the part of the texture: left, top, width, height
    opacity: Floats | None = None  # (h, w) 0 to 1; None is opaque everywhere

    @cached_property
    def normal(self) -> Doubles:
        """(3,) of unit length, towards the visible side"""
        normal = np.cross(self.down, self.across)
        return normal / np.linalg.norm(normal)

    @cached_property
    def corners(self) -> Doubles:
        """(4, 3) in order around the quad"""
        return self.corner + np.array([0 * self.across, self.across, self.across + self.down, self.down])


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeCamera:
    """A pinhole camera with its pose."""

    calibration: Doubles  # (3, 3)
    rotation: Doubles  # (3, 3) world to camera
    translation: Doubles  # (3,) world to camera
    size: tuple[int, int]  # width, height in pixels

    @property
    def centre(self) -> Doubles:
        return -self.rotation.T @ self.translation


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawing:
    """The image of a camera, before its sensor."""

    light: Floats  # (H, W, 3) linear
    depth: Floats  # (H, W) metres along the optical axis; infinite without a quad, a mean at edges
    foreground: Mask  # (H, W) where most samples hit one of the foreground quads


def draw(camera: PinholeCamera, quads: Sequence[Quad], foreground: Sequence[Quad], sky: Callable[[Floats], Floats]) -> Drawing:
    """Draw `quads` and `foreground`, hidden by depth; `sky` gives the light from directions (n, 3) -> (n, 3)."""
    width, height = camera.size
    shape = height * SAMPLES, width * SAMPLES
    nearness = np.zeros(shape, np.float32)  # 1/z of the nearest quad so far
    visible = np.full(shape, NOTHING, np.uint16)
    all_quads = [*quads, *foreground]
    inverses = {}
    for index, quad in enumerate(all_quads):
        box = _compute_bounds(camera, quad)
        if box is not None:
            inverses[index] = _compute_inverse(camera, quad)
            _rasterize(quad, inverses[index], box, index, nearness, visible)
    light = _shade(camera, all_quads, inverses, visible, sky)
    people = ((visible >= len(quads)) & (visible != NOTHING)).astype(np.float32)
    with np.errstate(divide="ignore"):
        depth = np.asarray(
            1 / _average_samples(nearness), np.float32
        )  # 1/z is linear on a plane, so this is exact at the pixel's centre
    return Drawing(light=_average_samples(light), depth=depth, foreground=_average_samples(people) > 0.5)


def _average_samples(values: Floats) -> Floats:
    """Average each pixel's samples."""
    height, width = values.shape[:2]
    return np.asarray(cv2.resize(values, (width // SAMPLES, height // SAMPLES), interpolation=cv2.INTER_AREA))


def _compute_bounds(camera: PinholeCamera, quad: Quad) -> Box | None:
    """Return the rows and columns of samples that the quad may cover; None if none, or if it is seen from behind or edge-on."""
    if quad.normal @ (camera.centre - quad.corner) < 1e-6:
        return None
    corners = quad.corners @ camera.rotation.T + camera.translation  # (4, 3)
    before = corners[:, 2] >= NEAR
    if not before.any():
        return None
    points = corners if before.all() else _clip_to_near_plane(corners)
    pixels = points @ camera.calibration.T
    pixels = pixels[:, :2] / pixels[:, 2:] * SAMPLES
    limits = np.array(camera.size) * SAMPLES
    left, top = np.clip(np.floor(pixels.min(axis=0) - 1), 0, limits).astype(int).tolist()
    right, bottom = np.clip(np.ceil(pixels.max(axis=0) + 1), 0, limits).astype(int).tolist()
    if left >= right or top >= bottom:
        return None
    return slice(top, bottom), slice(left, right)


def _clip_to_near_plane(corners: Doubles) -> Doubles:
    """Clip a polygon to the part in front of the near plane. (4, 3) in the camera's frame -> (n, 3)"""
    following = np.roll(corners, -1, axis=0)
    crossing = (corners[:, 2] < NEAR) != (following[:, 2] < NEAR)
    a, b = corners[crossing], following[crossing]
    fraction = (NEAR - a[:, 2]) / (b[:, 2] - a[:, 2])
    return np.concatenate([corners[corners[:, 2] >= NEAR], a + (b - a) * fraction[:, None]])


def _compute_inverse(camera: PinholeCamera, quad: Quad) -> Doubles:
    """Compute H (3, 3), from a sample's column and row to (u, v, 1) / z."""
    edges = camera.rotation @ np.stack([quad.across, quad.down, quad.corner], axis=1)  # (3, 3)
    edges[:, 2] += camera.translation
    to_pixels = np.array([[1 / SAMPLES, 0, 0.5 / SAMPLES], [0, 1 / SAMPLES, 0.5 / SAMPLES], [0, 0, 1]])
    return np.linalg.inv(camera.calibration @ edges) @ to_pixels


def _rasterize(quad: Quad, inverse: Doubles, box: Box, index: int, nearness: Floats, visible: NDArray[np.uint16]) -> None:
    """Enter the quad where it is nearer than the quads so far."""
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
    visible[box][hit] = index


def _shade(
    camera: PinholeCamera,
    quads: list[Quad],
    inverses: dict[int, Doubles],
    visible: NDArray[np.uint16],
    sky: Callable[[Floats], Floats],
) -> Floats:
    """Compute the light of each sample, (H, W, 3), from the texture of its visible quad."""
    width = visible.shape[1]
    order = np.argsort(visible, axis=None, kind="stable")
    numbers, starts = np.unique(visible.ravel()[order], return_index=True)
    light = np.empty((visible.size, 3), np.float32)
    for number, samples in zip(numbers, np.split(order, starts[1:]), strict=True):
        y, x = np.divmod(samples, width)
        if number == NOTHING:
            light[samples] = sky(_compute_directions(camera, x, y))
            continue
        quad, inverse = quads[number], inverses[number]
        u, v, w = ((a * x + b * y + c).astype(np.float32) for a, b, c in inverse)
        u /= w
        v /= w
        light[samples] = _shade_quad(quad, inverse, u, v, w)
    return light.reshape(*visible.shape, 3)


def _shade_quad(quad: Quad, inverse: Doubles, u: Floats, v: Floats, w: Floats) -> Floats:
    """-> (n, 3)"""
    texture = quad.texture()
    left, top, wide, tall = quad.window
    # det H z^3 is the area of (u, v) that one sample covers; half its logarithm counts halvings of the side.
    area = np.float32(abs(np.linalg.det(inverse)) * texture.texels * wide * tall)
    fineness = np.float32(0.5) * np.log2(area / (w * w * w))
    return texture.sample(left + wide * u, top + tall * v, fineness) * sample(quad.light, u, v)


def _compute_directions(camera: PinholeCamera, x: NDArray[Any], y: NDArray[Any]) -> Floats:
    """Compute unit vectors, in the world, of the rays through samples. (n,), (n,) -> (n, 3)"""
    pixels = np.stack([(x + 0.5) / SAMPLES, (y + 0.5) / SAMPLES, np.ones(len(x))])  # (3, n)
    rays = (camera.rotation.T @ np.linalg.inv(camera.calibration) @ pixels).T
    return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
