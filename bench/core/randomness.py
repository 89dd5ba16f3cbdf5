"""Random generators derived from their purpose, so that no result depends on the order of computations."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from bench.core.hashing import canonical_json


def derive_generator(*parts: Any) -> np.random.Generator:
    """Return a generator that is a function of `parts` alone. Parts are JSON values."""
    return np.random.default_rng(int(hashlib.sha256(canonical_json(parts).encode()).hexdigest(), 16))
