"""The features of images that are dear to read, kept by the hash of the image, the extractor and its source."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from bench import cache, environment, spec
from bench.datasets.scene import Pixels
from bench.plugin import Extractor
from bench.tensorfile import Arrays
from bench.types import Features

KIND = "features"


def features(extractor: Extractor, pixels: Pixels) -> Features:
    """Extract, unless it was done before.

    Raises
    ------
    UnitError
        if the image cannot be read, or has no keypoint.
    """

    def make() -> cache.Made:
        found = extractor.extract(pixels.read(), getattr(pixels, "path", None))
        return to_arrays(found), {"size": list(found.size)}

    arrays, meta = cache.fetch(KIND, _key(extractor, pixels), make)
    return from_arrays(arrays, tuple(meta["size"]))


def keep(extractor: Extractor, pixels: Pixels) -> None:
    """As `features`, for a process that keeps them for others."""
    features(extractor, pixels)


def is_kept(extractor: Extractor, pixels: Pixels) -> bool:
    """Whether the features are on disk."""
    return cache.path(KIND, _key(extractor, pixels)).is_file()


def _key(extractor: Extractor, pixels: Pixels) -> dict[str, Any]:
    return {
        "image": pixels.content_hash(),
        "extractor": spec.written(extractor),
        "source": cache.source(sys.modules[type(extractor).__module__]),
        "libraries": environment.libraries(),
    }


def to_arrays(found: Features) -> Arrays:
    """The features without what they do not have."""
    parts = {"keypoints": found.keypoints, "descriptors": found.descriptors, "codes": found.codes, "frames": found.frames}
    return {name: array for name, array in parts.items() if array is not None}


def from_arrays(arrays: Arrays, size: tuple[int, int]) -> Features:
    """The features that `to_arrays` took apart."""
    parts: dict[str, np.ndarray | None] = {name: arrays.get(name) for name in ("codes", "frames")}
    return Features(keypoints=arrays["keypoints"], descriptors=arrays["descriptors"], size=size, **parts)
