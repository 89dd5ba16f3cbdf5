"""Other views of the scene of a query, and views of other scenes, for the metric `identified-scene`.

The target of a query is the reference that shares most with it. What two images share is the fraction of each that the other
shows, the smaller of both, by depth and poses. A query has no target if no reference shares `MIN_SHARED` with it. The 255 others
are references that share at most `MAX_OTHER` in either direction, spread evenly over the map, and then shipped photographs.

Thumbnails and depths are those of small renderings of the same views. So this serves scenes that the gallery renders.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.cache import store
from bench.core.progress import Progress
from bench.datasets.gallery import Rendered, render
from bench.identification import distractors, thumbnails
from bench.identification.thumbnails import Doubles
from bench.images.scene import Mask, Reference, SceneImage
from bench.types import Floats

WIDTH = 96  # pixels of the small renderings
SMALLEST = 32  # pixels of a side of the gallery's images
STEP = 2  # pixels between the points of a depth map
MIN_SHARED = 0.25
MAX_OTHER = 0.01
DEPTH_TOLERANCE = 0.1  # relative; a point at another depth is hidden
KIND = "scene-views"  # in the cache


@dataclass(frozen=True, kw_only=True, eq=False)
class Glance:
    """A small rendering of a view."""

    thumbnail: Doubles  # (16, 16)
    depth: Doubles  # (h, w) metres along the optical axis; infinite in the sky
    points: Doubles  # (h · w, 3) in the world; not finite in the sky
    projection: Doubles  # (3, 4) from the world to columns and rows of `depth`

    def find_visible(self, points: Doubles) -> Mask:
        """Return whether each point of the world is seen in this view. (n, 3) -> (n,)"""
        height, width = self.depth.shape
        known = np.asarray(np.isfinite(points).all(axis=1))
        seen = np.where(known[:, None], points, 0.0) @ self.projection[:, :3].T + self.projection[:, 3]
        depth = np.where(known, seen[:, 2], -1.0)
        column, row = (np.floor(seen[:, axis] / np.maximum(depth, 1e-6)) for axis in (0, 1))
        inside = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        surface = self.depth[np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int)]
        return np.asarray(inside & (np.abs(depth - surface) < DEPTH_TOLERANCE * depth))


def list_candidates(query: SceneImage, references: Sequence[Reference]) -> Floats | None:
    """Return the thumbnails of another view of the query's scene, and of 255 views of others. -> (256, 16, 16)

    None if no other view of the scene is known.
    """
    images = [image.pixels for image in (query, *references)]
    if query.cam_from_world is None or not references or not all(isinstance(pixels, Rendered) for pixels in images):
        return None
    views = _load_glances(tuple(references))
    shared = measure_shared(_glance(query), views)  # (V, 2)
    target = int(shared.min(axis=1).argmax())
    if shared[target].min() < MIN_SHARED:
        return None
    others = np.flatnonzero(shared.max(axis=1) <= MAX_OTHER)
    count = min(len(others), distractors.COUNT)
    spread = others[np.linspace(0, len(others) - 1, count).round().astype(int)] if count else others
    photographs = distractors.load_distractors().thumbnails[: distractors.COUNT - count]
    thumbs = np.concatenate([np.stack([views[index].thumbnail for index in (target, *spread)]), photographs])
    return thumbs.astype(np.float32)


def measure_shared(query: Glance, references: Sequence[Glance]) -> Doubles:
    """Return the fraction of the query that each reference shows, and of the reference that the query shows. -> (V, 2)"""
    return np.array(
        [
            [one.find_visible(query.points).mean(), query.find_visible(one.points).mean()]  # nothing is seen of the sky
            for one in references
        ]
    )


@functools.lru_cache(maxsize=2)
def _load_glances(references: tuple[Reference, ...]) -> tuple[Glance, ...]:
    """Return the glances of references, from the cache or by rendering."""

    def compute() -> store.Content:
        with Progress("small views of the references", len(references)) as progress:
            parts = []
            for image in references:
                parts.append(_render(image))
                progress.advance()
        return {"thumbnails": np.stack([one for one, _ in parts]), "depths": np.stack([depth for _, depth in parts])}, {}

    key = [[_shrink(image).content_hash() for image in references], [thumbnails.SIGMA, thumbnails.SIDE, STEP]]
    arrays, _ = store.fetch(KIND, key, compute)
    parts = zip(references, arrays["thumbnails"], arrays["depths"], strict=True)
    return tuple(_build_glance(image, thumbnail, depth.astype(np.float64)) for image, thumbnail, depth in parts)


def _glance(image: SceneImage) -> Glance:
    thumbnail, depth = _render(image)
    return _build_glance(image, thumbnail, depth.astype(np.float64))


def _render(image: SceneImage) -> tuple[Doubles, NDArray[np.float32]]:
    """Return the thumbnail and the depth map, (h, w)."""
    small = _shrink(image)
    shot = render(small.gallery, small.kind, small.index)
    start = STEP // 2
    return thumbnails.compute_thumbnail(shot.pixels / 255.0), shot.depth[start::STEP, start::STEP].astype(np.float32)


def _shrink(image: SceneImage) -> Rendered:
    """Return the same view in a small size."""
    assert isinstance(image.pixels, Rendered)
    gallery = image.pixels.gallery
    factor = min(1.0, max(WIDTH / gallery.width, SMALLEST / gallery.height))
    width, height = (max(SMALLEST, round(side * factor)) for side in (gallery.width, gallery.height))
    return replace(image.pixels, gallery=replace(gallery, width=width, height=height))


def _build_glance(image: SceneImage, thumbnail: Doubles, depth: Doubles) -> Glance:
    assert image.cam_from_world is not None
    height, width = depth.shape
    scale = np.diag([width / image.camera.width, height / image.camera.height, 1.0])
    calibration, pose = scale @ image.camera.calibration_matrix(), image.cam_from_world.matrix()
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5, np.ones(depth.size)], axis=1)  # (h · w, 3)
    distances = np.where(np.isfinite(depth), depth, np.nan).reshape(-1, 1)
    local = pixels @ np.linalg.inv(calibration).T * distances
    return Glance(
        thumbnail=thumbnail, depth=depth, points=(local - pose[:, 3]) @ pose[:, :3], projection=np.asarray(calibration @ pose)
    )
