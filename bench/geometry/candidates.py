"""Selection of the descriptor among unit vectors of a subspace, which also contains adversarial words.

The attacker needs to know no word. The criteria use properties of SIFT, and of the drawing of words by lifting:

- A vector that occurs at two keypoints is an adversarial word, since the words of a photograph come from one sub-database.
- SIFT clips components at 0.2 and normalizes again (Lowe, IJCV 2004). So several components equal the greatest one: at least 4 in
  98% of descriptors. Cluster centres are means of several descriptors, and few of their components equal the greatest one.
- A cluster centre has fewer zeros than a descriptor.

If the database consists of raw descriptors, only the first criterion applies.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.types import Floats, Indices

EQUAL_TOLERANCE = 1e-5  # components of unit vectors that differ by at most this are equal
GRID = 1e-4  # vectors that are equal after rounding to this are one word


def select_descriptors(owners: Indices, rows: Floats, count: int) -> Indices:
    """Return for each keypoint the candidate that is most similar to a descriptor.

    Parameters
    ----------
    owners : (n,) the keypoint of each candidate
    rows : (n, D) unit vectors without negative components
    count : number of keypoints

    Returns
    -------
    (count,) indices of candidates, -1 for a keypoint without candidates. Candidates at one keypoint only are preferred, then
    those with most components equal to the greatest one, then those with most zeros.
    """
    order = np.lexsort((-count_zeros(rows), -count_maxima(rows), find_recurring(owners, rows), owners))
    keypoints, first = np.unique(owners[order], return_index=True)
    best = np.full(count, -1, dtype=np.int64)
    best[keypoints] = order[first]
    return best


def count_maxima(rows: Floats) -> NDArray[np.int64]:
    """Return the number of components equal to the greatest one. (n, D) -> (n,)"""
    return (rows >= rows.max(axis=1, keepdims=True) - EQUAL_TOLERANCE).sum(axis=1)


def count_zeros(rows: Floats) -> NDArray[np.int64]:
    """Return the number of zero components. (n, D) -> (n,)"""
    return (rows <= EQUAL_TOLERANCE).sum(axis=1)


def find_recurring(owners: Indices, rows: Floats) -> NDArray[np.bool_]:
    """Return whether another keypoint has the same candidate. (n,), (n, D) -> (n,)"""
    words = np.rint(rows / GRID).astype(np.int16)
    _, same = np.unique(words, axis=0, return_inverse=True)  # (n,)
    pairs = np.unique(np.stack([same, owners], axis=1), axis=0)  # each word once per keypoint
    return np.bincount(pairs[:, 0])[same] > 1
