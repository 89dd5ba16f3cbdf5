"""Search for the word of greatest cosine in 8-bit integers, whose products are exact.

Processors with instructions for such products (VNNI) compute them about four times as fast as those in float32. The products have
signed factors, so 128 is subtracted from all components:

    q·w = (q − 128)·(w − 128) + 128 (Σ q + Σ w) − 128² D

Floor: 2·N·K·D operations at the machine's 8-bit matrix rate.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, TypeGuard, cast

import numpy as np
from numpy.typing import NDArray

from bench.core.device import has_byte_products, pick_device
from bench.types import Bytes, Floats, Indices, Words

if TYPE_CHECKING:
    from torch import Tensor

BLOCK = 1024  # words in a block, which fits into the cache with its products
OFFSET = 128
SLACK = 1e-6  # relative, for quotients of dot products and norms in float32


class ByteSearch:
    """An index of (K, D) words of unsigned 8-bit components, none of them zero.

    The words are sorted by their norms. Then the norms of a block are nearly equal, and its greatest dot product bounds its
    greatest cosine.
    """

    batch = 1024  # queries per pass over the words

    def __init__(self, words: Bytes) -> None:
        import torch

        norms = np.concatenate([_compute_norms(words[start : start + BLOCK]) for start in range(0, len(words), BLOCK)])
        self._order = np.argsort(norms, kind="stable")
        ordered = words[self._order]
        self._sums = torch.from_numpy((OFFSET * ordered.sum(axis=1, dtype=np.int64)).astype(np.int32))  # (K,)
        self._words = _shift(ordered, out=ordered)
        self._inverse = torch.from_numpy(1 / norms[self._order]).float()  # (K,), descending
        self._limits = torch.stack([block[[-1, 0]] for block in self._inverse.split(BLOCK)])  # (blocks, 2): least, greatest

    def find_candidates(self, rows: Words | Floats) -> tuple[Indices, Indices]:
        """Return the pairs of a query and a word that may be its nearest. (n, D) uint8 -> (P,), (P,)"""
        import torch

        queries = cast(Bytes, rows)
        shifted = _shift(queries)
        sums = torch.from_numpy(OFFSET * queries.sum(axis=1, dtype=np.int64) - OFFSET**2 * queries.shape[1])  # (n,)
        blocks = list(zip(self._words.split(BLOCK), self._sums.split(BLOCK), self._inverse.split(BLOCK), strict=True))
        greatest = torch.empty((len(blocks), len(queries)), dtype=torch.int32)
        for number, (words, offsets, _) in enumerate(blocks):
            torch.amax(_multiply(shifted, words, offsets), dim=1, out=greatest[number])
        dots = (greatest + sums).double()  # (blocks, n), exact and not negative
        low, high = self._limits.T[:, :, None]  # (blocks, 1) twice
        least = (dots * low).amax(dim=0) * (1 - SLACK)  # (n,)
        near_rows, found = [], []
        for number, ((words, offsets, inverse), near) in enumerate(zip(blocks, dots * high >= least, strict=True)):
            if near.any():
                queried = near.nonzero()[:, 0]
                products = _multiply(shifted[queried], words, offsets) + sums[queried, None]
                row, word = (products * inverse >= least[queried, None]).nonzero(as_tuple=True)
                near_rows.append(queried[row])
                found.append(word + number * BLOCK)
        return torch.cat(near_rows).numpy(), self._order[torch.cat(found).numpy()]


def _multiply(queries: Tensor, words: Tensor, offsets: Tensor) -> Tensor:
    """Return the products of integers, plus the words' own part of the correction. (n, D), (b, D), (b,) -> (n, b) int32"""
    import torch

    return torch._int_mm(queries, words.T).add_(offsets)


def _shift(rows: Bytes, out: Bytes | None = None) -> Tensor:
    """Return the components minus 128, in the memory of `out` if given. (n, D) uint8 -> (n, D) int8"""
    import torch

    return torch.from_numpy(np.bitwise_xor(rows, np.uint8(OFFSET), out=out).view(np.int8))


def _compute_norms(rows: Bytes) -> NDArray[np.float64]:
    """(n, D) -> (n,)"""
    return np.sqrt(np.square(rows, dtype=np.int64).sum(axis=1))


def suits(words: Words) -> TypeGuard[Bytes]:
    """Return whether words can be searched in integers: this machine multiplies such integers fast, and exactly."""
    return words.dtype == np.uint8 and pick_device().type == "cpu" and has_byte_products() and is_exact(words.shape[1])


@functools.cache
def is_exact(length: int) -> bool:
    """Return whether products of integers are exact for vectors of this length.

    Without VNNI the library adds pairs of products in 16 bits, which saturate. The processor's flags do not tell: the environment
    can keep the library from these instructions (`ONEDNN_MAX_CPU_ISA`).
    """
    import torch

    if not torch.backends.mkldnn.is_available():
        return False
    rng = np.random.default_rng(0)
    queries, words = (rng.integers(-128, 128, (rows, length), dtype=np.int8) for rows in (64, 256))
    queries[:2], words[:2] = [[127], [-128]], [[127], [-128]]  # the greatest products
    found = torch._int_mm(torch.from_numpy(queries), torch.from_numpy(words).T).numpy()
    return np.array_equal(found, queries.astype(np.int32) @ words.astype(np.int32).T)
