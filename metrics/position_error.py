"""Error of recovered positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from bench.api import Metric
from bench.positions.accuracy import measure_errors
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class PositionError(Metric):
    """Median distance between a keypoint and its recovered position."""

    compares: ClassVar[Literal["positions"]] = "positions"
    unit: ClassVar[str] = "pixels"
    range: ClassVar[tuple[float, float]] = (0.0, float("inf"))
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "defender"

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        # (N, 2) each
        return float(np.median(measure_errors(truth, estimate)))


PLUGIN = PositionError
