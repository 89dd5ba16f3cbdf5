"""Detection of faces, by the cascade of local binary patterns in scikit-image's wheel."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from importlib.metadata import version
from types import MappingProxyType
from typing import Any

import numpy as np

from bench.cache import provenance, store
from bench.identification.thumbnails import Doubles

KIND = "faces"  # in the cache
# Parameters of the detector, whose training window is 24 pixels wide.
DETECTOR: Mapping[str, Any] = MappingProxyType(
    {"cascade": "lbpcascade_frontalface", "scale_factor": 1.1, "step_ratio": 1.0, "smallest": 32}
)
OVERLAP = 0.5  # least intersection over union of two detections of one face


def detect_faces(image: Doubles) -> Doubles:
    """Return the faces that are detected in an image, sorted. (H, W, 3) in [0, 1] -> (F, 4) top, left, height, width in pixels"""
    return _detect_faces(image.tobytes(), image.shape)


def find_again(faces: Doubles, detections: Doubles) -> np.ndarray:
    """Return whether each face is among the detections, by an overlap of at least `OVERLAP`. (F, 4), (G, 4) -> (F,) bool"""
    return np.asarray((compute_overlap(faces[:, None], detections[None]) >= OVERLAP).any(axis=1))


def compute_overlap(one: Doubles, other: Doubles) -> Doubles:
    """Return the intersection over union of boxes. (..., 4) top, left, height and width in pixels -> (...)"""
    low = np.maximum(one[..., :2], other[..., :2])
    high = np.minimum(one[..., :2] + one[..., 2:], other[..., :2] + other[..., 2:])
    intersection = np.clip(high - low, 0, None).prod(axis=-1)
    return intersection / (one[..., 2:].prod(axis=-1) + other[..., 2:].prod(axis=-1) - intersection)


# The cache in memory serves all attacks on a photograph, the one on disk all commands.
@functools.lru_cache(maxsize=2)
def _detect_faces(pixels: bytes, shape: tuple[int, int, int]) -> Doubles:
    """Return the faces that are detected in a float64 image, as boxes (F, 4)."""
    key = {
        "image": [hashlib.sha256(pixels).hexdigest(), list(shape)],
        "source": provenance.hash_modules(__name__),
        "libraries": {library: version(library) for library in ("numpy", "scikit-image")},
    }
    image = np.frombuffer(pixels).reshape(shape)
    return store.fetch(KIND, key, lambda: ({"boxes": _apply_detector(image)}, {}))[0]["boxes"]


def _apply_detector(image: Doubles) -> Doubles:
    smallest = DETECTOR["smallest"]
    detections = _load_detector().detect_multi_scale(
        img=np.rint(image * 255).astype(np.uint8),
        scale_factor=DETECTOR["scale_factor"],
        step_ratio=DETECTOR["step_ratio"],
        min_size=(smallest, smallest),
        max_size=image.shape[:2],
    )
    boxes = sorted((face["r"], face["c"], face["height"], face["width"]) for face in detections)
    return np.array(boxes, dtype=np.float64).reshape(-1, 4)


@functools.cache
def _load_detector() -> Any:
    from skimage.data import lbp_frontal_face_cascade_filename
    from skimage.feature import Cascade

    return Cascade(lbp_frontal_face_cascade_filename())
