"""Exact draws of words with weights by similarity to the true word, in a few levels.

The words of a level are equally likely. A draw consists of two: first a level, with chances that `bench.mechanisms.classes`
compares bit by bit, then an integer. The alternative, floating-point noise (such as Gumbel's) added to the utilities, does not
have the chances of the theorem. Its set of values differs between inputs, so the low bits of the sums reveal the input (Mironov,
CCS 2012).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from bench.geometry.neighbours import Doubles, Neighbours
from bench.mechanisms.classes import draw_classes
from bench.types import Indices


def draw_graded_words(
    neighbours: Neighbours, true: Indices, borders: Doubles, powers: Sequence[Fraction], size: int, rng: np.random.Generator
) -> Indices:
    """Return words drawn one at a time without replacement, with chances in proportion to e^power.

    Parameters
    ----------
    true : (N,) words
    borders : (L,) cosines, ascending; the level of a word is the number of borders that its cosine with the true one reaches
    powers : L + 1, one for each level
    size : m, at most |K|

    Returns
    -------
    (N, m) words, rows ascending: the order of the draws is not released
    """
    distinct, which = np.unique(true, return_inverse=True)
    counts = neighbours.count_levels(distinct, borders)  # (P, blocks, L + 1)
    left = counts.sum(axis=1)[which]  # (N, L + 1)
    rows = np.arange(len(true))
    levels, ranks = (np.empty((len(true), size), dtype=np.int64) for _ in range(2))
    for step in range(size):
        profiles, alike = np.unique(left, axis=0, return_inverse=True)
        levels[:, step] = draw_classes(profiles.tolist(), powers, alike.ravel(), rng)
        ranks[:, step] = rng.integers(left[rows, levels[:, step]])
        left[rows, levels[:, step]] -= 1
    _convert_to_all_words(levels, ranks)
    words = [neighbours.select_words(true, borders, counts[which], levels[:, step], ranks[:, step]) for step in range(size)]
    return np.sort(np.stack(words, axis=1), axis=1)


def _convert_to_all_words(levels: Indices, ranks: Indices) -> None:
    """Convert ranks among the remaining words of a level to ranks among all of its words, in place. (N, m), (N, m)"""
    for step in range(1, ranks.shape[1]):
        taken = np.where(levels[:, :step] == levels[:, step, None], ranks[:, :step], np.iinfo(np.int64).max)
        for before in np.sort(taken, axis=1).T:
            ranks[:, step] += ranks[:, step] >= before
