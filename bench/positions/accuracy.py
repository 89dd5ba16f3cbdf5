"""Accuracy of recovered positions."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from bench.api import Metric
from bench.types import Floats


def measure_errors(truth: Floats, estimate: Floats) -> NDArray[np.float64]:
    """Return the distance of each recovered position to the true one. (N, 2) twice -> (N,) pixels"""
    errors: NDArray[np.float64] = np.linalg.norm(truth.astype(np.float64) - estimate, axis=1)
    return errors


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
        return float(np.maximum(0, 1 - measure_errors(truth, estimate) / self.reach).mean())
