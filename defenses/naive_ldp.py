"""Naive LDP: the ω-subset mechanism on the full descriptor space.

Source: the paper's Sec. 5.2, "Naive Approach".

Method: K is the set of all bit patterns of a descriptor, with |K| = 2^(8·128) for uint8 and 2^(32·128) for float32. For float32
descriptors of length 64, |K| = 2^(32·64). The mechanism draws m patterns, as `ldp` draws words. Reading the patterns as
descriptors is post-processing and costs no privacy.

Rule for patterns that are not descriptors: a component that is NaN or infinite is read as 0. The row is then scaled to unit
norm in float64. A row of zeros stays zero.

Guarantee: ε-LDP of one descriptor.

Limits: |K| is so large that the descriptor's own pattern is almost never released.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from bench.api import Defense, Privacy
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.subset import draw_pattern_subsets, log10_chance
from bench.settings import Between, OneOf
from bench.types import Bytes, Features, Floats, Points, WordSets

# Bits and number of the components of a descriptor; |K| depends on them.
BITS = {"uint8": 8, "float32": 32, "float32x64": 32}
LENGTHS = {"uint8": 128, "float32": 128, "float32x64": 64}


@dataclass(frozen=True, kw_only=True)
class NaiveLDP(Defense):
    """Releases a random set of bit patterns, which almost never contains the descriptor's own pattern."""

    releases = WordSets
    supported_settings: ClassVar[Mapping[str, Between | OneOf]] = {
        "epsilon": Between(0.0, 32.0),
        "subset_size": OneOf((1, 2, 3, 4)),
    }

    epsilon: float = 10.0  # nats, per descriptor
    subset_size: int = 2  # patterns released per keypoint
    element: Literal["uint8", "float32", "float32x64"] = "uint8"  # type of a descriptor's 128 components, or of 64

    def __post_init__(self) -> None:
        if not self.epsilon >= 0:  # NaN is refused too
            raise UserError(f"naive-ldp: epsilon must be at least 0, got {self.epsilon}")
        if self.subset_size < 1:
            raise UserError(f"naive-ldp: subset_size must be at least 1, got {self.subset_size}")
        if self.element not in BITS:
            raise UserError(f"naive-ldp: element must be uint8, float32 or float32x64, got {self.element}")

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        patterns = draw_pattern_subsets(self._encode_patterns(secret), self.epsilon, self.subset_size, rng)  # (N, m, B)
        candidates = unit_rows(patterns if self.element == "uint8" else read_finite_floats(patterns))  # (N, m, D)
        return WordSets(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, candidates=candidates, words=None)

    def privacy(self, public: Public) -> Privacy:
        log10_true = log10_chance(self.epsilon, 2 ** (BITS[self.element] * LENGTHS[self.element]), self.subset_size)
        if math.isinf(self.epsilon):
            return Privacy("none", log10_true=log10_true)
        return Privacy("epsilon-ldp", self.epsilon, log10_true)

    def _encode_patterns(self, secret: Features) -> Bytes:
        """Return the descriptors as bytes. -> (N, B)"""
        length, expected = secret.descriptors.shape[1], LENGTHS[self.element]
        if length != expected:
            hint = "; use element=float32x64" if length == LENGTHS["float32x64"] else ""
            raise UserError(f"naive-ldp: descriptors must have length {expected}, got {length}{hint}")
        if self.element != "uint8":
            return secret.descriptors.astype("<f4").view(np.uint8)
        if secret.codes is None:
            raise UserError("naive-ldp: these features have no 8-bit codes; use element=float32")
        return secret.codes


def read_finite_floats(patterns: Bytes) -> Floats:
    """Return the patterns read as float32, with NaN and infinities as 0. (N, m, 4 D) -> (N, m, D)"""
    values = patterns.view("<f4")
    return np.where(np.isfinite(values), values, np.float32(0))


PLUGIN = NaiveLDP
