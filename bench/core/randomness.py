"""Generators that are functions of what they are for, so that no result depends on what was done before it."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from bench.core.hashing import canonical


def randomness(*parts: Any) -> np.random.Generator:
    """A generator that is a function of `parts` alone, which are JSON."""
    return np.random.default_rng(int(hashlib.sha256(canonical(parts).encode()).hexdigest(), 16))
