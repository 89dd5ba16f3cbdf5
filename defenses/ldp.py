"""LDP-Feat: the ω-subset mechanism on a dictionary of descriptors (Sec. 5.2, Steps 1 to 3; Eq. (5); Theorem 1).

With `memoize`, one answer is drawn for each word of the dictionary, and a device gives it whenever the word comes up. All that a
device ever sends is then a function of its table of answers, so a word costs ε once, however often it is sent. In return equal
words are seen to be equal, in one photograph and from one to the next, which no ε covers (docs/guarantee.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.api import Asset, Between, Defense, OneOf, Privacy
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.subset import log10_chance, word_subsets
from bench.types import Features, WordSets


@dataclass(frozen=True, kw_only=True)
class LDP(Defense):
    """Releases a random set of words, the descriptor's nearest among them with a probability that epsilon sets.

    `epsilon=inf` always releases the nearest word, with `subset_size` - 1 random ones: quantisation, and no guarantee.
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
    words: int = 0  # how many of the dictionary's words are used at most, from its first on; 0 is all
    memoize: bool = False  # whether a word always gets the same answer on one device

    def __post_init__(self) -> None:
        if not self.epsilon >= 0:  # NaN is refused too
            raise UserError(f"ldp: epsilon must be at least 0, got {self.epsilon}")
        if self.subset_size < 1:
            raise UserError(f"ldp: subset_size must be at least 1, got {self.subset_size}")
        if self.words < 0 or self.words == 1:
            raise UserError(f"ldp: words must be 0 for all, or at least 2, got {self.words}")

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        known = self._known(public)
        nearest = public.nearest_words(self.dictionary, secret, self.words)  # (N,) d'
        # A device that remembers draws its answers to all words, whichever it is asked for.
        asked = np.arange(len(known)) if self.memoize else nearest
        answers = word_subsets(asked, len(known), self.epsilon, self.subset_size, rng)
        words = answers[nearest] if self.memoize else answers  # (N, m)
        distinct, places = np.unique(words, return_inverse=True)
        candidates = unit_rows(known.words[distinct])[places.reshape(words.shape)]  # (N, m, D)
        return WordSets(keypoints=secret.keypoints.copy(), size=secret.size, candidates=candidates, words=words)

    def privacy(self, public: Public) -> Privacy:
        log10_true = log10_chance(self.epsilon, len(self._known(public)), self.subset_size)
        if math.isinf(self.epsilon):
            return Privacy("none", log10_true=log10_true)
        return Privacy("epsilon-ldp-by-word" if self.memoize else "epsilon-ldp", self.epsilon, log10_true)

    def is_memoized(self) -> bool:
        return self.memoize

    def _known(self, public: Public) -> Dictionary:
        """The dictionary, once it is known to hold enough words."""
        known = public.dictionary(self.dictionary, self.words)
        if len(known) < self.subset_size:
            raise UserError(f"ldp: subset_size is {self.subset_size}, but the dictionary has {len(known)} words")
        return known


PLUGIN = LDP
