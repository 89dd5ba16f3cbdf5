"""The exact search for the nearest word, against brute force in float64 and against faiss."""

import os
import subprocess
import sys
import timeit
import tracemalloc

import faiss
import numpy as np
import pytest
import torch
from floor import build_bare_product, build_byte_product

from bench.core.device import has_byte_products
from bench.geometry import byte_search, nearest_words
from bench.geometry.nearest_words import WordIndex, unit_rows

in_both = pytest.mark.parametrize("bytewise", [True, False], ids=["bytes", "floats"], indirect=True)


@pytest.fixture
def bytewise(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Search in 8-bit integers, or not, whatever this machine does fast."""
    if request.param and not byte_search.is_exact(128):
        pytest.skip("products of 8-bit integers saturate here")
    monkeypatch.setattr(byte_search, "suits", lambda words: request.param and words.dtype == np.uint8)


def nearest_rows(queries: np.ndarray, words: np.ndarray) -> np.ndarray:
    return WordIndex(words).find_nearest(queries)


def brute_force(queries: np.ndarray, words: np.ndarray) -> np.ndarray:
    rows = words.astype(np.float64)
    return (queries.astype(np.float64) @ (rows / np.linalg.norm(rows, axis=1, keepdims=True)).T).argmax(axis=1)


@pytest.fixture
def words(rng):
    return rng.integers(0, 200, (5000, 128), dtype=np.uint8)


@in_both
def test_agrees_with_brute_force(rng, words, bytewise):
    for queries, searched in (
        (rng.integers(0, 200, (700, 128), dtype=np.uint8), words),
        (rng.integers(0, 256, (300, 128), dtype=np.uint8), rng.integers(0, 256, (3000, 128), dtype=np.uint8)),
    ):
        assert np.array_equal(nearest_rows(queries, searched), brute_force(queries, searched))


def test_agrees_with_faiss_on_floats(rng, words):
    queries = np.abs(rng.normal(size=(300, 128))).astype(np.float32)
    index = faiss.IndexFlatIP(128)
    index.add(unit_rows(words))
    assert (nearest_rows(queries, words) == index.search(unit_rows(queries), 1)[1][:, 0]).mean() > 0.99  # float32's ties aside


@pytest.mark.slow
@in_both
def test_words_that_bf16_cannot_distinguish(rng, bytewise):
    """The words differ by one step in one component, so only an exact comparison finds the right one."""
    base = rng.integers(100, 156, 128, dtype=np.uint8)
    words = np.repeat(base[None], 4096, axis=0)
    words[np.arange(4096), rng.integers(128, size=4096)] += rng.integers(1, 3, 4096, dtype=np.uint8)
    queries = words[rng.integers(4096, size=200)]
    assert np.array_equal(nearest_rows(queries, words), brute_force(queries, words))


@pytest.mark.slow
@pytest.mark.parametrize("bytewise", [False], indirect=True)
def test_without_a_margin_it_would_be_wrong(rng, monkeypatch, bytewise):
    """Negative control of the tests above: the first pass alone does not decide."""
    base = rng.integers(0, 120, 128)
    words, queries = (
        np.clip(base + rng.integers(-60, 61, (count, 128)), 0, 255).astype(np.uint8) for count in (3 * nearest_words.BLOCK, 4000)
    )
    assert np.array_equal(nearest_rows(queries, words), brute_force(queries, words))
    monkeypatch.setattr(nearest_words, "margin", lambda best, errors, dtype: torch.zeros_like(best))
    monkeypatch.setattr(nearest_words, "pick_dtype", lambda device: torch.bfloat16)
    assert not np.array_equal(nearest_rows(queries, words), brute_force(queries, words))


@in_both
def test_words_of_any_norm(rng, words, bytewise):
    """Control for integers: without the norms, long words win."""
    scaled = np.maximum(words * rng.uniform(0.02, 1, (len(words), 1)), 1).astype(np.uint8)
    queries = np.concatenate([scaled[::9], rng.integers(0, 200, (300, 128), dtype=np.uint8)])
    index, expected = WordIndex(scaled), brute_force(queries, scaled)
    assert np.array_equal(index.find_nearest(queries), expected)
    if index._bytes is not None:
        index._bytes._limits[:] = index._bytes._inverse[:] = 1
        assert not np.array_equal(index.find_nearest(queries), expected)


@pytest.mark.slow
def test_products_that_saturate_are_not_used():
    """The library may be kept from the instructions that the processor has. Control: its products are wrong then."""
    code = (
        "import numpy as np, torch\n"
        "from bench.core.device import has_byte_products\n"
        "from bench.geometry import byte_search\n"
        "from bench.geometry.nearest_words import WordIndex\n"
        "rng = np.random.default_rng(0)\n"
        "queries, words = (rng.integers(0, 256, (count, 128), dtype=np.uint8) for count in (300, 3000))\n"
        "units = words / np.linalg.norm(words.astype(float), axis=1, keepdims=True)\n"
        "exact = (queries.astype(float) @ units.T).argmax(axis=1)\n"
        "print((WordIndex(words).find_nearest(queries) == exact).all(), byte_search.is_exact(128))\n"
        "byte_search.suits = lambda words: True\n"
        "print((WordIndex(words).find_nearest(queries) == exact).all())\n"
    )
    environment = os.environ | {"ONEDNN_MAX_CPU_ISA": "AVX2"}
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert ended.stdout.split() in (["True", "False", "False"], ["True", "True", "True"])


@pytest.mark.parametrize("bytewise", [True], indirect=True, ids=["bytes"])
def test_without_its_slack_the_search_in_bytes_loses_ties(monkeypatch, bytewise):
    """Negative control: all words have one direction, and float32 rounds their quotients differently."""
    base = np.random.default_rng(0).integers(0, 11, (1, 128)).astype(np.uint8)
    words = base * np.arange(25, 0, -1, dtype=np.uint8)[:, None]
    assert nearest_rows(base, words).tolist() == [0]
    monkeypatch.setattr(byte_search, "SLACK", 0.0)
    with pytest.raises(ValueError, match="shape"):  # no candidate is left
        nearest_rows(base, words)


@in_both
def test_zero_queries_get_the_first_word(words, bytewise):
    queries = np.zeros((3000, 128), np.uint8)
    queries[1500] = words[7]
    found = nearest_rows(queries, words)
    assert found[1500] == 7
    assert not np.delete(found, 1500).any()


@in_both
def test_extreme_components(bytewise):
    words = np.array([[255] * 128, [0] * 127 + [255], [0] * 127 + [1], [255] * 127 + [0]], dtype=np.uint8)
    assert nearest_rows(words, words).tolist() == [0, 1, 1, 3]


@in_both
def test_ties_go_to_the_lowest_index(words, bytewise):
    doubled = np.concatenate([words, words])  # each word occurs twice, in different blocks
    found = nearest_rows(words[:300], doubled)
    assert (found < len(words)).all()


@in_both
def test_a_longer_multiple_is_the_same_direction(bytewise):
    words = np.zeros((3, 128), dtype=np.uint8)
    words[0, 0], words[1, 1], words[2, 0] = 10, 10, 250
    query = np.zeros((1, 128))
    query[0, 0] = 3.5
    assert nearest_rows(query.astype(np.float32), words)[0] == nearest_rows(query.astype(np.uint8), words)[0] == 0


@in_both
def test_memory_of_building_does_not_grow_with_the_words(bytewise):
    words = np.ones((50_000, 128), dtype=np.uint8)
    tracemalloc.start()
    WordIndex(words)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < words.nbytes * 2  # all words in float64 at once would be eight times theirs


@in_both
def test_no_queries(words, bytewise):
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
@pytest.mark.skipif(not has_byte_products(), reason="8-bit products are slow here")
def test_speed_of_the_bare_product_in_bytes(benchmark, many):
    queries, words = many
    benchmark(build_byte_product(len(queries), words))


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
