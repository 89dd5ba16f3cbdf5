"""Matches between two sets of keypoints, from words, descriptors, or subspaces that were released for them.

A match is a row (i, j): keypoint i of the first set, keypoint j of the second. Rows are sorted and distinct.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.device import pick_device
from bench.kernels import meetings
from bench.kernels.subspaces import feet_and_frames
from bench.types import Floats, Indices, Subspaces

CHUNK = 2048  # rows of a matrix of distances that are computed at a time


def mutual_nearest(distances: Floats, ratio: float = 1.0, farthest: float = np.inf) -> Indices:
    """Pairs that are each other's nearest, ties to the lowest index. (N, N') -> (M, 2)

    Parameters
    ----------
    ratio : the nearest must be nearer than this part of the second nearest, seen from either side (Lowe, IJCV 2004)
    farthest : matches at a greater distance are left out
    """
    if 0 in distances.shape:
        return np.empty((0, 2), dtype=np.int64)
    forth, back = distances.argmin(axis=1), distances.argmin(axis=0)  # (N,), (N',)
    first = np.flatnonzero(back[forth] == np.arange(len(forth)))
    second = forth[first]
    near = distances[first, second]
    kept = near <= farthest
    if ratio < 1:
        kept &= near < ratio * _second_least(distances)[first]
        kept &= near < ratio * _second_least(distances.T)[second]
    return np.stack([first, second], axis=1)[kept].astype(np.int64)


def _second_least(distances: Floats) -> Floats:
    """(N, N') -> (N,), infinite where there is no second"""
    if distances.shape[1] < 2:
        return np.full(len(distances), np.inf, dtype=np.float32)
    return np.partition(distances, 1, axis=1)[:, 1]


def sharing_words(first: Indices, second: Indices, unique: bool = False) -> Indices:
    """Pairs whose sets have a word in common. (N, m), (N', m') -> (M, 2)

    Parameters
    ----------
    first, second : rows of distinct words of one dictionary
    unique : whether only those words count that one keypoint alone has, in either set of keypoints
    """
    (words, owners), (others, theirs) = (_by_word(rows, unique) for rows in (first, second))
    left, right = np.searchsorted(words, others, "left"), np.searchsorted(words, others, "right")
    counts = right - left
    places = np.arange(counts.sum()) - np.repeat(counts.cumsum() - counts, counts) + np.repeat(left, counts)
    keys = np.unique(owners[places] * len(second) + np.repeat(theirs, counts))
    return np.stack(np.divmod(keys, max(1, len(second))), axis=1)


def _by_word(rows: Indices, unique: bool) -> tuple[Indices, Indices]:
    """All words in ascending order, and the row of each; or only those that occur once. (N, m) -> (P,), (P,)"""
    order = rows.ravel().argsort(kind="stable")
    words, owners = rows.ravel()[order], order // max(1, rows.shape[1])
    if not unique:
        return words, owners
    found, first, counts = np.unique(words, return_index=True, return_counts=True)
    return found[counts == 1], owners[first[counts == 1]]


def point_distances(points: Floats, others: Floats) -> Floats:
    """Euclidean distances of all pairs, to about 1e-3 where they vanish. (N, D), (N', D) -> (N, N')"""
    b = _tensor(others)
    return _chunked(points, lambda a: _squares(a, b) - 2 * a @ b.T)


def subspace_distances(points: Floats, release: Subspaces) -> Floats:
    """Distances from all points to all subspaces, to about 1e-3 where they vanish. (N, D) -> (N, N')

    dist² = |u|² + |p|² − 2 p·u − |B u|² for a point u and the subspace's point p nearest to zero and orthonormal basis B.
    """
    feet, frames = feet_and_frames(release)
    p, planes = _tensor(feet), _tensor(frames.transpose(1, 0, 2))  # (N', D), (dim, N', D)

    def squared(u: Tensor) -> Tensor:
        squares = _squares(u, p) - 2 * u @ p.T
        for plane in planes:  # one after the other, to hold one matrix at a time
            squares -= (u @ plane.T).square()
        return squares

    return _chunked(points, squared)


def distances_between(one: Subspaces, other: Subspaces) -> Floats:
    """Distances of all pairs of a subspace of `one` and one of `other`, to about 0.005 where they vanish. -> (N, N')

    Raises
    ------
    UserError
        if their dimensions add up to D or more, where all pairs meet.
    """
    found = np.empty((len(one), len(other)), dtype=np.float32)
    for rows, columns, squares in meetings.blocks(one, other, one.origins.shape[1]):
        found[rows, columns] = squares.clamp(min=0).sqrt().cpu()
    return found


def _chunked(points: Floats, squared: Callable[[Tensor], Tensor]) -> Floats:
    """Roots of what `squared` finds for some rows at a time. (N, D) -> (N, N')"""
    chunks = [points[start : start + CHUNK] for start in range(0, max(1, len(points)), CHUNK)]
    return np.concatenate([squared(_tensor(chunk)).clamp_(min=0).sqrt_().cpu().numpy() for chunk in chunks])


def _squares(a: Tensor, b: Tensor) -> Tensor:
    """|a|² + |b|² of all pairs. (n, D), (N', D) -> (n, N')"""
    return a.square().sum(dim=1)[:, None] + b.square().sum(dim=1)


def _tensor(rows: NDArray[np.floating]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(rows, dtype=np.float32)).to(pick_device())
