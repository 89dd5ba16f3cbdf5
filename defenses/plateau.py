"""Plateau: releases a set of words that is likelier, by e^ε, if it contains the true word or a word near it.

Source: not in the paper.

Method: let v be the word nearest to the descriptor. Let T(v) be the t words nearest to v, including v itself. Of all sets Z of m
words, draw one with

    Pr(Z | v) = e^ε / (A e^ε + B)   if Z and T(v) share a word; there are A = C(|K|, m) − C(|K| − t, m) such sets,
    Pr(Z | v) = 1   / (A e^ε + B)   if they do not; there are B = C(|K| − t, m) such sets.

*It is ε-LDP:* t is the same for all v, and so are A and B. The only two values differ by the factor e^ε. T(v) is a function of v,
and v is a function of the descriptor, so the same bound holds for descriptors. ∎ With t = 1 this is exactly `ldp`.

Comparison with `ldp`, which draws the other words uniformly: here each of the t − 1 near words is as likely as the true one.
With m t e^ε well below |K|, the true word is released nearly as often as by `ldp`. With m e^ε near |K| or above, it is
released much less often. A near word helps a server only if the map's descriptor of that point is quantised to it. For an
attacker, a near word is almost as useful as the true one.

Exactness: each step of the sampling is exact.

1. Draw whether Z and T(v) share a word. This is the draw of u in `ldp`, with the integers A + B and A for |K| and m.
2. Draw the number j of shared words. There are C(t, j) C(|K| − t, m − j) sets for each j.
3. Draw j words of T(v) and m − j of the others, without replacement. Rows are sorted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import ClassVar

import numpy as np

from bench.api import Defense, Privacy
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.classes import draw_classes
from bench.mechanisms.subset import draw_distinct, draw_inclusion, log10_chance
from bench.settings import Asset, Between, OneOf
from bench.types import Features, Indices, Points, WordSets


@dataclass(frozen=True, kw_only=True)
class Plateau(Defense):
    """Releases a random set of words that is likelier if it contains the descriptor's nearest word or a word near that one."""

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
    near: int = 4  # t, the number of words in T(v), including the true one
    dictionary: Asset = Asset("shipped")
    words: int = 0  # number of the dictionary's first words to use; 0 is all

    def __post_init__(self) -> None:
        if not self.epsilon >= 0:  # NaN is refused too
            raise UserError(f"plateau: epsilon must be at least 0, got {self.epsilon}")
        if self.subset_size < 1 or self.near < 1:
            raise UserError(f"plateau: subset_size and near must be at least 1, got {self.subset_size} and {self.near}")
        if self.words < 0 or self.words == 1:
            raise UserError(f"plateau: words must be 0 for all, or at least 2, got {self.words}")

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        dictionary = self._load_dictionary(public)
        true = public.nearest_words(self.dictionary, secret, self.words)  # (N,)
        words = draw_plateau_subsets(
            dictionary.neighbours.find_nearest(true, self.near), len(dictionary), self.epsilon, self.subset_size, rng
        )
        candidates = unit_rows(dictionary.words[words])  # (N, m, D)
        return WordSets(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, candidates=candidates, words=words)

    def privacy(self, public: Public) -> Privacy:
        domain = len(self._load_dictionary(public))
        intersecting = _count_intersecting_sets(domain, self.near, self.subset_size)
        fraction = Fraction(math.comb(domain - 1, self.subset_size - 1), intersecting)  # of these sets that contain the true word
        log10_true = log10_chance(self.epsilon, math.comb(domain, self.subset_size), intersecting) + math.log10(fraction)
        if math.isinf(self.epsilon):
            return Privacy("none", log10_true=log10_true)
        return Privacy("epsilon-ldp", self.epsilon, log10_true)

    def _load_dictionary(self, public: Public) -> Dictionary:
        """Load the dictionary and check that it has enough words."""
        dictionary = public.dictionary(self.dictionary, self.words)
        if len(dictionary) < max(self.subset_size, self.near):
            raise UserError(
                f"plateau: subset_size is {self.subset_size} and near {self.near}, but the dictionary has {len(dictionary)} words"
            )
        return dictionary


def _count_intersecting_sets(domain: int, near: int, size: int) -> int:
    """Return A, the number of sets of `size` words that share a word with T(v)."""
    return math.comb(domain, size) - math.comb(domain - near, size)


def draw_plateau_subsets(plateaus: Indices, domain: int, epsilon: float, size: int, rng: np.random.Generator) -> Indices:
    """Draw sets of the mechanism on K = {0, ..., domain − 1}. plateaus T(v): (N, t), rows ascending -> (N, m), rows ascending"""
    rows, near = plateaus.shape
    shared = np.zeros(rows, dtype=np.int64)  # number of words of T(v) in each set
    intersecting = draw_inclusion(rows, epsilon, math.comb(domain, size), _count_intersecting_sets(domain, near, size), rng)
    ways = [math.comb(near, j) * math.comb(domain - near, size - j) for j in range(1, min(near, size) + 1)]
    shared[intersecting] = 1 + draw_classes([ways], [Fraction(0)] * len(ways), np.zeros(intersecting.sum(), dtype=np.int64), rng)
    words = np.empty((rows, size), dtype=np.int64)
    for j in np.unique(shared):
        members = np.flatnonzero(shared == j)
        inside = draw_distinct(len(members), near, int(j), rng)  # (n, j) of the t
        others = draw_distinct(len(members), domain - near, size - int(j), rng)  # (n, m − j) of the other |K| − t
        for word in plateaus[members].T:
            others += others >= word[:, None]
        words[members, :j] = np.take_along_axis(plateaus[members], inside, axis=1)
        words[members, j:] = others
    return np.sort(words, axis=1)


PLUGIN = Plateau
