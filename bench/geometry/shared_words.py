"""Which keypoints of two images were given a word in common."""

from __future__ import annotations

import numpy as np

from bench.types import Indices


def sharing(first: Indices, second: Indices, unique: bool = False) -> Indices:
    """Pairs of rows that have a word in common, each once, by first row and then by second. (N, m), (N', m') -> (M, 2)

    Parameters
    ----------
    first, second : rows of distinct words of one dictionary
    unique : whether only those words count that one row alone has, among the first and among the second
    """
    (words, owners), (others, theirs) = (_by_word(rows, unique) for rows in (first, second))
    left, right = np.searchsorted(words, others, "left"), np.searchsorted(words, others, "right")
    counts = right - left
    places = np.arange(counts.sum()) + np.repeat(left - (counts.cumsum() - counts), counts)
    keys = np.unique(owners[places] * len(second) + np.repeat(theirs, counts))
    return np.stack(np.divmod(keys, max(1, len(second))), axis=1)


def _by_word(rows: Indices, unique: bool) -> tuple[Indices, Indices]:
    """All words in ascending order, or those that occur once, and the row of each. (N, m) -> (P,), (P,)"""
    order = rows.ravel().argsort(kind="stable")
    words, owners = rows.ravel()[order], order // max(1, rows.shape[1])
    if not unique:
        return words, owners
    found, first, counts = np.unique(words, return_index=True, return_counts=True)
    return found[counts == 1], owners[first[counts == 1]]
