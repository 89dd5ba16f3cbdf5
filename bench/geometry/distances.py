"""Squared distances of all pairs of points and affine subspaces, in float32, and mutual nearest neighbours.

The error is about 1e-6 for points of unit norm and subspaces, and about 2e-5 for two subspaces.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.core.device import pick_device
from bench.geometry.intersections import squared_distances
from bench.geometry.subspaces import feet_and_frames
from bench.types import Indices, Subspaces

if TYPE_CHECKING:
    from torch import Tensor

STEP = 128  # rows of a block of distances, so that blocks stay small


def points_to_points(one: Tensor, other: Tensor) -> Tensor:
    """Return the squared distances of unit vectors. (N, D), (R, D) -> (N, R)"""
    return (2 - 2 * (one @ other.T)).clamp_(min=0)


def subspaces_to_points(release: Subspaces, points: Tensor) -> Tensor:
    """Return the squared distances of subspaces and unit vectors u. (R, D) -> (N, R)

    dist² = 1 + |p|² − 2 p·u − |B u|², where p is the subspace's point nearest to zero.
    """
    import torch

    feet, frames = feet_and_frames(release)
    planes = torch.from_numpy(np.concatenate([feet[:, None], frames], axis=1).transpose(1, 0, 2).astype(np.float32, order="C"))
    foot, *axes = planes.to(points.device)  # (N, D) each
    squared = (foot.square().sum(dim=1) + 1)[:, None] - 2 * (foot @ points.T)
    for axis in axes:
        squared -= (axis @ points.T).square_()
    return squared.clamp_(min=0)


def subspaces_to_subspaces(one: Subspaces, other: Subspaces) -> Tensor:
    """Return the squared distances of subspaces. -> (N, N')"""
    import torch

    squared = torch.empty(len(one), len(other), device=pick_device())
    for top, left, block in squared_distances(one, other, directions=one.origins.shape[1]):
        squared[top : top + block.shape[0], left : left + block.shape[1]] = block
    return squared.clamp_(min=0)


def find_mutual_nearest(squared: Tensor, ratio: float = 1.0) -> tuple[Indices, Indices]:
    """Return the pairs of a row and a column that are each other's nearest, ties to the lowest index.

    Parameters
    ----------
    squared : (N, R) squared distances
    ratio : a row's nearest must be closer than this times its second nearest (Lowe, IJCV 2004); 1 disables the test

    Returns
    -------
    (M,) rows, ascending, and their columns.
    """
    import torch

    if squared.numel() == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    columns = squared.argmin(dim=1)  # (N,)
    mutual = squared.argmin(dim=0)[columns] == torch.arange(len(squared), device=squared.device)
    if ratio < 1 and squared.shape[1] > 1:
        nearest, second = squared.topk(2, dim=1, largest=False).values.T
        mutual &= nearest < ratio**2 * second
    rows = mutual.nonzero()[:, 0]
    return rows.cpu().numpy(), columns[rows].cpu().numpy()


def find_mutual_nearest_points(one: Tensor, other: Tensor, ratio: float = 1.0, step: int = STEP) -> tuple[Indices, Indices]:
    """Return `find_mutual_nearest` of the squared distances of unit vectors, which are never all in memory.

    Parameters
    ----------
    one, other : (N, D), (R, D)
    step : number of rows of `one` at a time
    """
    import torch

    if len(one) == 0 or len(other) == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    least = torch.full((len(other),), torch.inf, device=one.device)  # of each column
    nearest_rows = torch.zeros(len(other), dtype=torch.int64, device=one.device)
    columns, passed = [], []
    for start in range(0, len(one), step):
        squared = points_to_points(one[start : start + step], other)
        values, rows = squared.min(dim=0)
        closer = values < least  # ties to the lowest row
        least[closer], nearest_rows[closer] = values[closer], rows[closer] + start
        nearest = squared.argmin(dim=1, keepdim=True)
        columns.append(nearest[:, 0])
        if ratio < 1 and len(other) > 1:
            distance = squared.gather(1, nearest)[:, 0]
            second = squared.scatter_(1, nearest, torch.inf).amin(dim=1)
            passed.append(distance < ratio**2 * second)
    column = torch.cat(columns)  # (N,)
    mutual = nearest_rows[column] == torch.arange(len(one), device=one.device)
    if passed:
        mutual &= torch.cat(passed)
    rows = mutual.nonzero()[:, 0]
    return rows.cpu().numpy(), column[rows].cpu().numpy()
