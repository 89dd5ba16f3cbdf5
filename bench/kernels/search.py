"""Exact search for the word of greatest cosine: a bf16 pass over blocks finds where it can be, float64 decides.

Floor: 2·N·K·D operations at the machine's bf16 matrix rate; the words are read once for each batch of queries.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from bench.device import pick_device
from bench.types import Bytes, Floats, Indices

BLOCK = 2048  # words in a block: a block and its scores stay in the cache
BATCH = 512  # queries that share one reading of the words

# Cosines of unit vectors err by at most 2^-9 from rounding each factor and 2^-9 from rounding the result to bf16
# (2^-9 relative each, Cauchy-Schwarz over the sum), so two scores whose order a bf16 pass got wrong differ by less than this.
_MARGIN = 2 * 3 * 2.0**-9 + 1e-4


def unit_rows(rows: Bytes | Floats) -> Floats:
    """Scale each row to unit norm in float64 and return float32; a row of zeros stays zero. (N, D) -> (N, D)"""
    exact = rows.astype(np.float64)
    norms = np.linalg.norm(exact, axis=-1, keepdims=True)
    return (exact / np.where(norms > 0, norms, 1.0)).astype(np.float32)


def nearest_rows(queries: Bytes | Floats, words: Bytes, *, progress: Callable[[int], object] | None = None) -> Indices:
    """Return for each query the index of the word of greatest cosine, ties to the lowest index.

    Parameters
    ----------
    queries : (N, D) uint8 or float32, of any norm
    words : (K, D) uint8, no row zero
    progress : called with the number of queries just done

    Returns
    -------
    (N,) int64. Scores are compared in float64; dot products of uint8 rows are exact in it.
    """
    device = pick_device()
    # (K, D) unit words in bf16 for the pass that only narrows down
    coarse = torch.from_numpy(unit_rows(words)).to(device, torch.bfloat16)
    exact = torch.from_numpy(words)
    norms = torch.linalg.vector_norm(exact.double(), dim=1)
    found = np.empty(len(queries), dtype=np.int64)
    for start in range(0, len(queries), BATCH):
        batch = queries[start : start + BATCH]
        tops = _block_maxima(torch.from_numpy(unit_rows(batch)).to(device, torch.bfloat16), coarse)
        found[start : start + BATCH] = _decide(torch.from_numpy(batch).double(), exact, norms, tops.cpu())
        if progress is not None:
            progress(len(batch))
    return found


def _block_maxima(queries: Tensor, words: Tensor) -> Tensor:
    """Greatest approximate cosine of each query in each block of words. (N, D), (K, D) -> (N, blocks)"""
    return torch.stack([(queries @ block.T).amax(dim=1) for block in words.split(BLOCK)], dim=1).float()


def _decide(queries: Tensor, words: Tensor, norms: Tensor, tops: Tensor) -> np.ndarray:
    """Compare in float64, within the blocks that can hold the greatest cosine."""
    possible = tops >= tops.amax(dim=1, keepdim=True) - _MARGIN  # (N, blocks)
    best = torch.full((len(queries),), -torch.inf, dtype=torch.float64)
    index = torch.zeros(len(queries), dtype=torch.int64)
    for block in range(tops.shape[1]):
        rows = possible[:, block].nonzero()[:, 0]
        if len(rows) == 0:
            continue
        start = block * BLOCK
        scores = queries[rows] @ words[start : start + BLOCK].double().T / norms[start : start + BLOCK]
        value, place = scores.max(dim=1)  # ties to the lowest index, as the blocks ascend
        better = value > best[rows]
        best[rows] = torch.where(better, value, best[rows])
        index[rows] = torch.where(better, place + start, index[rows])
    return index.numpy()
