"""LDP-Feat: the ω-subset mechanism on a dictionary of descriptors.

Source: the paper's Sec. 5.2, Steps 1 to 3; Eq. (5); Theorem 1.

Method, for a dictionary K and a subset size m:

1. Replace the descriptor by its nearest word d'.
2. Draw u = 1 with probability m e^ε / (m e^ε + |K| − m).
3. Draw m − u words without replacement from K − {d'}, and add d' if u = 1. Release the set in sorted order: another order could
   reveal the true word.

Guarantee: ε-LDP of one descriptor. `bench.mechanisms.subset` states the theorem and samples it exactly.

With `memoize`, one answer is drawn for each word of the dictionary, and a device always sends that answer for the word. All
releases of a device are then a function of its table of answers. So a word costs ε once, regardless of the number of releases. In
return, equal words are visibly equal within and across photographs. No ε covers this (docs/guarantee.md).

Limits: ε is per descriptor, so the keypoints of one image compose. Positions are released in the clear.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.api import Defense, Privacy
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.subset import draw_word_subsets, log10_chance
from bench.settings import Asset, Between, OneOf
from bench.types import Features, Points, WordSets


@dataclass(frozen=True, kw_only=True)
class LDP(Defense):
    """Releases a random set of words that contains the descriptor's nearest word with a probability set by epsilon.

    `epsilon=inf` always releases the nearest word, with `subset_size` - 1 random ones. This is quantisation without a guarantee.
    """

    releases = WordSets
    supported_settings: ClassVar[Mapping[str, Between | OneOf]] = {
        "epsilon": Between(8.0, 16.0),
        "subset_size": OneOf((1, 2, 3, 4)),
        "words": OneOf((0, 128_000)),
    }
    dictionary_field: ClassVar[str | None] = "dictionary"
    word_count_field: ClassVar[str | None] = "words"

    epsilon: float = 10.0  # nats, per descriptor
    subset_size: int = 2  # words released per keypoint
    dictionary: Asset = Asset("shipped")
    words: int = 0  # number of the dictionary's first words to use; 0 is all
    memoize: bool = False  # whether one device always sends the same set for a word

    def __post_init__(self) -> None:
        if not self.epsilon >= 0:  # NaN is refused too
            raise UserError(f"ldp: epsilon must be at least 0, got {self.epsilon}")
        if self.subset_size < 1:
            raise UserError(f"ldp: subset_size must be at least 1, got {self.subset_size}")
        if self.words < 0 or self.words == 1:
            raise UserError(f"ldp: words must be 0 for all, or at least 2, got {self.words}")

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        dictionary = self._load_dictionary(public)
        nearest = public.nearest_words(self.dictionary, secret, self.words)  # (N,) d'
        # A memoized defense draws the answers for all words, regardless of the features.
        inputs = np.arange(len(dictionary)) if self.memoize else nearest
        answers = draw_word_subsets(inputs, len(dictionary), self.epsilon, self.subset_size, rng)
        words = answers[nearest] if self.memoize else answers  # (N, m)
        distinct, inverse = np.unique(words, return_inverse=True)
        candidates = unit_rows(dictionary.words[distinct])[inverse.reshape(words.shape)]  # (N, m, D)
        return WordSets(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, candidates=candidates, words=words)

    def privacy(self, public: Public) -> Privacy:
        log10_true = log10_chance(self.epsilon, len(self._load_dictionary(public)), self.subset_size)
        if math.isinf(self.epsilon):
            return Privacy("none", log10_true=log10_true)
        return Privacy("epsilon-ldp-by-word" if self.memoize else "epsilon-ldp", self.epsilon, log10_true)

    def is_memoized(self) -> bool:
        return self.memoize

    def _load_dictionary(self, public: Public) -> Dictionary:
        """Load the dictionary and check that it has enough words."""
        dictionary = public.dictionary(self.dictionary, self.words)
        if len(dictionary) < self.subset_size:
            raise UserError(f"ldp: subset_size is {self.subset_size}, but the dictionary has {len(dictionary)} words")
        return dictionary


PLUGIN = LDP
