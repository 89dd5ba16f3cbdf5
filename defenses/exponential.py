"""Exponential mechanism: releases words that are likelier if they are more similar to the true word.

Source: McSherry and Talwar, FOCS 2007; not in the paper.

Method:

1. Replace the descriptor by its nearest word v, the true word.
2. The utility u(v, w) of a word w is a function of the cosine of v and w: 0 up to `floor`, 1 at cosine 1, and linear between.
   It is rounded down to one of `levels` + 1 values.
3. Draw one word with

       Pr(w | v) = e^(ε u(v, w) / 2) / N(v),    N(v) = Σ_w e^(ε u(v, w) / 2).

4. For m = `subset_size` words, draw one word at a time without replacement, with ε / m each. The order of the draws is not
   released.

*It is ε-LDP:* u lies in [0, 1], so e^(ε u(v, w) / 2) changes by at most the factor e^(ε / 2) from one v to another. So does
each term of N, and hence N. The quotient of the two changes by at most e^ε. ∎ Given the earlier draws, each of m draws is
this mechanism on fewer words, so m draws compose to ε.

Limits: the factor 2 in the exponent is due to normalisers N(v) that differ between words. `plateau` has equal normalisers and
does not need it.

Exactness: the proof holds for any u that is a function of v and w, so u may be rounded. u is computed from integers and is
the same on every machine (`bench.geometry.neighbours`). The draw is exact (`bench.mechanisms.graded`): one pass over the
dictionary.
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
from bench.core.exact import to_fraction
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.graded import draw_graded_words
from bench.settings import Asset, Between, OneOf
from bench.types import Features, Points, WordSets


@dataclass(frozen=True, kw_only=True)
class Exponential(Defense):
    """Releases words whose probability grows with their cosine with the descriptor's nearest word."""

    releases = WordSets
    supported_settings: ClassVar[Mapping[str, Between | OneOf]] = {"epsilon": Between(8.0, 32.0), "words": OneOf((0, 128_000))}
    dictionary_field: ClassVar[str | None] = "dictionary"
    word_count_field: ClassVar[str | None] = "words"

    epsilon: float = 10.0  # nats, per descriptor
    subset_size: int = 1  # words released per keypoint, each with epsilon / subset_size
    floor: float = 0.8  # greatest cosine of utility 0; the cosine of most words is less
    levels: int = 8  # number of utilities above 0
    dictionary: Asset = Asset("shipped")
    words: int = 0  # number of the dictionary's first words to use; 0 is all

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
        dictionary = self._load_dictionary(public)
        true = public.nearest_words(self.dictionary, secret, self.words)  # (N,)
        # By rounding, the cosine of a word with itself may be less than 1.
        borders = self.floor + (1 - self.floor) * np.arange(1, self.levels + 1) / self.levels - 1e-9
        powers = [to_fraction(self.epsilon) * level / (2 * self.levels * self.subset_size) for level in range(self.levels + 1)]
        words = draw_graded_words(dictionary.neighbours, true, borders, powers, self.subset_size, rng)
        candidates = unit_rows(dictionary.words[words])  # (N, m, D)
        return WordSets(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, candidates=candidates, words=words)

    def privacy(self, public: Public) -> Privacy:
        self._load_dictionary(public)
        return Privacy("epsilon-ldp", self.epsilon)  # the probability of the true word differs between words

    def _load_dictionary(self, public: Public) -> Dictionary:
        """Load the dictionary and check that it has enough words."""
        dictionary = public.dictionary(self.dictionary, self.words)
        if len(dictionary) < self.subset_size:
            raise UserError(f"exponential: subset_size is {self.subset_size}, but the dictionary has {len(dictionary)} words")
        return dictionary


PLUGIN = Exponential
