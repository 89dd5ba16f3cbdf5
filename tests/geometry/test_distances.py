"""Distances of all pairs against least squares per pair."""

import numpy as np
import pytest
import torch
from subspace_cases import draw_subspaces, residual

from bench.codebook.examples import draw_features
from bench.geometry.distances import (
    find_mutual_nearest,
    find_mutual_nearest_points,
    points_to_points,
    subspaces_to_points,
    subspaces_to_subspaces,
)
from bench.geometry.nearest_words import unit_rows
from bench.types import Floats

D = 128


def descriptors(count: int, seed: int = 5) -> Floats:
    return unit_rows(draw_features(count, seed=seed).descriptors)


@pytest.mark.parametrize("dim", [1, 2, 4, 8])
def test_points_and_subspaces(rng: np.random.Generator, dim: int) -> None:
    release, points = draw_subspaces(rng, 7, dim), descriptors(9)
    expected = [[residual(release.bases[n].T, u - release.origins[n]) for u in points] for n in range(len(release))]
    found = subspaces_to_points(release, torch.from_numpy(points)).sqrt().numpy()
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize(("dim", "other"), [(2, 2), (4, 2), (8, 8)])
def test_two_subspaces(rng: np.random.Generator, dim: int, other: int) -> None:
    one, two = draw_subspaces(rng, 11, dim), draw_subspaces(rng, 600, other)
    found = subspaces_to_subspaces(one, two).sqrt().numpy()
    assert found.shape == (11, 600)
    for n in range(len(one)):
        for k in range(0, len(two), 37):
            columns = np.concatenate([one.bases[n], two.bases[k]]).T
            assert found[n, k] == pytest.approx(residual(columns, two.origins[k] - one.origins[n]), abs=1e-3)


def test_points() -> None:
    one, other = descriptors(6), descriptors(8, seed=6)
    expected = np.linalg.norm(one[:, None] - other[None], axis=2) ** 2
    np.testing.assert_allclose(points_to_points(torch.from_numpy(one), torch.from_numpy(other)).numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("ratio", [1.0, 0.8])
def test_mutually_nearest_against_loops(rng: np.random.Generator, ratio: float) -> None:
    squared = rng.integers(1, 200, (30, 40)).astype(np.float32)  # ties
    expected = []
    for row in range(30):
        column = min(range(40), key=lambda c: (squared[row, c], c))
        back = min(range(30), key=lambda r: (squared[r, column], r))
        second = sorted(squared[row])[1]
        if back == row and (ratio == 1 or np.sqrt(squared[row, column]) < ratio * np.sqrt(second)):
            expected.append((row, column))
    rows, columns = find_mutual_nearest(torch.from_numpy(squared), ratio)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == expected
    assert 0 < len(expected) < 30


def test_empty_and_single_distances() -> None:
    for shape in ((0, 3), (3, 0)):
        rows, columns = find_mutual_nearest(torch.zeros(shape))
        assert len(rows) == len(columns) == 0
    assert find_mutual_nearest(torch.ones(1, 1), 0.8)[0].tolist() == [0]  # one column has no second


def test_mutual_nearest_points_by_blocks_are_those_of_the_whole_matrix(rng: np.random.Generator) -> None:
    """Repeated points make ties, also across blocks; the ratio test rejects a row whose nearest occurs twice."""
    rows = rng.normal(size=(70, 16))
    one, other = (
        torch.from_numpy((each / np.linalg.norm(each, axis=1, keepdims=True)).astype(np.float32))
        for each in (np.concatenate([rows[:40], rows[:10]]), np.concatenate([rows[20:], rows[20:30]]))
    )
    for ratio in (1.0, 0.8):
        expected = find_mutual_nearest(points_to_points(one, other), ratio)
        for step in (7, 50):
            found = find_mutual_nearest_points(one, other, ratio, step)
            for mine, theirs in zip(found, expected, strict=True):
                np.testing.assert_array_equal(mine, theirs)
        assert 0 < len(expected[0]) < 40
    assert len(find_mutual_nearest_points(one[:0], other)[0]) == 0
