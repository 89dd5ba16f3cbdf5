"""Exact search for the word of greatest cosine: a bf16 pass finds the candidates, float64 decides among them.

Floor: 2·N·K·D operations at the machine's bf16 matrix rate; the words are read once for each batch of queries.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from bench.core.device import pick_device, pick_dtype
from bench.types import Bytes, Floats, Indices

if TYPE_CHECKING:
    import torch
    from torch import Tensor

BLOCK = 2048  # words in a block: a block and its scores stay in the cache
BATCH = 512  # queries per pass over the words

SLACK = 1e-4  # for sums in float32 and for products of errors


def unit_rows(rows: Bytes | Floats) -> Floats:
    """Scale each row to unit norm in float64 and return float32; a row of zeros stays zero. (..., D) -> (..., D)"""
    exact = rows.astype(np.float64)
    norms = np.linalg.norm(exact, axis=-1, keepdims=True)
    return (exact / np.where(norms > 0, norms, 1.0)).astype(np.float32)


class WordIndex:
    """A search index of (K, D) uint8 words, none zero."""

    def __init__(self, words: Bytes) -> None:
        import torch

        device = pick_device()
        self._dtype = pick_dtype(device)
        self._words = words
        exact = torch.from_numpy(unit_rows(words))
        self._coarse = exact.to(device, self._dtype)  # (K, D)
        self._error = float(rounding(exact, self._coarse).max())

    def find_nearest(self, queries: Bytes | Floats, progress: Callable[[int], object] = lambda done: None) -> Indices:
        """Return for each query the index of the word of greatest cosine, ties to the lowest index.

        Parameters
        ----------
        queries : (N, D) uint8 or float32, of any norm
        progress : called with the number of queries just done

        Returns
        -------
        (N,) int64. Cosines are compared as dot² / |word|² in float64; uint8 rows have exact dot products in it.
        """
        import torch

        found = np.empty(len(queries), dtype=np.int64)
        for start in range(0, len(queries), BATCH):
            batch = queries[start : start + BATCH]
            exact = torch.from_numpy(unit_rows(batch))
            coarse = exact.to(self._coarse.device, self._dtype)
            found[start : start + BATCH] = self._decide(
                batch, *self._find_candidates(coarse, rounding(exact, coarse) + self._error)
            )
            progress(len(batch))
        return found

    def _find_candidates(self, queries: Tensor, errors: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Find the pairs of a query and a word that may be its nearest. (n, D), (n,) rounding errors -> (P,), (P,)"""
        import torch

        blocks = self._coarse.split(BLOCK)
        tops = torch.stack([block_maxima(queries, block) for block in blocks], dim=1).float()  # (n, blocks)
        best = tops.amax(dim=1)
        least = best - margin(best, errors, self._dtype)  # (n,)
        rows, words = [], []
        for number, block in enumerate(blocks):
            near = (tops[:, number] >= least).nonzero()[:, 0]
            if len(near):
                row, word = (queries[near] @ block.T >= least[near, None]).nonzero(as_tuple=True)
                rows.append(near[row])
                words.append(word + number * BLOCK)
        return torch.cat(rows).cpu().numpy(), torch.cat(words).cpu().numpy()

    def _decide(self, queries: Bytes | Floats, rows: np.ndarray, words: np.ndarray) -> np.ndarray:
        """Select among the candidates of each query the word of greatest cosine. (n, D), (P,), (P,) -> (n,)"""
        exact = self._words[words].astype(np.float64)  # (P, D)
        dots = np.einsum("pd,pd->p", queries[rows].astype(np.float64), exact)
        # Words of one direction must compare equal: the squares of integers divide to one and the same double.
        scores = dots * np.abs(dots) / np.einsum("pd,pd->p", exact, exact)
        order = np.lexsort((words, -scores, rows))
        first = np.unique(rows[order], return_index=True)[1]
        return words[order][first]


def rounding(exact: Tensor, coarse: Tensor) -> Tensor:
    """Rounding error of each row. (n, D), (n, D) -> (n,) on the device of the second"""
    return (coarse.float() - exact.to(coarse.device)).norm(dim=1)


def margin(best: Tensor, errors: Tensor, dtype: torch.dtype) -> Tensor:
    """Greatest deficit of the nearest word's approximate cosine below the greatest one. (n,), (n,) -> (n,)

    By Cauchy-Schwarz a cosine is off by at most the sum of the distances that its unit rows were moved, and then by half a unit
    in the last place as it is rounded itself: a quarter of the type's `eps` below one, half of it above. Two are compared.
    """
    import torch

    eps = torch.finfo(dtype).eps
    return 2 * (errors + torch.where(best < 1, eps / 4, eps / 2) + SLACK)


def block_maxima(queries: Tensor, block: Tensor) -> Tensor:
    """Greatest approximate cosine of each query in one block of words. (n, D), (b, D) -> (n,)"""
    return (queries @ block.T).amax(dim=1)
