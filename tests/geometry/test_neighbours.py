"""Neighbours of words against sorting all words."""

import numpy as np
import pytest
import torch

from bench.codebook.examples import draw_features
from bench.geometry import neighbours
from bench.geometry.neighbours import Neighbours


def words(count: int = 300) -> np.ndarray:
    codes = draw_features(count, 3).codes
    assert codes is not None
    codes[7] = codes[40]  # the same direction twice, and thrice
    codes[91] = codes[40] // 2 * 2
    codes[40] = codes[91]
    codes[91] = codes[91] // 2
    return codes


def cosines(codes: np.ndarray) -> np.ndarray:
    unit = codes.astype(np.float64)
    return (unit @ unit.T) / np.sqrt((unit**2).sum(1)[:, None] * (unit**2).sum(1))


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbours, "BLOCK", 64)
    monkeypatch.setattr(neighbours, "BATCH", 50)


@pytest.mark.parametrize("count", [1, 2, 7, 100, 300])
def test_nearest_against_sorting(count: int) -> None:
    codes = words()
    table = cosines(codes)
    np.fill_diagonal(table, 2)
    expected = np.sort(np.argsort(-table, axis=1, kind="stable")[:, :count], axis=1)
    near = Neighbours(codes)
    queries = np.random.default_rng(0).integers(300, size=400)
    np.testing.assert_array_equal(near.find_nearest(queries, count), expected[queries])
    np.testing.assert_array_equal(near.find_nearest(np.arange(300), count), expected)  # some of them cached
    assert (expected == np.arange(300)[:, None]).any(axis=1).all()


@pytest.mark.parametrize("group", [1, 4, 64])
def test_nearest_of_words_that_float32_cannot_order(monkeypatch: pytest.MonkeyPatch, group: int) -> None:
    """Signed words of large norm in nearly the same direction. Control: if scores excluded too much, words would be missing."""
    rng = np.random.default_rng(0)
    codes = rng.integers(-300, 300, size=128)[None] + rng.integers(-1, 2, size=(400, 128))
    codes = np.concatenate([codes, -codes[:100]]).astype(np.int16)
    table = cosines(codes)
    np.fill_diagonal(table, 2)
    expected = np.sort(np.argsort(-table, axis=1, kind="stable")[:, :9], axis=1)
    monkeypatch.setattr(neighbours, "GROUP", group)
    np.testing.assert_array_equal(Neighbours(codes).find_nearest(np.arange(500), 9), expected)
    if group > 1:
        return  # the bound from groups leaves room
    monkeypatch.setattr(neighbours, "SLACK", -1e-6)
    with pytest.raises((AssertionError, IndexError)):
        np.testing.assert_array_equal(Neighbours(codes).find_nearest(np.arange(500), 9), expected)


def test_levels_and_words_by_rank() -> None:
    codes, borders = words(), np.array([0.2, 0.4, 0.5, 1 - 1e-9])  # 0.5 is an end of an interval of `_Levels`
    levels = (cosines(codes)[:, :, None] >= borders).sum(axis=2)  # (K, K)
    near, queries = Neighbours(codes), np.random.default_rng(1).integers(300, size=120)
    counts = near.count_levels(queries, borders)
    assert counts.shape == (120, 5, 5)
    expected = np.stack([(levels[queries] == level).sum(axis=1) for level in range(5)], axis=1)
    np.testing.assert_array_equal(counts.sum(axis=1), expected)
    for level in range(5):
        rows = np.flatnonzero(expected[:, level])
        ranks = np.random.default_rng(2).integers(expected[rows, level])
        found = near.select_words(queries[rows], borders, counts[rows], np.full(len(rows), level), ranks)
        for row, rank, word in zip(rows, ranks, found, strict=True):
            assert np.flatnonzero(levels[queries[row]] == level)[rank] == word


@pytest.mark.parametrize("intervals", [4, 1024])
def test_levels_by_table_are_those_of_comparisons(monkeypatch: pytest.MonkeyPatch, intervals: int) -> None:
    monkeypatch.setattr(neighbours, "INTERVALS", intervals)
    borders = np.array([-0.75, -1e-9, 0.0, 0.25, 0.3, 0.3 + 1e-15, 1 - 1e-9])
    edges = np.concatenate([borders, np.linspace(-1, 1, 9), [1 + 1e-12]])
    cosines = np.concatenate(
        [edges, np.nextafter(edges, -2), np.nextafter(edges, 2), np.random.default_rng(0).uniform(-1, 1, 500)]
    )
    levels = neighbours._Levels(borders, torch.device("cpu")).find(torch.from_numpy(cosines)[None])
    np.testing.assert_array_equal(levels[0].numpy(), (cosines[:, None] >= borders).sum(axis=1))


def test_results_do_not_depend_on_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """The result for two words is a function of these words alone."""
    codes, borders = words(), np.linspace(0.1, 0.9, 30)
    near = Neighbours(codes)
    batched = near.count_levels(np.arange(300), borders)
    monkeypatch.setattr(neighbours, "CACHE_LIMIT", 0)
    alone = np.concatenate([near.count_levels(np.array([word]), borders) for word in range(0, 300, 17)])
    np.testing.assert_array_equal(alone, batched[::17])
