"""Mutually nearest neighbours, with Lowe's ratio test, of whatever has a distance."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bench.types import Indices


def mutual(squared: Tensor, ratio: float = 1.0) -> tuple[Indices, Indices]:
    """Rows and columns that are each other's nearest, ties to the lowest index.

    Parameters
    ----------
    squared : (N, R) squared distances
    ratio : the nearest column's distance is below this times the second nearest's (Lowe, IJCV 2004); 1 and more asks for nothing

    Returns
    -------
    (M,) rows, ascending, and their columns.
    """
    if 0 in squared.shape:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    back = squared.argmin(dim=0)  # (R,)
    count = min(2, squared.shape[1])
    nearest, columns = squared.topk(count, dim=1, largest=False)  # (N, 2)
    columns = squared.argmin(dim=1)
    kept = back[columns] == torch.arange(len(squared), device=squared.device)
    if ratio < 1 and count == 2:
        kept &= nearest[:, 0] < ratio**2 * nearest[:, 1]
    rows = kept.nonzero()[:, 0]
    return rows.cpu().numpy(), columns[rows].cpu().numpy()


def between_points(one: Tensor, other: Tensor) -> Tensor:
    """Squared distances of unit vectors. (N, D), (R, D) -> (N, R)"""
    return (2 - 2 * (one @ other.T)).clamp_(min=0)
