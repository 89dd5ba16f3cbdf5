"""Peak signal-to-noise ratio of an image; one of the three metrics of the paper's Tables 1 and 4."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from bench.api import Metric
from bench.geometry.metric_inputs import validate_images
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class PSNR(Metric):
    """Peak signal-to-noise ratio, 10 log10(1 / MSE); none if the images are equal."""

    compares: ClassVar[Literal["images", "descriptors"]] = "images"
    unit: ClassVar[str] = "dB"
    range: ClassVar[tuple[float, float]] = (0.0, math.inf)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "attacker"

    def __call__(self, truth: Floats, estimate: Floats) -> float | None:
        # (H, W, 3) in [0, 1] each
        true, estimated = validate_images(truth, estimate)
        mse = float(np.square(true - estimated).mean())
        return None if mse == 0 else -10 * math.log10(mse)


PLUGIN = PSNR
