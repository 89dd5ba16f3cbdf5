"""Confidence intervals of a mean over samples: percentile bootstrap (Efron 1979), and Wilson's interval for a fraction."""

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
SEED = 0  # samples of equal size are resampled alike, so that intervals of one table can be compared


@dataclass(frozen=True)
class Interval:
    """A mean with its confidence interval, 95% by default. The population is photographs of the same kind."""

    mean: float
    low: float
    high: float
    count: int  # of samples, such as photographs


def interval(values: ArrayLike, level: float = LEVEL) -> Interval:
    """Return the mean of (n,) values, one per photograph, n ≥ 1, with its bootstrap interval.

    The interval is infinite if n = 1. For a paired comparison, pass the differences.
    """
    sample = np.asarray(values, dtype=np.float64)
    if len(sample) == 1:
        return Interval(float(sample[0]), -math.inf, math.inf, 1)
    indexes = np.random.default_rng(SEED).integers(len(sample), size=(RESAMPLES, len(sample)))
    means = sample[indexes].mean(axis=1)  # (RESAMPLES,)
    low, high = np.quantile(means, ((1 - level) / 2, (1 + level) / 2))
    return Interval(float(sample.mean()), float(low), float(high), len(sample))


def combine_independent(samples: Sequence[ArrayLike], weights: Sequence[float]) -> Interval:
    """Return Σ weight · mean of independent samples, each resampled separately. `count` is the size of the smallest sample."""
    total, resampled = 0.0, np.zeros(RESAMPLES)
    for rng, values, weight in zip(np.random.default_rng(SEED).spawn(len(samples)), samples, weights, strict=True):
        sample = np.asarray(values, dtype=np.float64)
        indexes = rng.integers(len(sample), size=(RESAMPLES, len(sample)))
        total += weight * float(sample.mean())
        resampled += weight * sample[indexes].mean(axis=1)
    low, high = np.quantile(resampled, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return Interval(total, float(low), float(high), min(len(np.asarray(values)) for values in samples))


def proportion(hits: ArrayLike, times: float = 1.0) -> Interval:
    """Return the fraction of hits among (n,) trials, each 1 or 0, with Wilson's interval (1927), all multiplied by `times`."""
    sample = np.asarray(hits, dtype=np.float64)
    wilson = binomtest(int(sample.sum()), len(sample)).proportion_ci(LEVEL, method="wilson")
    return Interval(float(sample.mean()) * times, float(wilson.low) * times, float(wilson.high) * times, len(sample))


def rank_correlation(one: Sequence[float], other: Sequence[float]) -> float:
    """Return Spearman's ρ of two lists of equal length; NaN if it is undefined. Ties have their mean rank."""
    return float(pd.DataFrame({"one": one, "other": other}).corr(method="spearman").to_numpy()[0, 1])
