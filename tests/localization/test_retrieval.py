"""Retrieval by bags of words, against sums over words."""

import math
from collections import Counter

import numpy as np
import pytest

from bench.localization.retrieval import Bags

BAGS = [[0, 0, 1, 5], [1, 2, 5], [3, 3, 3, 5], [5], [0, 1, 2, 5]]


@pytest.fixture
def bags() -> Bags:
    starts = np.cumsum([0, *map(len, BAGS)])
    return Bags(words=np.concatenate(BAGS), starts=starts, size=7)


def score(query: list[int], bag: list[int]) -> float:
    """Return the cosine of tf-idf vectors, times the norm of the query."""

    def weight(word: int) -> float:
        frequency = sum(word in other for other in BAGS)
        return math.log(len(BAGS) / frequency) if frequency else 0.0

    mine, theirs = ({word: count * weight(word) for word, count in Counter(words).items()} for words in (query, bag))
    norm = math.sqrt(sum(value**2 for value in theirs.values())) or 1.0
    return sum(mine[word] * theirs.get(word, 0.0) for word in mine) / norm


@pytest.mark.parametrize("query", [[0], [3, 3, 1], [1, 2, 2, 0, 5], [6], [4, 5]])
def test_ranking_against_sums(bags: Bags, query: list[int]) -> None:
    expected = sorted(range(len(BAGS)), key=lambda bag: (-round(score(query, BAGS[bag]), 12), bag))
    assert bags.rank(np.array(query)).tolist() == expected
    assert bags.rank(np.array(query), 2).tolist() == expected[:2]


def test_sets_of_words_count_each_word(bags: Bags) -> None:
    assert bags.rank(np.array([[3, 1], [3, 5]])).tolist() == bags.rank(np.array([1, 3, 3, 5])).tolist()
