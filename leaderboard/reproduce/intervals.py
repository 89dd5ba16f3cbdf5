"""How sure a mean over photographs is: percentile bootstrap (Efron 1979)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

LEVEL = 0.95
RESAMPLES = 10_000
SEED = 0  # samples of one size are resampled alike, so that intervals of one table can be compared


@dataclass(frozen=True)
class Interval:
    """A mean, and where it would lie for other photographs of the kind with 95% confidence."""

    mean: float
    low: float
    high: float
    count: int  # photographs


def interval(values: ArrayLike) -> Interval:
    """The mean of (n,) values, one a photograph, n at least 1, with its bootstrap interval; of a single one it has no ends.

    For a paired comparison, hand over the differences.
    """
    sample = np.asarray(values, dtype=np.float64)
    if len(sample) == 1:
        return Interval(float(sample[0]), -math.inf, math.inf, 1)
    drawn = np.random.default_rng(SEED).integers(len(sample), size=(RESAMPLES, len(sample)))
    means = sample[drawn].mean(axis=1)  # (RESAMPLES,)
    low, high = np.quantile(means, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Interval(float(sample.mean()), float(low), float(high), len(sample))


def rank_correlation(one: Sequence[float], other: Sequence[float]) -> float:
    """Spearman's ρ of two lists of equal length; ties share their mean rank. NaN where it is undefined."""
    return float(pd.DataFrame({"one": one, "other": other}).corr(method="spearman").to_numpy()[0, 1])
