"""Scores of a random order of the photographs among which `identified` ranks the true one."""

from __future__ import annotations

import numpy as np

from bench.identification.distractors import COUNT

IDENTIFIED = "identified"  # the metric: the reciprocal rank
PHOTOGRAPHS = COUNT + 1
_RANKS = np.arange(1, PHOTOGRAPHS + 1)
FIRST = 1 / PHOTOGRAPHS  # the probability of rank 1
RECIPROCAL_RANK = float(np.mean(1 / _RANKS))
LOG_RECIPROCAL_RANK = float(np.mean(-np.log2(_RANKS)))  # in bits

REMARK = (
    f"{IDENTIFIED}: the mean reciprocal rank of the photograph among {PHOTOGRAPHS}. Chance, a random order, gives "
    f"{RECIPROCAL_RANK:.3g}, and rank 1 for 1 of {PHOTOGRAPHS}."
)


def label_identified() -> str:
    """Return the label of the metric, with its value by chance."""
    return f"{IDENTIFIED} (chance {RECIPROCAL_RANK:.2g})"
