"""Which of several unit vectors that an attacker found for a keypoint is its descriptor, and not an adversary's word.

What is known of SIFT, and of how lifting draws its words, tells without knowing any word:

- A word that was met at two keypoints is an adversary's: those of a photograph come from one sub-database.
- SIFT cuts components at 0.2 and scales again (Lowe, IJCV 2004), so that several share the greatest value: at least 4 in 98% of
  descriptors. In a cluster's centre, the mean of several, few do.
- A centre has fewer zeros, too.

A database of raw descriptors leaves the first alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.types import Floats, Indices

EQUAL = 1e-5  # components of unit vectors that differ by no more are equal
GRID = 1e-4  # vectors that are the same when rounded to this are one word


def most_genuine(owners: Indices, rows: Floats, count: int) -> Indices:
    """Of the candidates of each keypoint, the one most like a descriptor.

    Parameters
    ----------
    owners : (n,) the keypoint that each candidate is of
    rows : (n, D) unit vectors, nowhere negative
    count : number of keypoints

    Returns
    -------
    (count,) indices of candidates, -1 for a keypoint without. First come those that were met at one keypoint alone, then those
    with the most components equal to the greatest, then those with the most zeros.
    """
    order = np.lexsort((-zeros(rows), -ties(rows), recurring(owners, rows), owners))
    found, first = np.unique(owners[order], return_index=True)
    best = np.full(count, -1, dtype=np.int64)
    best[found] = order[first]
    return best


def ties(rows: Floats) -> NDArray[np.int64]:
    """How many components equal the greatest. (n, D) -> (n,)"""
    return (rows >= rows.max(axis=1, keepdims=True) - EQUAL).sum(axis=1)


def zeros(rows: Floats) -> NDArray[np.int64]:
    """How many components vanish. (n, D) -> (n,)"""
    return (rows <= EQUAL).sum(axis=1)


def recurring(owners: Indices, rows: Floats) -> NDArray[np.bool_]:
    """Whether another keypoint has the same candidate. (n,), (n, D) -> (n,)"""
    words = np.rint(rows / GRID).astype(np.int16)
    _, same = np.unique(words, axis=0, return_inverse=True)  # (n,)
    pairs = np.unique(np.stack([same, owners], axis=1), axis=0)  # each word once a keypoint
    return np.bincount(pairs[:, 0])[same] > 1
