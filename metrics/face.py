"""Whether a face detector still finds the faces: the cascade of local binary patterns that scikit-image's wheel carries."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np

from bench.api import Metric
from bench.geometry.metric_inputs import Doubles, image_pair
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class Face(Metric):
    """Share of the faces found in the photograph that are found again at the same place; none where it shows no face.

    A face is found again if a detection in the estimate overlaps it by an intersection over union of at least `overlap`, so
    that a face which a network dreams up elsewhere does not count. It says that somebody is seen, not who.
    """

    compares: ClassVar[Literal["images", "descriptors"]] = "images"
    unit: ClassVar[str] = "share"
    range: ClassVar[tuple[float, float]] = (0.0, 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "attacker"
    # The detector's own; the window of its training is 24 pixels wide.
    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {"cascade": "lbpcascade_frontalface", "scale_factor": 1.1, "step_ratio": 1.0, "smallest": 32, "overlap": 0.5}
    )

    def __call__(self, truth: Floats, estimate: Floats) -> float | None:
        # (H, W, 3) in [0, 1] each
        true, estimated = image_pair(truth, estimate)
        faces = _faces(true.tobytes(), true.shape)
        if len(faces) == 0:
            return None
        again = _faces(estimated.tobytes(), estimated.shape)
        overlaps = overlap(faces[:, None], again[None])  # (F, G)
        return float((overlaps >= self.parameters["overlap"]).any(axis=1).mean())


def overlap(one: Doubles, other: Doubles) -> Doubles:
    """Intersection over union of boxes (..., 4): top, left, height, width in pixels. -> (...)"""
    low = np.maximum(one[..., :2], other[..., :2])
    high = np.minimum(one[..., :2] + one[..., 2:], other[..., :2] + other[..., 2:])
    shared = np.clip(high - low, 0, None).prod(axis=-1)
    return shared / (one[..., 2:].prod(axis=-1) + other[..., 2:].prod(axis=-1) - shared)


# The photograph is the same for every attack on it.
@functools.lru_cache(maxsize=2)
def _faces(pixels: bytes, shape: tuple[int, int, int]) -> Doubles:
    """Detections in a float64 image as boxes (F, 4)."""
    image = np.frombuffer(pixels).reshape(shape)
    smallest, settings = Face.parameters["smallest"], Face.parameters
    found = _detector().detect_multi_scale(
        img=np.rint(image * 255).astype(np.uint8),
        scale_factor=settings["scale_factor"],
        step_ratio=settings["step_ratio"],
        min_size=(smallest, smallest),
        max_size=shape[:2],
    )
    boxes = sorted((face["r"], face["c"], face["height"], face["width"]) for face in found)
    return np.array(boxes, dtype=np.float64).reshape(-1, 4)


@functools.cache
def _detector() -> Any:
    from skimage.data import lbp_frontal_face_cascade_filename
    from skimage.feature import Cascade

    return Cascade(lbp_frontal_face_cascade_filename())


PLUGIN = Face
