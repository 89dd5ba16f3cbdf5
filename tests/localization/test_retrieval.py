"""Bags of words against sums over words, and hloc's files."""

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from bench.core.errors import UserError
from bench.localization import pairs
from bench.localization.retrieval import Bags

BAGS = [[0, 0, 1, 5], [1, 2, 5], [3, 3, 3, 5], [5], [0, 1, 2, 5]]


@pytest.fixture
def bags() -> Bags:
    starts = np.cumsum([0, *map(len, BAGS)])
    return Bags(words=np.concatenate(BAGS), starts=starts, size=7)


def score(query: list[int], bag: list[int]) -> float:
    """tf-idf's cosine, but for the query's norm."""

    def weight(word: int) -> float:
        seen = sum(word in other for other in BAGS)
        return math.log(len(BAGS) / seen) if seen else 0.0

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


def test_pairs_are_read_as_written(tmp_path: Path) -> None:
    retrieved = {"query/day/b.png": ["db/2.png", "db/1.png"], "query/a.png": ["db/1.png"]}
    path = tmp_path / "new" / "pairs.txt"
    pairs.write(path, retrieved)
    assert path.read_text() == "query/day/b.png db/2.png\nquery/day/b.png db/1.png\nquery/a.png db/1.png\n"
    assert pairs.read(path) == retrieved


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a b\n\na\n", "pairs.txt:3: expected 'query reference', but there are 1 fields"),
        ("a b\na c d\n", "pairs.txt:2: expected 'query reference', but there are 3 fields"),
        ("a b\nc b\na b\n", "pairs.txt:3: a b stands here for the second time"),
        ("# nothing\n", "pairs.txt: nothing in it"),
    ],
)
def test_damaged_pairs_are_refused_by_line(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text(text)
    with pytest.raises(UserError, match=complaint):
        pairs.read(path)


def test_missing_pairs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"pairs\.txt: no such file"):
        pairs.read(tmp_path / "pairs.txt")
