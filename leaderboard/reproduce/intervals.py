"""How sure a mean over photographs is: percentile bootstrap (Efron 1979); and a share of queries: Wilson's interval (1927)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.stats import norm

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


def share(values: ArrayLike) -> Interval:
    """The mean of (n,) values that are 0 or 1, one a query, n at least 1, with Wilson's interval, which holds near 0 and 1, too.

    Values between, where a query was tried with several seeds and succeeded with some, count as so much of a success; n stays
    the number of queries, so the interval is no narrower for it.
    """
    sample = np.asarray(values, dtype=np.float64)
    mean, count = float(sample.mean()), len(sample)
    z = float(norm.ppf((1 + LEVEL) / 2))
    centre = (mean + z**2 / (2 * count)) / (1 + z**2 / count)
    reach = z / (1 + z**2 / count) * math.sqrt(mean * (1 - mean) / count + z**2 / (4 * count**2))
    return Interval(mean, max(0.0, centre - reach), min(1.0, centre + reach), count)


def rank_correlation(one: Sequence[float], other: Sequence[float]) -> float:
    """Spearman's ρ of two lists of equal length; ties share their mean rank. NaN where it is undefined."""
    return float(pd.DataFrame({"one": one, "other": other}).corr(method="spearman").to_numpy()[0, 1])
