"""Mean squared error of an image; PSNR is its logarithm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from bench.api import Metric
from bench.geometry.metric_inputs import validate_images
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class MSE(Metric):
    """Mean squared error over pixels and channels."""

    compares: ClassVar[Literal["images", "descriptors"]] = "images"
    unit: ClassVar[str] = "intensity squared"
    range: ClassVar[tuple[float, float]] = (0.0, 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "defender"

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        # (H, W, 3) in [0, 1] each
        true, estimated = validate_images(truth, estimate)
        return float(np.square(true - estimated).mean())


PLUGIN = MSE
