"""Bounds of the ratio of two probabilities from counts (Clopper and Pearson, Biometrika 1934), and a dispersion test."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Doubles = NDArray[np.float64]


def log_ratio(hits: Any, trials: Any, other_hits: Any, other_trials: Any, confidence: float) -> Doubles:
    """Return a lower bound of ln(p1 / p2) at this confidence, from independent counts (...). -> (...), −∞ if hits are 0

    The lower bound of p1 and the upper bound of p2 each fail with half of the remaining probability.
    """
    rest = (1 - confidence) / 2
    hits, trials = np.asarray(hits, dtype=float), np.asarray(trials, dtype=float)
    other_hits, other_trials = np.asarray(other_hits, dtype=float), np.asarray(other_trials, dtype=float)
    # If the formula has no value, it is evaluated at 1 and the result is discarded.
    least = np.where(hits > 0, stats.beta.ppf(rest, np.maximum(hits, 1), trials - hits + 1), 0.0)
    all_hit = other_hits == other_trials
    most = np.where(all_hit, 1.0, stats.beta.isf(rest, other_hits + 1, np.where(all_hit, 1, other_trials - other_hits)))
    with np.errstate(divide="ignore"):
        return np.log(least) - np.log(most)


def is_overdispersed(hits: NDArray[np.integer[Any]], trials: int, chance: float = 1e-6) -> bool:
    """Return whether counts, of `trials` each, vary more than binomial ones. False positives: `chance`. hits: (C,)"""
    calls, total = len(hits), int(hits.sum())
    rate = total / (calls * trials)
    if trials == 1 or rate in (0, 1):
        return False
    extreme = calls * stats.binom.sf(hits.max() - 1, trials, rate)  # the chance of so large a maximum
    if total < calls:  # too few for χ²
        return bool(extreme < chance)
    index = float(np.square(hits - hits.mean()).sum()) / (trials * rate * (1 - rate))
    return bool(min(extreme, stats.chi2.sf(index, calls - 1)) < chance)
