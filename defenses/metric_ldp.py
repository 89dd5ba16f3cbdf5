"""Metric LDP: d_χ-privacy over words, by which two descriptors are protected against each other according to their distance.

Source: Chatzikokolakis et al., PETS 2013; for embeddings Feyisetan et al., WSDM 2020; not in the paper.

Guarantee: this is not ε-LDP. With ε in nats *per unit of distance*,

    Pr(w | v1) ≤ e^(ε d(v1, v2)) Pr(w | v2)    for all words w, and v1, v2 the words nearest to the two descriptors.

Similar descriptors are hard to distinguish. Descriptors of different kinds can be distinguished as far as ε times their
distance allows. The greatest distance is √2, that of SIFT descriptors with no direction in common. Values of ε in nats and in
nats per distance are not comparable.

Method:

1. Replace the descriptor by its nearest word v.
2. d(v, w) is the distance of the unit words, rounded up to a multiple of 1/`steps`. It is a metric: rounding up preserves
   zero and order, and ⌈a + b⌉ ≤ ⌈a⌉ + ⌈b⌉.
3. Draw one word with Pr(w | v) = e^(−ε d(v, w) / 2) / N(v).

*Proof.* |d(v1, w) − d(v2, w)| ≤ d(v1, v2), so numerators differ by at most the factor e^(ε d(v1, v2) / 2). So do the terms of
N, and hence N. The quotient differs by at most e^(ε d(v1, v2)). ∎

Exactness: distances are computed from integers, to within `SLACK`. The metric of the guarantee is the distance plus 2 `SLACK`,
rounded up. This covers distances that rounding puts on the wrong side of a step. The draw is exact (`bench.mechanisms.graded`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import ClassVar

import numpy as np

from bench.api import Defense, Privacy
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.core.exact import to_fraction
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.graded import draw_graded_words
from bench.settings import Asset, Between, OneOf
from bench.types import Features, Points, WordSets

SLACK = 2e-6  # error of a distance: cosines are off by 1e-15, and cosines nearer to 1 than ZERO_TOLERANCE have distance zero
ZERO_TOLERANCE = 1e-12
FARTHEST = 2  # greatest distance of unit vectors


@dataclass(frozen=True, kw_only=True)
class MetricLDP(Defense):
    """Releases a word whose probability falls with its distance to the descriptor's nearest word."""

    releases = WordSets
    supported_settings: ClassVar[Mapping[str, Between | OneOf]] = {"epsilon": Between(10.0, 80.0), "words": OneOf((0, 128_000))}
    dictionary_field: ClassVar[str | None] = "dictionary"
    word_count_field: ClassVar[str | None] = "words"

    epsilon: float = 16.0  # nats per unit of distance between unit descriptors
    steps: int = 16  # number of rounded distances per unit of distance
    dictionary: Asset = Asset("shipped")
    words: int = 0  # number of the dictionary's first words to use; 0 is all

    def __post_init__(self) -> None:
        if not (self.epsilon >= 0 and math.isfinite(self.epsilon)):  # NaN is refused too
            raise UserError(f"metric-ldp: epsilon must be at least 0 and finite, got {self.epsilon}")
        if self.steps < 1:
            raise UserError(f"metric-ldp: steps must be at least 1, got {self.steps}")
        if self.words < 0 or self.words == 1:
            raise UserError(f"metric-ldp: words must be 0 for all, or at least 2, got {self.words}")

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        dictionary = public.dictionary(self.dictionary, self.words)
        true = public.nearest_words(self.dictionary, secret, self.words)  # (N,)
        most = FARTHEST * self.steps  # steps to the farthest word
        distances = np.arange(most)[::-1] / self.steps
        borders = 1 - distances**2 / 2 - ZERO_TOLERANCE  # |a − b|² = 2 − 2 cos, ascending
        powers = [-to_fraction(self.epsilon) * (most - level) / (2 * self.steps) for level in range(most + 1)]
        words = draw_graded_words(dictionary.neighbours, true, borders, powers, 1, rng)
        candidates = unit_rows(dictionary.words[words])  # (N, 1, D)
        return WordSets(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, candidates=candidates, words=words)

    def privacy(self, public: Public) -> Privacy:
        public.dictionary(self.dictionary, self.words)
        return Privacy("d-chi", per_distance=self.epsilon)

    def distance(self, secret: Features, public: Public, one: int, other: int) -> Fraction:
        dictionary = public.dictionary(self.dictionary, self.words)
        words = public.nearest_words(self.dictionary, secret.take(np.array([one, other])), self.words)
        if words[0] == words[1]:
            return Fraction(0)
        first, second = dictionary.words[words].astype(np.float64)
        distance = float(np.linalg.norm(first / np.linalg.norm(first) - second / np.linalg.norm(second)))
        return Fraction(math.ceil((distance + 2 * SLACK) * self.steps), self.steps)


PLUGIN = MetricLDP
