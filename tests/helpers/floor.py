"""The floor of a search's time: the matrix product alone."""

from collections.abc import Callable

import numpy as np
import torch

from bench.geometry.nearest_words import BLOCK, unit_rows


def build_bare_product(rows: int, words: np.ndarray, dtype: torch.dtype) -> Callable[[], None]:
    """Build a function that multiplies (rows, D) numbers by (K, D) words in blocks that stay in the cache."""
    factor = torch.randn(rows, words.shape[1]).to(dtype)
    blocks = torch.from_numpy(unit_rows(words)).to(dtype).split(BLOCK)
    out = factor.new_empty(rows, BLOCK)

    def multiply() -> None:
        for block in blocks:
            torch.mm(factor, block.T, out=out[:, : len(block)])

    return multiply
