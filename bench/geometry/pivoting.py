"""Selection of well-conditioned rows by Gram-Schmidt with pivoting, for a batch of matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def select_independent_rows(matrices: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return k rows of each (D, k) matrix, each the row farthest from the span of the previous ones. (N, D, k) -> (N, k)"""
    count, _, k = matrices.shape
    rest = matrices.copy()
    selection = np.empty((count, k), dtype=np.int64)
    for i in range(k):
        selection[:, i] = np.square(rest).sum(axis=2).argmax(axis=1)
        pivot = np.take_along_axis(rest, selection[:, i, None, None], axis=1)  # (N, 1, k)
        pivot /= np.linalg.norm(pivot, axis=2, keepdims=True)
        rest -= (rest @ pivot.transpose(0, 2, 1)) * pivot
    return selection
