"""Words near a word of the same dictionary: the nearest so many, and how many there are at each level of likeness.

Words are 8-bit, so that their dot products are whole numbers below 2^24 and exact in float32, however they are summed. What is
made of them is a function of two words alone: not of the other words that are asked for, the number of threads or the machine.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.core.device import pick_device
from bench.types import Bytes, Indices

Doubles = NDArray[np.float64]

BLOCK = 2048  # words in a block
BATCH = 512  # words that are asked for at a time
REMEMBERED = 2**26  # numbers of levels, at most


class Neighbours:
    """(K, D) uint8 words, none zero, made ready to be compared with each other."""

    def __init__(self, words: Bytes) -> None:
        exact = torch.from_numpy(words.astype(np.float32))
        self._words = exact.to(pick_device())  # (K, D)
        self._lengths = exact.double().square().sum(dim=1).sqrt().to(pick_device())  # (K,)
        self._nearest: dict[int, Indices] = {}  # how many -> (K, count), -1 where they were never asked for
        self._levels: dict[bytes, NDArray[np.int32]] = {}  # borders -> (K, blocks, L + 1), the same

    def nearest(self, words: Indices, count: int) -> Indices:
        """Each word itself, and the count − 1 others of greatest cosine, ties to the lowest index. (n,) -> (n, count), ascending

        What was found once is remembered.
        """
        table = self._nearest.setdefault(count, np.full((len(self._words), count), -1, dtype=np.int64))
        missing = np.unique(words[table[words, 0] < 0])
        for start in range(0, len(missing), BATCH):
            batch = missing[start : start + BATCH]
            table[batch] = self._find(batch, count)
        return table[words]

    def _find(self, words: Indices, count: int) -> Indices:
        rows = torch.from_numpy(words)
        blocks = (self._own_first(rows, at) for at in self._starts())
        tops = torch.cat([block.topk(min(count, block.shape[1]), dim=1).values for block in blocks], dim=1)
        least = tops.topk(count, dim=1).values[:, -1:]  # (n, 1)
        found = [[part.cpu().numpy() for part in self._at_least(rows, least, at)] for at in self._starts()]
        owners, others, cosines = (np.concatenate(parts) for parts in zip(*found, strict=True))
        order = np.lexsort((others, -cosines, owners))
        first = np.searchsorted(owners[order], np.arange(len(words)))
        return np.sort(others[order][first[:, None] + np.arange(count)], axis=1)

    def _at_least(self, rows: Tensor, least: Tensor, start: int) -> tuple[Tensor, Tensor, Tensor]:
        """Pairs of one of `rows` and a word of the block whose cosine is no less than that. -> (P,), (P,), (P,)"""
        cosines = self._own_first(rows, start)
        owners, others = (cosines >= least).nonzero(as_tuple=True)
        return owners, others + start, cosines[owners, others]

    def _own_first(self, rows: Tensor, start: int) -> Tensor:
        """Cosines with the words of a block, a word's own being 2. -> (n, b)"""
        cosines = self._cosines(rows, start)
        own = rows - start
        here = (own >= 0) & (own < cosines.shape[1])
        cosines[here.nonzero()[:, 0], own[here]] = 2.0
        return cosines

    def _cosines(self, rows: Tensor, start: int) -> Tensor:
        """Of some words with those of a block, in float64. -> (n, b)"""
        block = slice(start, start + BLOCK)
        dots = (self._words[rows] @ self._words[block].T).double()
        return dots / (self._lengths[rows, None] * self._lengths[block])

    def _starts(self) -> range:
        return range(0, len(self._words), BLOCK)

    def levels(self, words: Indices, borders: Doubles) -> Indices:
        """How many words have a cosine with each that is at least so many of the borders. Few enough of them are remembered.

        Parameters
        ----------
        words : (n,)
        borders : (L,) ascending

        Returns
        -------
        (n, blocks, L + 1) for each block of words
        """
        shape = (len(self._words), len(self._starts()), len(borders) + 1)
        if np.prod(shape) > REMEMBERED:
            return self._find_levels(words, borders)
        table = self._levels.setdefault(borders.tobytes(), np.full(shape, -1, dtype=np.int32))
        missing = np.unique(words[table[words, 0, 0] < 0])
        table[missing] = self._find_levels(missing, borders)
        return table[words].astype(np.int64)

    def _find_levels(self, words: Indices, borders: Doubles) -> Indices:
        found = np.empty((len(words), len(self._starts()), len(borders) + 1), dtype=np.int64)
        for start in range(0, len(words), BATCH):
            rows = torch.from_numpy(words[start : start + BATCH])
            for number, at in enumerate(self._starts()):
                found[start : start + BATCH, number] = _counted(self._leveled(rows, at, borders), len(borders) + 1)
        return found

    def at(self, words: Indices, borders: Doubles, counted: Indices, levels: Indices, places: Indices) -> Indices:
        """For each word that one which stands at some place, by index, among those of a level.

        Parameters
        ----------
        words, borders : as they were given to `levels`
        counted : (n, blocks, L + 1) what `levels` returned
        levels : (n,) which level is asked for
        places : (n,) from 0 to below how many there are

        Returns
        -------
        (n,) words
        """
        before = np.take_along_axis(counted, levels[:, None, None], axis=2)[..., 0].cumsum(axis=1)  # (n, blocks)
        blocks = (before <= places[:, None]).sum(axis=1)
        rest = places - np.where(blocks > 0, np.take_along_axis(before, np.maximum(blocks - 1, 0)[:, None], axis=1)[:, 0], 0)
        found = np.empty(len(words), dtype=np.int64)
        for number in np.unique(blocks):
            here = np.flatnonzero(blocks == number)
            at = int(number) * BLOCK
            same = self._leveled(torch.from_numpy(words[here]), at, borders) == torch.from_numpy(levels[here])[:, None]
            found[here] = at + (same.cumsum(dim=1) > torch.from_numpy(rest[here])[:, None]).int().argmax(dim=1).numpy()
        return found

    def _leveled(self, rows: Tensor, start: int, borders: Doubles) -> Tensor:
        """How many borders each word of a block reaches. -> (n, b)"""
        return torch.bucketize(self._cosines(rows, start), torch.from_numpy(borders).to(self._words.device), right=True).cpu()


def _counted(levels: Tensor, count: int) -> Indices:
    """How often each level stands in each row. (n, b) -> (n, count)"""
    offsets = torch.arange(len(levels))[:, None] * count
    return (levels + offsets).ravel().bincount(minlength=len(levels) * count).view(-1, count).numpy()
