"""Neighbours of words in the same dictionary: the nearest words, and the number of words at each level of similarity.

Words are integers of norm below 2^12, so their dot products are integers below 2^24, which are exact in float32 in any order of
summation. The result for two words depends on these two alone. It does not depend on the other words of a query, the number of
threads or the machine.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bench.core.device import pick_device
from bench.types import Indices, Words

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Doubles = NDArray[np.float64]

BLOCK = 8192  # words in a block, so that 16-bit integers hold their counts
BATCH = 128  # words per query batch
CACHE_LIMIT = 2**29  # greatest size of a cached table of levels
MIN_WIDTH = 8  # nearest words that are found at least
GROUP = 64  # words of which only the greatest score is compared
SLACK = 2.0**-20  # above the relative error of a score in float32, which is below 2^-22
INTERVALS = 1024  # intervals of cosines from 0 to 1, in which levels are looked up


class Neighbours:
    """An index for comparisons among (K, D) words, none of them zero."""

    def __init__(self, words: Words) -> None:
        import torch

        exact = torch.from_numpy(words.astype(np.float32))
        self._words = exact.to(pick_device())  # (K, D)
        self._lengths = exact.double().square().sum(dim=1).sqrt().to(pick_device())  # (K,)
        self._nearest: dict[int, Indices] = {}  # width -> (K, width), nearest first, -1 where not computed yet
        # borders -> (K, blocks, L + 1) and whether it is computed (K,). Only rows that are computed take memory.
        self._levels: dict[bytes, tuple[NDArray[np.int16], NDArray[np.bool_]]] = {}

    def find_nearest(self, words: Indices, count: int) -> Indices:
        """Return each word and its count − 1 nearest by cosine, ties to the lowest index. (n,) -> (n, count), ascending

        Results are cached, and small counts share a table.
        """
        width = min(max(count, MIN_WIDTH), len(self._words))
        if width not in self._nearest:
            self._nearest[width] = np.full((len(self._words), width), -1, dtype=np.int64)
        table = self._nearest[width]
        missing = np.unique(words[table[words, 0] < 0])
        for start in range(0, len(missing), BATCH):
            batch = missing[start : start + BATCH]
            table[batch] = self._find(batch, width)
        return np.sort(table[words, :count], axis=1)

    def _find(self, words: Indices, count: int) -> Indices:
        """Return the nearest words of each word, nearest first. (n,) -> (n, count)

        Float32 scores exclude all words but a few, and cosines in float64 order these.
        """
        import torch

        rows = torch.from_numpy(words).to(self._words.device)
        products = self._words[rows] @ self._words.T  # (n, K)
        scores = products / self._lengths.float()
        scores[torch.arange(len(rows)), rows] = torch.finfo(scores.dtype).max  # of the word itself
        least = _find_lower_bound(scores, count)  # (n, 1)
        owners, others = (scores >= least - SLACK * least.abs()).nonzero(as_tuple=True)
        own = rows[owners]
        cosines = products[owners, others].double() / (self._lengths[own] * self._lengths[others])
        cosines[own == others] = 2.0
        row, word, cosine = (part.cpu().numpy() for part in (owners, others, cosines))
        order = np.lexsort((word, -cosine, row))
        first = np.searchsorted(row[order], np.arange(len(words)))
        return word[order][first[:, None] + np.arange(count)]

    def _compute_cosines(self, rows: Tensor, start: int) -> Tensor:
        """Compute cosines of `rows` with the words of a block, in float64. -> (n, b)"""
        block = slice(start, start + BLOCK)
        dots = (self._words[rows] @ self._words[block].T).double()
        return dots / (self._lengths[rows, None] * self._lengths[block])

    def _starts(self) -> range:
        return range(0, len(self._words), BLOCK)

    def count_levels(self, words: Indices, borders: Doubles) -> Indices:
        """Return the number of words at each level: the number of borders that their cosine reaches. Small tables are cached.

        Parameters
        ----------
        words : (n,)
        borders : (L,) ascending

        Returns
        -------
        (n, blocks, L + 1) counts in each block of words
        """
        shape = (len(self._words), len(self._starts()), len(borders) + 1)
        if np.prod(shape) > CACHE_LIMIT:
            return self._find_levels(words, borders).astype(np.int64)
        if borders.tobytes() not in self._levels:
            self._levels[borders.tobytes()] = np.zeros(shape, np.int16), np.zeros(len(self._words), bool)
        table, known = self._levels[borders.tobytes()]
        missing = np.unique(words[~known[words]])
        table[missing] = self._find_levels(missing, borders)
        known[missing] = True
        return table[words].astype(np.int64)

    def _find_levels(self, words: Indices, borders: Doubles) -> NDArray[np.int16]:
        import torch

        found = np.empty((len(words), len(self._starts()), len(borders) + 1), dtype=np.int16)
        levels = _Levels(borders, self._words.device)
        for start in range(0, len(words), BATCH):
            rows = torch.from_numpy(words[start : start + BATCH])
            for number, at in enumerate(self._starts()):
                counts = levels.find(self._compute_cosines(rows, at)).cpu()
                found[start : start + BATCH, number] = _count_per_row(counts, len(borders) + 1)
        return found

    def select_words(self, words: Indices, borders: Doubles, counts: Indices, levels: Indices, ranks: Indices) -> Indices:
        """Return for each word the word at a given rank among the words of a level, which are ordered by index.

        Parameters
        ----------
        words, borders : the arguments of `count_levels`
        counts : (n, blocks, L + 1) the result of `count_levels`
        levels : (n,)
        ranks : (n,) from 0 to below the number of words at the level

        Returns
        -------
        (n,) words
        """
        import torch

        before = np.take_along_axis(counts, levels[:, None, None], axis=2)[..., 0].cumsum(axis=1)  # (n, blocks)
        blocks = (before <= ranks[:, None]).sum(axis=1)
        rest = ranks - np.where(blocks > 0, np.take_along_axis(before, np.maximum(blocks - 1, 0)[:, None], axis=1)[:, 0], 0)
        found, level_of = np.empty(len(words), dtype=np.int64), _Levels(borders, self._words.device)
        for number in np.unique(blocks):
            rows = np.flatnonzero(blocks == number)
            start = int(number) * BLOCK
            computed = level_of.find(self._compute_cosines(torch.from_numpy(words[rows]), start)).cpu()
            same = computed == torch.from_numpy(levels[rows])[:, None]
            found[rows] = start + (same.cumsum(dim=1) > torch.from_numpy(rest[rows])[:, None]).int().argmax(dim=1).numpy()
        return found


class _Levels:
    """The number of borders that a cosine reaches, by table for each interval of cosines without a border.

    `torch.bucketize` of all cosines takes three times as long.
    """

    def __init__(self, borders: Doubles, device: torch.device) -> None:
        import torch

        self._borders = torch.from_numpy(borders).to(device)
        # The ends of intervals are exact, and so is a cosine times INTERVALS. The last interval starts at 1.
        ends = torch.arange(-INTERVALS, INTERVALS + 2, dtype=torch.float64, device=device) / INTERVALS
        reached = torch.bucketize(ends[:-1], self._borders, right=True)
        within = torch.bucketize(ends[1:], self._borders)  # borders below the end
        self._table = torch.where(reached == within, reached, -1)

    def find(self, cosines: Tensor) -> Tensor:
        """Return the levels of cosines from -1 to slightly more than 1. (n, b) -> (n, b)"""
        import torch

        intervals = (cosines * INTERVALS).floor_().clamp_(-INTERVALS, INTERVALS).to(torch.int32).add_(INTERVALS)
        levels = self._table.index_select(0, intervals.ravel()).view(cosines.shape)
        mixed = (levels < 0).nonzero(as_tuple=True)
        levels[mixed] = torch.bucketize(cosines[mixed], self._borders, right=True)
        return levels


def _find_lower_bound(scores: Tensor, count: int) -> Tensor:
    """Return a lower bound of the count-th greatest score of each row: of the greatest of each group. (n, K) -> (n, 1)"""
    group = max(1, min(GROUP, scores.shape[1] // count))
    whole = scores.shape[1] // group * group
    return scores[:, :whole].unflatten(1, (-1, group)).amax(dim=2).topk(count, dim=1).values[:, -1:]


def _count_per_row(levels: Tensor, count: int) -> Indices:
    """Count each level in each row. (n, b) -> (n, count)"""
    import torch

    offsets = torch.arange(len(levels))[:, None] * count
    return (levels + offsets).ravel().bincount(minlength=len(levels) * count).view(-1, count).numpy()
