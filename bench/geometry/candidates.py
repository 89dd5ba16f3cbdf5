"""Selects, among unit vectors that an attacker found for a keypoint, its descriptor rather than an adversarial word.

No word needs to be known. The criteria rest on SIFT and on how lifting draws its words:

- A vector that occurs at two keypoints is an adversarial word: the words of a photograph come from one sub-database.
- SIFT cuts components at 0.2 and scales again (Lowe, IJCV 2004), so that several share the greatest value: at least 4 in 98% of
  descriptors. In the centre of a cluster, the mean of several descriptors, few components do.
- A centre has fewer zeros.

For a database of raw descriptors, only the first criterion applies.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.types import Floats, Indices

EQUAL_TOLERANCE = 1e-5  # components of unit vectors that differ by no more are equal
GRID = 1e-4  # vectors that are the same when rounded to this are one word


def select_descriptors(owners: Indices, rows: Floats, count: int) -> Indices:
    """Return for each keypoint its candidate most like a descriptor.

    Parameters
    ----------
    owners : (n,) the keypoint that each candidate is of
    rows : (n, D) unit vectors, nowhere negative
    count : number of keypoints

    Returns
    -------
    (count,) indices of candidates, -1 for a keypoint without. Candidates that occur at one keypoint only come first, then those
    with the most components equal to the greatest, then those with the most zeros.
    """
    order = np.lexsort((-count_zeros(rows), -count_maxima(rows), find_recurring(owners, rows), owners))
    keypoints, first = np.unique(owners[order], return_index=True)
    best = np.full(count, -1, dtype=np.int64)
    best[keypoints] = order[first]
    return best


def count_maxima(rows: Floats) -> NDArray[np.int64]:
    """Number of components equal to the greatest. (n, D) -> (n,)"""
    return (rows >= rows.max(axis=1, keepdims=True) - EQUAL_TOLERANCE).sum(axis=1)


def count_zeros(rows: Floats) -> NDArray[np.int64]:
    """Number of zero components. (n, D) -> (n,)"""
    return (rows <= EQUAL_TOLERANCE).sum(axis=1)


def find_recurring(owners: Indices, rows: Floats) -> NDArray[np.bool_]:
    """Whether another keypoint has the same candidate. (n,), (n, D) -> (n,)"""
    words = np.rint(rows / GRID).astype(np.int16)
    _, same = np.unique(words, axis=0, return_inverse=True)  # (n,)
    pairs = np.unique(np.stack([same, owners], axis=1), axis=0)  # each word once per keypoint
    return np.bincount(pairs[:, 0])[same] > 1
