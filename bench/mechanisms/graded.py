"""Words drawn with weights that depend on how much each is like the true one, in a few levels, exactly.

The words of a level are as likely as each other, so a draw is one of a level, with chances that `bench.mechanisms.classes` compares
bit by bit, and then one of a whole number. Weights e^(ε u) added to noise in floating point (Gumbel's, say) have neither the
chances of the theorem nor the same set of numbers for each input, and low bits of such sums tell the input (Mironov, CCS 2012).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from bench.geometry.neighbours import Doubles, Neighbours
from bench.mechanisms.classes import draw_classes
from bench.types import Indices


def graded_words(
    neighbours: Neighbours, true: Indices, borders: Doubles, powers: Sequence[Fraction], size: int, rng: np.random.Generator
) -> Indices:
    """Draw words one after the other, each from those that are left, with chances in proportion to e^power.

    Parameters
    ----------
    true : (N,) words
    borders : (L,) cosines, ascending; the level of a word is how many of them its cosine with the true one reaches
    powers : L + 1 of them, one for each level
    size : m, at most |K|

    Returns
    -------
    (N, m) words, rows ascending: which was drawn first is not told
    """
    distinct, which = np.unique(true, return_inverse=True)
    counted = neighbours.levels(distinct, borders)  # (P, blocks, L + 1)
    left = counted.sum(axis=1)[which]  # (N, L + 1)
    rows = np.arange(len(true))
    levels, places = (np.empty((len(true), size), dtype=np.int64) for _ in range(2))
    for step in range(size):
        profiles, alike = np.unique(left, axis=0, return_inverse=True)
        levels[:, step] = draw_classes(profiles.tolist(), powers, alike.ravel(), rng)
        places[:, step] = rng.integers(left[rows, levels[:, step]])
        left[rows, levels[:, step]] -= 1
    _among_all(levels, places)
    words = [neighbours.at(true, borders, counted[which], levels[:, step], places[:, step]) for step in range(size)]
    return np.sort(np.stack(words, axis=1), axis=1)


def _among_all(levels: Indices, places: Indices) -> None:
    """Turn places among the words that were left of a level into places among all of its words. (N, m), (N, m), in place"""
    for step in range(1, places.shape[1]):
        taken = np.where(levels[:, :step] == levels[:, step, None], places[:, :step], np.iinfo(np.int64).max)
        for before in np.sort(taken, axis=1).T:
            places[:, step] += places[:, step] >= before
