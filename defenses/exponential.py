"""Exponential: words that are the likelier, the more they are like the true one (McSherry and Talwar, FOCS 2007).

The utility of a word w for the true word v, the one nearest to the descriptor, is their cosine: 0 up to `floor`, 1 at cosine 1,
straight between, and rounded down to one of `levels` + 1 values. One word is drawn with

    Pr(w | v) = e^(ε u(v, w) / 2) / N(v),    N(v) = Σ_w e^(ε u(v, w) / 2).

*It is ε-LDP:* u lies in [0, 1], so that e^(ε u(v, w) / 2) differs by the factor e^(ε / 2) at most from one v to another. So
does each term of N, and hence N. The quotient of the two differs by e^ε at most. ∎ The 2 is the price of normalisers that
differ: `plateau` has equal ones and does without.

For m words, they are drawn one after the other, each from those that are left, with ε / m each. Given those before, each is this
very mechanism on fewer words, so that the m of them compose to ε. Which came first is not told.

Nothing in the proof rests on how u is rounded, as long as it is a function of v and w; here it is one of whole numbers,
whatever the machine (`bench.geometry.neighbours`). The draw is exact (`bench.mechanisms.graded`), in blocks of words, one pass over
the dictionary.
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
from bench.core.exact import exact
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.graded import graded_words
from bench.types import Features, WordSets


@dataclass(frozen=True, kw_only=True)
class Exponential(Defense):
    """Releases words that are the likelier, the greater their cosine with the descriptor's nearest word."""

    releases = WordSets
    supported_settings: ClassVar[Mapping[str, Between | OneOf]] = {"epsilon": Between(8.0, 32.0), "words": OneOf((0, 128_000))}
    dictionary_field: ClassVar[str | None] = "dictionary"
    word_count_field: ClassVar[str | None] = "words"

    epsilon: float = 10.0  # nats, per descriptor
    subset_size: int = 1  # words released per keypoint, with epsilon / subset_size each
    floor: float = 0.8  # the cosine up to which a word is of no use; most are below it
    levels: int = 8  # of utility, beside 0
    dictionary: Asset = Asset("shipped")
    words: int = 0  # how many of the dictionary's words are used at most, from its first on; 0 is all

    def __post_init__(self) -> None:
        if not (self.epsilon >= 0 and math.isfinite(self.epsilon)):  # NaN is refused too
            raise UserError(f"exponential: epsilon must be at least 0 and finite, got {self.epsilon}")
        if self.subset_size < 1 or self.levels < 1:
            raise UserError(f"exponential: subset_size and levels must be at least 1, got {self.subset_size} and {self.levels}")
        if not 0 <= self.floor < 1:
            raise UserError(f"exponential: floor must be at least 0 and below 1, got {self.floor}")
        if self.words < 0 or self.words == 1:
            raise UserError(f"exponential: words must be 0 for all, or at least 2, got {self.words}")

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        known = self._known(public)
        true = public.nearest_words(self.dictionary, secret, self.words)  # (N,)
        # A word's cosine with itself may be rounded to below 1.
        borders = self.floor + (1 - self.floor) * np.arange(1, self.levels + 1) / self.levels - 1e-9
        powers = [exact(self.epsilon) * level / (2 * self.levels * self.subset_size) for level in range(self.levels + 1)]
        words = graded_words(known.neighbours, true, borders, powers, self.subset_size, rng)
        candidates = unit_rows(known.words[words])  # (N, m, D)
        return WordSets(keypoints=secret.keypoints.copy(), size=secret.size, candidates=candidates, words=words)

    def privacy(self, public: Public) -> Privacy:
        self._known(public)
        return Privacy("epsilon-ldp", self.epsilon)  # the chance of the true word is another for each word

    def _known(self, public: Public) -> Dictionary:
        """The dictionary, once it is known to hold enough words."""
        known = public.dictionary(self.dictionary, self.words)
        if len(known) < self.subset_size:
            raise UserError(f"exponential: subset_size is {self.subset_size}, but the dictionary has {len(known)} words")
        return known


PLUGIN = Exponential
