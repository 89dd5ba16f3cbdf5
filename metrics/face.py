"""Detection rate of faces, by the cascade of local binary patterns in scikit-image's wheel."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np

from bench.api import Metric
from bench.geometry.metric_inputs import Doubles, validate_images
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class Face(Metric):
    """Fraction of the photograph's detected faces that are detected again at the same position; none if it has no face.

    A face is detected again if a detection in the estimate overlaps it by an intersection over union of at least `overlap`. So a
    hallucinated face at another position does not count. The metric detects faces and identifies nobody.
    """

    compares: ClassVar[Literal["images", "descriptors"]] = "images"
    unit: ClassVar[str] = "fraction"
    range: ClassVar[tuple[float, float]] = (0.0, 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "attacker"
    # Parameters of the detector, whose training window is 24 pixels wide, and of the comparison.
    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {"cascade": "lbpcascade_frontalface", "scale_factor": 1.1, "step_ratio": 1.0, "smallest": 32, "overlap": 0.5}
    )

    def __call__(self, truth: Floats, estimate: Floats) -> float | None:
        # (H, W, 3) in [0, 1] each
        true, estimated = validate_images(truth, estimate)
        faces = _detect_faces(true.tobytes(), true.shape)
        if len(faces) == 0:
            return None
        again = _detect_faces(estimated.tobytes(), estimated.shape)
        overlaps = compute_overlap(faces[:, None], again[None])  # (F, G)
        return float((overlaps >= self.parameters["overlap"]).any(axis=1).mean())


def compute_overlap(one: Doubles, other: Doubles) -> Doubles:
    """Return the intersection over union of boxes. (..., 4) top, left, height and width in pixels -> (...)"""
    low = np.maximum(one[..., :2], other[..., :2])
    high = np.minimum(one[..., :2] + one[..., 2:], other[..., :2] + other[..., 2:])
    intersection = np.clip(high - low, 0, None).prod(axis=-1)
    return intersection / (one[..., 2:].prod(axis=-1) + other[..., 2:].prod(axis=-1) - intersection)


# The cache lets all attacks on a photograph share its detections.
@functools.lru_cache(maxsize=2)
def _detect_faces(pixels: bytes, shape: tuple[int, int, int]) -> Doubles:
    """Return the faces that are detected in a float64 image, as boxes (F, 4)."""
    image = np.frombuffer(pixels).reshape(shape)
    smallest, settings = Face.parameters["smallest"], Face.parameters
    detections = _load_detector().detect_multi_scale(
        img=np.rint(image * 255).astype(np.uint8),
        scale_factor=settings["scale_factor"],
        step_ratio=settings["step_ratio"],
        min_size=(smallest, smallest),
        max_size=shape[:2],
    )
    boxes = sorted((face["r"], face["c"], face["height"], face["width"]) for face in detections)
    return np.array(boxes, dtype=np.float64).reshape(-1, 4)


@functools.cache
def _load_detector() -> Any:
    from skimage.data import lbp_frontal_face_cascade_filename
    from skimage.feature import Cascade

    return Cascade(lbp_frontal_face_cascade_filename())


PLUGIN = Face
