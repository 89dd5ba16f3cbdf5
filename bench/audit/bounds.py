"""Bounds of probabilities from counts (Clopper and Pearson, Biometrika 1934), and of the ratio of two of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Doubles = NDArray[np.float64]


def log_ratio(hits: Any, trials: Any, other_hits: Any, other_trials: Any, confidence: float) -> Doubles:
    """ln(p1 / p2) at least, with the given confidence, from independent counts of shape (...). -> (...), −∞ where hits are 0

    Each of p1, from below, and p2, from above, may fail with half of what the confidence leaves.
    """
    rest = (1 - confidence) / 2
    hits, trials = np.asarray(hits, dtype=float), np.asarray(trials, dtype=float)
    other_hits, other_trials = np.asarray(other_hits, dtype=float), np.asarray(other_trials, dtype=float)
    # Where no bound is possible the formula has no value; that at 1 in its place is of no account.
    least = np.where(hits > 0, stats.beta.ppf(rest, np.maximum(hits, 1), trials - hits + 1), 0.0)
    all_hit = other_hits == other_trials
    most = np.where(all_hit, 1.0, stats.beta.isf(rest, other_hits + 1, np.where(all_hit, 1, other_trials - other_hits)))
    with np.errstate(divide="ignore"):
        return np.log(least) - np.log(most)


def more_alike_than_independent(hits: NDArray[np.integer[Any]], places: int, chance: float = 1e-6) -> bool:
    """Whether counts of so many places each are further apart than binomial ones, which are so with that chance. hits: (C,)"""
    calls, total = len(hits), int(hits.sum())
    share = total / (calls * places)
    if places == 1 or share in (0, 1):
        return False
    crowded = calls * stats.binom.sf(hits.max() - 1, places, share)  # that one of them is so large
    if total < calls:  # too few for χ²
        return bool(crowded < chance)
    index = float(np.square(hits - hits.mean()).sum()) / (places * share * (1 - share))
    return bool(min(crowded, stats.chi2.sf(index, calls - 1)) < chance)
