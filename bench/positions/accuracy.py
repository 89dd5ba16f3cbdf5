"""Accuracy of recovered positions."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from bench.api import Metric
from bench.types import Floats


class PositionAUC(Metric):
    """Area under the curve of the fraction of keypoints within a distance, up to a greatest distance, as a fraction of the whole.

    The curve is a step function, so the area is the mean of max(0, 1 − error / greatest distance).
    """

    compares: ClassVar[Literal["positions"]] = "positions"
    unit: ClassVar[str] = "fraction"
    range: ClassVar[tuple[float, float]] = (0.0, 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "attacker"
    reach: ClassVar[float]  # pixels

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        # (N, 2) each
        errors = np.linalg.norm(truth.astype(np.float64) - estimate, axis=1)
        return float(np.maximum(0, 1 - errors / self.reach).mean())
