"""The fraction of descriptors that an attack recovers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from bench.api import Metric
from bench.geometry.metric_inputs import normalize_rows, validate_descriptors
from bench.types import Floats

COSINES = 2**26  # in memory at a time: those of 8192 keypoints at once


@dataclass(frozen=True, kw_only=True)
class Recovered(Metric):
    """Fraction of keypoints whose estimate is nearest to their own true descriptor, among all in the photograph.

    (1 / N) · |{i : t_i = t_j(i)}| with j(i) = argmax_j cos(t_j, e_i), where t are the true descriptors and e the estimates.
    The candidates are the N true descriptors of the same photograph. Ties go to the lowest index, and equal descriptors count as
    one candidate. For N different descriptors the chance level is 1 / N. Every constant estimate has this score, and an attacker
    without information about the keypoints does no better.
    """

    compares: ClassVar[Literal["images", "descriptors"]] = "descriptors"
    unit: ClassVar[str] = "fraction"
    range: ClassVar[tuple[float, float]] = (0.0, 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "attacker"

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        # (N, D) each
        true, estimated = validate_descriptors(truth, estimate)
        queries, candidates = normalize_rows(estimated), normalize_rows(true)
        step = max(1, COSINES // len(true))
        starts = range(0, len(true), step)
        nearest = np.concatenate([(queries[start : start + step] @ candidates.T).argmax(axis=1) for start in starts])  # (N,) j(i)
        return float((true[nearest] == true).all(axis=1).mean())


PLUGIN = Recovered
