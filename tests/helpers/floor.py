"""The floor of a search's time: the matrix product alone."""

from collections.abc import Callable

import numpy as np
import torch

from bench.geometry import byte_search
from bench.geometry.nearest_words import BLOCK, unit_rows


def build_byte_product(rows: int, words: np.ndarray) -> Callable[[], None]:
    """Build a function that multiplies (rows, D) by (K, D) integers of 8 bits, in blocks that stay in the cache."""
    generator = np.random.default_rng(0)
    factor = torch.from_numpy(generator.integers(-128, 128, (rows, words.shape[1]), dtype=np.int8))
    blocks = torch.from_numpy(words.view(np.int8)).split(byte_search.BLOCK)
    out = torch.empty(rows * byte_search.BLOCK, dtype=torch.int32)

    def multiply() -> None:
        for block in blocks:
            torch._int_mm(factor, block.T, out=out[: rows * len(block)].view(rows, len(block)))

    return multiply


def build_bare_product(rows: int, words: np.ndarray, dtype: torch.dtype) -> Callable[[], None]:
    """Build a function that multiplies (rows, D) numbers by (K, D) words in blocks that stay in the cache."""
    factor = torch.randn(rows, words.shape[1]).to(dtype)
    blocks = torch.from_numpy(unit_rows(words)).to(dtype).split(BLOCK)
    out = factor.new_empty(rows, BLOCK)

    def multiply() -> None:
        for block in blocks:
            torch.mm(factor, block.T, out=out[:, : len(block)])

    return multiply
