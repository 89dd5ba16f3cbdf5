"""Euclidean error of recovered descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from bench.api import Metric
from bench.geometry.metric_inputs import validate_descriptors
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class L2(Metric):
    """Mean Euclidean distance between a true descriptor and its estimate; at most 2, as both have unit norm."""

    compares: ClassVar[Literal["images", "descriptors"]] = "descriptors"
    unit: ClassVar[str] = "descriptor norm"
    range: ClassVar[tuple[float, float]] = (0.0, 2.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "defender"

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        # (N, D) each
        true, estimated = validate_descriptors(truth, estimate)
        return float(np.linalg.norm(true - estimated, axis=1).mean())


PLUGIN = L2
