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
    from torch import Tensor

Doubles = NDArray[np.float64]

BLOCK = 2048  # words in a block
BATCH = 512  # words per query batch
CACHE_LIMIT = 2**26  # greatest size of a cached table of levels


class Neighbours:
    """An index for comparisons among (K, D) words, none of them zero."""

    def __init__(self, words: Words) -> None:
        import torch

        exact = torch.from_numpy(words.astype(np.float32))
        self._words = exact.to(pick_device())  # (K, D)
        self._lengths = exact.double().square().sum(dim=1).sqrt().to(pick_device())  # (K,)
        self._nearest: dict[int, Indices] = {}  # count -> (K, count), -1 where not computed yet
        self._levels: dict[bytes, NDArray[np.int32]] = {}  # borders -> (K, blocks, L + 1), -1 where not computed yet

    def find_nearest(self, words: Indices, count: int) -> Indices:
        """Return each word and its count − 1 nearest by cosine, ties to the lowest index. (n,) -> (n, count), ascending

        Results are cached.
        """
        table = self._nearest.setdefault(count, np.full((len(self._words), count), -1, dtype=np.int64))
        missing = np.unique(words[table[words, 0] < 0])
        for start in range(0, len(missing), BATCH):
            batch = missing[start : start + BATCH]
            table[batch] = self._find(batch, count)
        return table[words]

    def _find(self, words: Indices, count: int) -> Indices:
        import torch

        rows = torch.from_numpy(words)
        blocks = (self._compute_cosines_own_first(rows, at) for at in self._starts())
        tops = torch.cat([block.topk(min(count, block.shape[1]), dim=1).values for block in blocks], dim=1)
        least = tops.topk(count, dim=1).values[:, -1:]  # (n, 1)
        parts = [[part.cpu().numpy() for part in self._select_at_least(rows, least, at)] for at in self._starts()]
        owners, others, cosines = (np.concatenate(part) for part in zip(*parts, strict=True))
        order = np.lexsort((others, -cosines, owners))
        first = np.searchsorted(owners[order], np.arange(len(words)))
        return np.sort(others[order][first[:, None] + np.arange(count)], axis=1)

    def _select_at_least(self, rows: Tensor, least: Tensor, start: int) -> tuple[Tensor, Tensor, Tensor]:
        """Select pairs of a row and a word of the block with cosine at least `least`. -> (P,), (P,), (P,)"""
        cosines = self._compute_cosines_own_first(rows, start)
        owners, others = (cosines >= least).nonzero(as_tuple=True)
        return owners, others + start, cosines[owners, others]

    def _compute_cosines_own_first(self, rows: Tensor, start: int) -> Tensor:
        """Compute cosines with the words of a block, 2 for the word itself. -> (n, b)"""
        cosines = self._compute_cosines(rows, start)
        own = rows - start
        inside = (own >= 0) & (own < cosines.shape[1])
        cosines[inside.nonzero()[:, 0], own[inside]] = 2.0
        return cosines

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
            return self._find_levels(words, borders)
        table = self._levels.setdefault(borders.tobytes(), np.full(shape, -1, dtype=np.int32))
        missing = np.unique(words[table[words, 0, 0] < 0])
        table[missing] = self._find_levels(missing, borders)
        return table[words].astype(np.int64)

    def _find_levels(self, words: Indices, borders: Doubles) -> Indices:
        import torch

        found = np.empty((len(words), len(self._starts()), len(borders) + 1), dtype=np.int64)
        for start in range(0, len(words), BATCH):
            rows = torch.from_numpy(words[start : start + BATCH])
            for number, at in enumerate(self._starts()):
                found[start : start + BATCH, number] = _count_per_row(self._compute_levels(rows, at, borders), len(borders) + 1)
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
        found = np.empty(len(words), dtype=np.int64)
        for number in np.unique(blocks):
            rows = np.flatnonzero(blocks == number)
            start = int(number) * BLOCK
            same = self._compute_levels(torch.from_numpy(words[rows]), start, borders) == torch.from_numpy(levels[rows])[:, None]
            found[rows] = start + (same.cumsum(dim=1) > torch.from_numpy(rest[rows])[:, None]).int().argmax(dim=1).numpy()
        return found

    def _compute_levels(self, rows: Tensor, start: int, borders: Doubles) -> Tensor:
        """Compute the number of borders that each word of a block reaches. -> (n, b)"""
        import torch

        return torch.bucketize(
            self._compute_cosines(rows, start), torch.from_numpy(borders).to(self._words.device), right=True
        ).cpu()


def _count_per_row(levels: Tensor, count: int) -> Indices:
    """Count each level in each row. (n, b) -> (n, count)"""
    import torch

    offsets = torch.arange(len(levels))[:, None] * count
    return (levels + offsets).ravel().bincount(minlength=len(levels) * count).view(-1, count).numpy()
