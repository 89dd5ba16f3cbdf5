"""Plateau: a set of words that is likelier, by e^ε, if it holds the true word or one of those nearest to it.

Let T(v) be the t words nearest to v, itself among them, and v the word nearest to the descriptor. Of all sets Z of m words,

    Pr(Z | v) = e^ε / (A e^ε + B)   if Z and T(v) have a word in common,    A = C(|K|, m) − C(|K| − t, m) sets,
    Pr(Z | v) = 1   / (A e^ε + B)   if they have none,                      B = C(|K| − t, m) sets.

*It is ε-LDP:* t is the same for all v, and so are A and B; the two values differ by the factor e^ε, and there are no others.
T(v) is a function of v, v one of the descriptor, and the same bound holds for descriptors. ∎ With t = 1 this is `ldp`, word for
word.

The ω-subset mechanism tells the true word and spends the rest on words that are drawn from all alike. Here the words near the
true one are as likely as it is. Where p is small, each is told nearly as often as `ldp` tells the true one: with m t e^ε well
below |K|, t costs the true word little, and where p is large, much. A server that meets the descriptor again may quantise it to
a near word; an attacker likes a near word almost as much as the true one. docs/better.md measures both.

Sampled exactly: whether Z meets T(v) as `ldp` samples u, with the whole numbers A + B and A for |K| and m; how many words they
share, of C(t, j) C(|K| − t, m − j) sets each; and then subsets of both, without replacement. Rows come out sorted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import ClassVar

import numpy as np

from bench.api import Asset, Between, Defense, OneOf, Privacy
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.classes import draw_classes
from bench.mechanisms.subset import draw_distinct, draw_told, log10_chance
from bench.types import Features, Indices, WordSets


@dataclass(frozen=True, kw_only=True)
class Plateau(Defense):
    """Releases a random set of words, likelier if it holds the descriptor's nearest word or one near to that."""

    releases = WordSets
    supported_settings: ClassVar[Mapping[str, Between | OneOf]] = {
        "epsilon": Between(8.0, 16.0),
        "subset_size": OneOf((1, 2, 3, 4)),
        "near": OneOf((2, 4, 8)),
        "words": OneOf((0, 128_000)),
    }
    dictionary_field: ClassVar[str | None] = "dictionary"
    word_count_field: ClassVar[str | None] = "words"

    epsilon: float = 10.0  # nats, per descriptor
    subset_size: int = 2  # words released per keypoint
    near: int = 4  # words of the plateau, the true one among them
    dictionary: Asset = Asset("shipped")
    words: int = 0  # how many of the dictionary's words are used at most, from its first on; 0 is all

    def __post_init__(self) -> None:
        if not self.epsilon >= 0:  # NaN is refused too
            raise UserError(f"plateau: epsilon must be at least 0, got {self.epsilon}")
        if self.subset_size < 1 or self.near < 1:
            raise UserError(f"plateau: subset_size and near must be at least 1, got {self.subset_size} and {self.near}")
        if self.words < 0 or self.words == 1:
            raise UserError(f"plateau: words must be 0 for all, or at least 2, got {self.words}")

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        known = self._known(public)
        true = public.nearest_words(self.dictionary, secret, self.words)  # (N,)
        words = plateau_subsets(known.neighbours.nearest(true, self.near), len(known), self.epsilon, self.subset_size, rng)
        candidates = unit_rows(known.words[words])  # (N, m, D)
        return WordSets(keypoints=secret.keypoints.copy(), size=secret.size, candidates=candidates, words=words)

    def privacy(self, public: Public) -> Privacy:
        domain = len(self._known(public))
        meeting = _meeting(domain, self.near, self.subset_size)
        holding = Fraction(math.comb(domain - 1, self.subset_size - 1), meeting)  # the true word, of those sets that meet T
        log10_true = log10_chance(self.epsilon, math.comb(domain, self.subset_size), meeting) + math.log10(holding)
        if math.isinf(self.epsilon):
            return Privacy("none", log10_true=log10_true)
        return Privacy("epsilon-ldp", self.epsilon, log10_true)

    def _known(self, public: Public) -> Dictionary:
        """The dictionary, once it is known to hold enough words."""
        known = public.dictionary(self.dictionary, self.words)
        if len(known) < max(self.subset_size, self.near):
            raise UserError(
                f"plateau: subset_size is {self.subset_size} and near {self.near}, but the dictionary has {len(known)} words"
            )
        return known


def _meeting(domain: int, near: int, size: int) -> int:
    """A: how many sets of `size` words have one of the plateau."""
    return math.comb(domain, size) - math.comb(domain - near, size)


def plateau_subsets(plateaus: Indices, domain: int, epsilon: float, size: int, rng: np.random.Generator) -> Indices:
    """The mechanism on K = {0, ..., domain − 1}. plateaus: (N, t), rows ascending -> (N, m), rows ascending"""
    rows, near = plateaus.shape
    shared = np.zeros(rows, dtype=np.int64)  # words of the plateau in each set
    met = draw_told(rows, epsilon, math.comb(domain, size), _meeting(domain, near, size), rng)
    ways = [math.comb(near, j) * math.comb(domain - near, size - j) for j in range(1, min(near, size) + 1)]
    shared[met] = 1 + draw_classes([ways], [Fraction(0)] * len(ways), np.zeros(met.sum(), dtype=np.int64), rng)
    words = np.empty((rows, size), dtype=np.int64)
    for j in np.unique(shared):
        here = np.flatnonzero(shared == j)
        inside = draw_distinct(len(here), near, int(j), rng)  # (n, j) of the t
        others = draw_distinct(len(here), domain - near, size - int(j), rng)  # (n, m − j) of the |K| − t that remain
        for word in plateaus[here].T:
            others += others >= word[:, None]
        words[here, :j] = np.take_along_axis(plateaus[here], inside, axis=1)
        words[here, j:] = others
    return np.sort(words, axis=1)


PLUGIN = Plateau
