"""Words near to words, against sorting all of them."""

import numpy as np
import pytest

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
    asked = np.random.default_rng(0).integers(300, size=400)
    np.testing.assert_array_equal(near.find_nearest(asked, count), expected[asked])
    np.testing.assert_array_equal(near.find_nearest(np.arange(300), count), expected)  # some of them remembered
    assert (expected == np.arange(300)[:, None]).any(axis=1).all()


def test_levels_and_what_stands_where() -> None:
    codes, borders = words(), np.array([0.2, 0.4, 0.5, 1 - 1e-9])
    levels = (cosines(codes)[:, :, None] >= borders).sum(axis=2)  # (K, K)
    near, asked = Neighbours(codes), np.random.default_rng(1).integers(300, size=120)
    counted = near.count_levels(asked, borders)
    assert counted.shape == (120, 5, 5)
    expected = np.stack([(levels[asked] == level).sum(axis=1) for level in range(5)], axis=1)
    np.testing.assert_array_equal(counted.sum(axis=1), expected)
    for level in range(5):
        rows = np.flatnonzero(expected[:, level])
        places = np.random.default_rng(2).integers(expected[rows, level])
        found = near.select_words(asked[rows], borders, counted[rows], np.full(len(rows), level), places)
        for row, place, word in zip(rows, places, found, strict=True):
            assert np.flatnonzero(levels[asked[row]] == level)[place] == word


def test_a_word_is_looked_at_alone_as_among_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is found is a function of two words, not of a batch."""
    codes, borders = words(), np.linspace(0.1, 0.9, 30)
    near = Neighbours(codes)
    together = near.count_levels(np.arange(300), borders)
    monkeypatch.setattr(neighbours, "CACHE_LIMIT", 0)
    alone = np.concatenate([near.count_levels(np.array([word]), borders) for word in range(0, 300, 17)])
    np.testing.assert_array_equal(alone, together[::17])
