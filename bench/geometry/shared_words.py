"""Pairs of keypoints of two images whose word sets share a word."""

from __future__ import annotations

import numpy as np

from bench.types import Indices


def find_shared_words(first: Indices, second: Indices, unique: bool = False) -> Indices:
    """Return the pairs of rows that share a word, each once, by first row and then by second. (N, m), (N', m') -> (M, 2)

    Parameters
    ----------
    first, second : rows of distinct words of one dictionary
    unique : whether only words count that occur in one row of `first` and one row of `second`
    """
    (words, owners), (other_words, other_owners) = (_sort_by_word(rows, unique) for rows in (first, second))
    left, right = np.searchsorted(words, other_words, "left"), np.searchsorted(words, other_words, "right")
    counts = right - left
    matches = np.arange(counts.sum()) + np.repeat(left - (counts.cumsum() - counts), counts)
    keys = np.unique(owners[matches] * len(second) + np.repeat(other_owners, counts))
    return np.stack(np.divmod(keys, max(1, len(second))), axis=1)


def _sort_by_word(rows: Indices, unique: bool) -> tuple[Indices, Indices]:
    """Return all words in ascending order, or those that occur once, and the row of each. (N, m) -> (P,), (P,)"""
    order = rows.ravel().argsort(kind="stable")
    words, owners = rows.ravel()[order], order // max(1, rows.shape[1])
    if not unique:
        return words, owners
    distinct, first, counts = np.unique(words, return_index=True, return_counts=True)
    return distinct[counts == 1], owners[first[counts == 1]]
