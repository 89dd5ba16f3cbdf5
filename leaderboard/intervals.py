"""How sure a mean over units is: percentile bootstrap (Efron 1979), and for a share, Wilson's interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.stats import binomtest

LEVEL = 0.95
RESAMPLES = 10_000
SEED = 0  # samples of one size are resampled alike, so that intervals of one table can be compared


@dataclass(frozen=True)
class Interval:
    """A mean, and where it would lie for other photographs of the kind with 95% confidence, if no other is asked for."""

    mean: float
    low: float
    high: float
    count: int  # units, such as photographs


def interval(values: ArrayLike, level: float = LEVEL) -> Interval:
    """The mean of (n,) values, one a photograph, n at least 1, with its bootstrap interval; of a single one it has no ends.

    For a paired comparison, hand over the differences.
    """
    sample = np.asarray(values, dtype=np.float64)
    if len(sample) == 1:
        return Interval(float(sample[0]), -math.inf, math.inf, 1)
    drawn = np.random.default_rng(SEED).integers(len(sample), size=(RESAMPLES, len(sample)))
    means = sample[drawn].mean(axis=1)  # (RESAMPLES,)
    low, high = np.quantile(means, ((1 - level) / 2, (1 + level) / 2))
    return Interval(float(sample.mean()), float(low), float(high), len(sample))


def combine_independent(samples: Sequence[ArrayLike], weights: Sequence[float]) -> Interval:
    """Σ weight · mean of samples that have nothing to do with each other, each resampled by itself; `count` is the smallest's."""
    total, resampled = 0.0, np.zeros(RESAMPLES)
    for rng, values, weight in zip(np.random.default_rng(SEED).spawn(len(samples)), samples, weights, strict=True):
        sample = np.asarray(values, dtype=np.float64)
        drawn = rng.integers(len(sample), size=(RESAMPLES, len(sample)))
        total += weight * float(sample.mean())
        resampled += weight * sample[drawn].mean(axis=1)
    low, high = np.quantile(resampled, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Interval(total, float(low), float(high), min(len(np.asarray(values)) for values in samples))


def proportion(hits: ArrayLike, times: float = 1.0) -> Interval:
    """The share of (n,) trials, each 1 or 0, that are hits, with Wilson's interval (1927); all multiplied by `times`."""
    sample = np.asarray(hits, dtype=np.float64)
    found = binomtest(int(sample.sum()), len(sample)).proportion_ci(LEVEL, method="wilson")
    return Interval(float(sample.mean()) * times, float(found.low) * times, float(found.high) * times, len(sample))


def rank_correlation(one: Sequence[float], other: Sequence[float]) -> float:
    """Spearman's ρ of two lists of equal length; ties share their mean rank. NaN where it is undefined."""
    return float(pd.DataFrame({"one": one, "other": other}).corr(method="spearman").to_numpy()[0, 1])
