"""Angular error of recovered descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from bench.api import Metric
from bench.geometry.metric_inputs import normalize_rows, validate_descriptors
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class Angle(Metric):
    """Mean angle between a true descriptor and its estimate.

    The angle of unit vectors u and v is 2 atan2(|u − v|, |u + v|) (Kahan). Unlike arccos, this loses no digits near 0° and 180°.
    An estimate of zeros has no direction and counts as 90°.
    """

    compares: ClassVar[Literal["images", "descriptors"]] = "descriptors"
    unit: ClassVar[str] = "degrees"
    range: ClassVar[tuple[float, float]] = (0.0, 180.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "defender"

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        # (N, D) each
        u, v = map(normalize_rows, validate_descriptors(truth, estimate))
        halves = np.arctan2(np.linalg.norm(u - v, axis=1), np.linalg.norm(u + v, axis=1))  # (N,)
        return float(np.degrees(2 * halves).mean())


PLUGIN = Angle
