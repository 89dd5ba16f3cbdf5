"""The exact search for the nearest word, against brute force in float64 and against faiss."""

import timeit
import tracemalloc

import faiss
import numpy as np
import pytest
import torch
from floor import build_bare_product

from bench.geometry import nearest_words
from bench.geometry.nearest_words import WordIndex, unit_rows


def nearest_rows(queries: np.ndarray, words: np.ndarray) -> np.ndarray:
    return WordIndex(words).find_nearest(queries)


def brute_force(queries: np.ndarray, words: np.ndarray) -> np.ndarray:
    rows = words.astype(np.float64)
    return (queries.astype(np.float64) @ (rows / np.linalg.norm(rows, axis=1, keepdims=True)).T).argmax(axis=1)


@pytest.fixture
def words(rng):
    return rng.integers(0, 200, (5000, 128), dtype=np.uint8)


def test_agrees_with_brute_force(rng, words):
    queries = rng.integers(0, 200, (700, 128), dtype=np.uint8)
    assert np.array_equal(nearest_rows(queries, words), brute_force(queries, words))


def test_agrees_with_faiss_on_floats(rng, words):
    queries = np.abs(rng.normal(size=(300, 128))).astype(np.float32)
    index = faiss.IndexFlatIP(128)
    index.add(unit_rows(words))
    assert (nearest_rows(queries, words) == index.search(unit_rows(queries), 1)[1][:, 0]).mean() > 0.99  # float32's ties aside


@pytest.mark.slow
def test_words_that_bf16_cannot_distinguish(rng):
    """The words differ by one step in one component, so only an exact comparison finds the right one."""
    base = rng.integers(100, 156, 128, dtype=np.uint8)
    words = np.repeat(base[None], 4096, axis=0)
    words[np.arange(4096), rng.integers(128, size=4096)] += rng.integers(1, 3, 4096, dtype=np.uint8)
    queries = words[rng.integers(4096, size=200)]
    assert np.array_equal(nearest_rows(queries, words), brute_force(queries, words))


@pytest.mark.slow
def test_without_a_margin_it_would_be_wrong(rng, monkeypatch):
    """Negative control of the tests above: the first pass alone does not decide."""
    base = rng.integers(0, 120, 128)
    words, queries = (
        np.clip(base + rng.integers(-60, 61, (count, 128)), 0, 255).astype(np.uint8) for count in (3 * nearest_words.BLOCK, 4000)
    )
    assert np.array_equal(nearest_rows(queries, words), brute_force(queries, words))
    monkeypatch.setattr(nearest_words, "margin", lambda best, errors, dtype: torch.zeros_like(best))
    monkeypatch.setattr(nearest_words, "pick_dtype", lambda device: torch.bfloat16)
    assert not np.array_equal(nearest_rows(queries, words), brute_force(queries, words))


def test_ties_go_to_the_lowest_index(words):
    doubled = np.concatenate([words, words])  # each word occurs twice, in different blocks
    found = nearest_rows(words[:300], doubled)
    assert (found < len(words)).all()


def test_a_longer_multiple_is_the_same_direction():
    words = np.zeros((3, 128), dtype=np.uint8)
    words[0, 0], words[1, 1], words[2, 0] = 10, 10, 250
    query = np.zeros((1, 128), dtype=np.float32)
    query[0, 0] = 3.5
    assert nearest_rows(query, words)[0] == 0


def test_memory_of_building_does_not_grow_with_the_words():
    words = np.ones((50_000, 128), dtype=np.uint8)
    tracemalloc.start()
    WordIndex(words)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < words.nbytes * 2  # all words in float64 at once would be eight times theirs


def test_no_queries(words):
    assert nearest_rows(np.empty((0, 128), np.uint8), words).shape == (0,)


# ---- speed: 2·N·K·D operations

speed = pytest.mark.benchmark(group="nearest word")


@pytest.fixture
def many(rng):
    """Queries and words."""
    return rng.integers(0, 200, (700, 128), dtype=np.uint8), rng.integers(0, 200, (65_536, 128), dtype=np.uint8)


def flat(words: np.ndarray) -> faiss.IndexFlatIP:
    index = faiss.IndexFlatIP(words.shape[1])
    index.add(unit_rows(words))
    return index


@speed
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["float32", "bf16"])
def test_speed_of_the_bare_product(benchmark, many, dtype):
    queries, words = many
    benchmark(build_bare_product(len(queries), words, dtype))


@speed
def test_speed_of_faiss_flat(benchmark, many):
    queries, words = many
    benchmark(flat(words).search, unit_rows(queries), 1)


@speed
def test_speed_of_the_search(benchmark, many):
    queries, words = many
    benchmark(WordIndex(words).find_nearest, queries)
    index, rows = flat(words), unit_rows(queries)
    assert benchmark.stats.stats.min < min(timeit.repeat(lambda: index.search(rows, 1), number=1, repeat=5))
