"""Hash keys of rows, for the search of equal rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.types import Bytes, Floats


def hash_rows(rows: Bytes | Floats) -> NDArray[np.uint64]:
    """Return a 64-bit key of each row. Among 10 million different rows, two have one key with chance 3e-6. (..., D) -> (...,)

    Keys depend on the bits of the rows, whose size must be a multiple of 8 bytes.
    """
    lanes = np.ascontiguousarray(rows).view(np.uint64)  # (..., D itemsize / 8)
    factors = 2 * np.random.default_rng(0).integers(2**63, size=lanes.shape[-1:], dtype=np.uint64) + 1  # odd
    mixed = lanes * factors  # wraps around
    return ((mixed ^ (mixed >> np.uint64(29))) * factors[::-1]).sum(axis=-1, dtype=np.uint64)
