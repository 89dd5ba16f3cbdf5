"""Exact search for the word of greatest cosine: a fast pass finds the candidates, float64 decides among them.

The pass is in 8-bit integers, where queries and words are such and the processor multiplies them fast (`byte_search`). Otherwise
it is in bf16 or float32.

Floor: 2·N·K·D operations at the machine's matrix rate of that number format. The words are read once per batch of queries.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from bench.core.device import pick_device, pick_dtype
from bench.geometry import byte_search
from bench.geometry.byte_search import ByteSearch
from bench.types import Floats, Indices, Words

if TYPE_CHECKING:
    import torch
    from torch import Tensor

BLOCK = 2048  # words in a block, which fits into the cache with its scores
BATCH = 512  # queries per pass over the words
WIDE_BLOCK, WIDE_BATCH = 256, 1024  # in float32, whose products are so slow that reading all words again counts

SLACK = 1e-4  # for sums in float32 and for products of errors


def unit_rows(rows: Words | Floats) -> Floats:
    """Return each row scaled to unit norm in float64, as float32. A row of zeros stays zero. (..., D) -> (..., D)"""
    exact = rows.astype(np.float64)
    norms = np.linalg.norm(exact, axis=-1, keepdims=True)
    return (exact / np.where(norms > 0, norms, 1.0)).astype(np.float32)


class WordIndex:
    """A search index of (K, D) words, none of them zero."""

    def __init__(self, words: Words) -> None:
        self._words = words
        self._bytes = ByteSearch(words) if byte_search.suits(words) else None

    @cached_property
    def _floats(self) -> FloatSearch:
        return FloatSearch(self._words)

    def find_nearest(self, queries: Words | Floats, progress: Callable[[int], object] = lambda done: None) -> Indices:
        """Return for each query the index of the word of greatest cosine, ties to the lowest index.

        Parameters
        ----------
        queries : (N, D) words or float32, of any norm
        progress : called with the number of queries of each finished batch

        Returns
        -------
        (N,) int64. Cosines are compared as dot² / |word|² in float64, in which dot products of words are exact.
        """
        search = self._bytes if self._bytes is not None and queries.dtype == np.uint8 else self._floats
        found = np.zeros(len(queries), dtype=np.int64)
        directed = np.flatnonzero(queries.any(axis=1))  # for a row of zeros all words tie, and the first is found
        for start in range(0, len(directed), search.batch):
            rows = directed[start : start + search.batch]
            found[rows] = self._decide(queries[rows], *search.find_candidates(queries[rows]))
            progress(len(rows))
        return found

    def _decide(self, queries: Words | Floats, rows: np.ndarray, words: np.ndarray) -> np.ndarray:
        """Return the candidate of greatest cosine of each query. (n, D), (P,), (P,) -> (n,)"""
        exact = self._words[words].astype(np.float64)  # (P, D)
        dots = np.einsum("pd,pd->p", queries[rows].astype(np.float64), exact)
        # Words of one direction must compare equal: quotients of squares of integers give the same double.
        scores = dots * np.abs(dots) / np.einsum("pd,pd->p", exact, exact)
        order = np.lexsort((words, -scores, rows))
        first = np.unique(rows[order], return_index=True)[1]
        return words[order][first]


class FloatSearch:
    """An index in the number format of fast products: bf16 or float32."""

    def __init__(self, words: Words) -> None:
        import torch

        device = pick_device()
        self._dtype = pick_dtype(device)
        self._block, self.batch = (WIDE_BLOCK, WIDE_BATCH) if self._dtype == torch.float32 else (BLOCK, BATCH)
        self._coarse = torch.empty(words.shape, dtype=self._dtype, device=device)  # (K, D)
        self._error = 0.0
        for start in range(0, len(words), BLOCK):  # in float64, all words would take sixteen times their memory
            exact = torch.from_numpy(unit_rows(words[start : start + BLOCK]))
            coarse = self._coarse[start : start + BLOCK]
            coarse.copy_(exact)
            self._error = max(self._error, float(rounding(exact, coarse).max()))

    def find_candidates(self, rows: Words | Floats) -> tuple[Indices, Indices]:
        """Return the pairs of a query and a word that may be its nearest. (n, D) -> (P,), (P,)"""
        import torch

        exact = torch.from_numpy(unit_rows(rows))
        queries = exact.to(self._coarse.device, self._dtype)
        errors = rounding(exact, queries) + self._error  # (n,)
        blocks = self._coarse.split(self._block)
        tops = torch.empty((len(blocks), len(queries)), device=queries.device)
        for number, block in enumerate(blocks):  # a list of small tensors between the large ones would fragment the memory
            tops[number] = block_maxima(queries, block)
        best = tops.amax(dim=0)
        least = best - margin(best, errors, self._dtype)  # (n,)
        found, words = [], []
        for number, block in enumerate(blocks):
            near = (tops[number] >= least).nonzero()[:, 0]
            if len(near):
                row, word = (queries[near] @ block.T >= least[near, None]).nonzero(as_tuple=True)
                found.append(near[row])
                words.append(word + number * self._block)
        return torch.cat(found).cpu().numpy(), torch.cat(words).cpu().numpy()


def rounding(exact: Tensor, coarse: Tensor) -> Tensor:
    """Return the rounding error of each row. (n, D), (n, D) -> (n,) on the device of the second"""
    return (coarse.float() - exact.to(coarse.device)).norm(dim=1)


def margin(best: Tensor, errors: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the largest difference between the greatest approximate cosine and that of the nearest word. (n,), (n,) -> (n,)

    By Cauchy-Schwarz, rounding the two unit rows changes their cosine by at most the sum of the rows' rounding errors. Rounding
    the cosine adds half a unit in the last place: a quarter of the type's `eps` below one, half of it above. The result counts
    both errors twice, since two cosines are compared.
    """
    import torch

    eps = torch.finfo(dtype).eps
    return 2 * (errors + torch.where(best < 1, eps / 4, eps / 2) + SLACK)


def block_maxima(queries: Tensor, block: Tensor) -> Tensor:
    """Return the greatest approximate cosine of each query in one block of words. (n, D), (b, D) -> (n,)"""
    return (queries @ block.T).amax(dim=1)
