"""Protecting features for real: the randomness is the operating system's, and nobody's to repeat."""

from __future__ import annotations

import numpy as np

from bench.plugin import Defense
from bench.public import Public
from bench.types import Features, Release


def protect(
    features: Features, defense: Defense, rng: np.random.Generator | None = None, public: Public | None = None
) -> Release:
    """Return what may leave the phone.

    Parameters
    ----------
    features : the secret
    defense : such as `LDP(epsilon=10)`
    rng : the operating system's entropy if None; a generator whose seed is known protects nobody
    public : pass one `Public()` to many calls, so that the dictionary is read once

    Raises
    ------
    UserError
        if the defense's dictionary is missing or damaged, or does not fit the features.
    """
    return defense.protect(features, public or Public(), rng or np.random.default_rng())
