"""Mean absolute error of an image; one of the three metrics of the paper's Tables 1 and 4."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from bench.api import LocalMetric
from bench.geometry.metric_inputs import validate_images
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class MAE(LocalMetric):
    """Mean absolute error over pixels and channels."""

    unit: ClassVar[str] = "intensity"
    range: ClassVar[tuple[float, float]] = (0.0, 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "defender"

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        return float(self.local(truth, estimate).mean())

    def local(self, truth: Floats, estimate: Floats) -> Floats:
        # (H, W, 3) in [0, 1] each
        true, estimated = validate_images(truth, estimate)
        return np.abs(true - estimated).mean(axis=2)


PLUGIN = MAE
