"""Gaussian noise: the control that any defense has to beat. Releases each descriptor with noise, scaled to unit norm.

Source: not in the paper.

Method: with g standard normal in D dimensions, release d + sigma g / √D, scaled to unit norm. The noise has a mean square length
of sigma², so sigma compares with the descriptor's length of 1, whatever D is.

Guarantee: none is claimed. Noise of one size for all descriptors gives no ε-LDP.

`tools/match_noise.py` finds the sigma at which a server matches as well as under another defense.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.api import Defense, Privacy
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.nearest_words import unit_rows
from bench.settings import Between, OneOf
from bench.types import Descriptors, Features, Points


@dataclass(frozen=True, kw_only=True)
class Noise(Defense):
    """Releases each descriptor with Gaussian noise."""

    releases = Descriptors
    supported_settings: ClassVar[Mapping[str, Between | OneOf]] = {"sigma": Between(0.0, 4.0)}
    noisy: ClassVar[bool] = True

    sigma: float = 1.0  # root mean square length of the noise, as a multiple of a descriptor's length

    def __post_init__(self) -> None:
        if not (self.sigma >= 0 and math.isfinite(self.sigma)):  # NaN is refused too
            raise UserError(f"noise: sigma must be at least 0 and finite, got {self.sigma}")

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        length = secret.descriptors.shape[1]
        noisy = secret.descriptors + self.sigma / math.sqrt(length) * rng.normal(size=secret.descriptors.shape)
        released = unit_rows(noisy.astype(np.float32))
        return Descriptors(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, descriptors=released)

    def privacy(self, public: Public) -> Privacy:
        return Privacy("none")


PLUGIN = Noise
