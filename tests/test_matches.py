"""Matches between two sets of keypoints, against SciPy, least squares, and enumeration."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from bench.errors import UserError
from bench.kernels.matches import distances_between, mutual_nearest, point_distances, sharing_words, subspace_distances
from bench.kernels.search import unit_rows
from bench.types import Subspaces

CLOSE = {"rtol": 1e-4, "atol": 2e-3}  # float32 roots near zero


def rows(rng, count, length=24):
    return unit_rows(rng.normal(size=(count, length)).astype(np.float32))


def subspaces(rng, count, dim, length=24):
    bases = np.linalg.qr(rng.normal(size=(count, length, dim)))[0].transpose(0, 2, 1).astype(np.float32)
    keypoints = np.zeros((count, 2), np.float32)
    return Subspaces(keypoints=keypoints, size=(8, 8), origins=rows(rng, count, length), bases=bases)


def residual(between, directions):
    """How much of a vector no combination of rows makes up."""
    between, directions = between.astype(float), directions.astype(float)
    return np.linalg.norm(between - directions.T @ np.linalg.lstsq(directions.T, between, rcond=None)[0])


def test_distances_of_points_are_scipy_s(rng):
    one, other = rows(rng, 30), rows(rng, 20)
    np.testing.assert_allclose(point_distances(one, other), cdist(one, other), **CLOSE)


def test_rows_are_computed_in_chunks(rng, monkeypatch):
    one, other = rows(rng, 30), rows(rng, 20)
    monkeypatch.setattr("bench.kernels.matches.CHUNK", 7)
    np.testing.assert_allclose(point_distances(one, other), cdist(one, other), **CLOSE)


def test_distances_from_points_to_subspaces_are_those_of_least_squares(rng):
    points, release = rows(rng, 9), subspaces(rng, 7, 4)
    points[0] = release.origins[3] + 0.5 * release.bases[3, 1]
    expected = [[residual(point - release.origins[j], release.bases[j]) for j in range(7)] for point in points]
    found = subspace_distances(points, release)
    np.testing.assert_allclose(found, expected, **CLOSE)
    assert found[0, 3] == pytest.approx(0, abs=2e-3)


@pytest.mark.parametrize("dims", [(3, 3), (2, 5), (5, 2), (1, 4)])
def test_distances_between_subspaces_are_those_of_least_squares(rng, dims):
    one, other = subspaces(rng, 11, dims[0]), subspaces(rng, 9, dims[1])
    expected = [
        [residual(one.origins[i] - other.origins[j], np.concatenate([one.bases[i], other.bases[j]])) for j in range(9)]
        for i in range(11)
    ]
    np.testing.assert_allclose(distances_between(one, other), expected, **CLOSE)


def test_subspaces_that_always_meet_are_refused(rng):
    with pytest.raises(UserError, match="always meet"):
        distances_between(subspaces(rng, 2, 12), subspaces(rng, 2, 12))


@pytest.mark.parametrize("ratio", [1.0, 0.9])
@pytest.mark.parametrize("farthest", [np.inf, 0.8])
def test_mutual_nearest_by_enumeration(rng, ratio, farthest):
    distances = rng.random((40, 30)).astype(np.float32)
    expected = []
    for i, j in np.ndindex(distances.shape):
        row, column = np.delete(distances[i], j), np.delete(distances[:, j], i)
        if distances[i, j] < ratio * min(row.min(), column.min()) and distances[i, j] <= farthest:
            expected.append((i, j))
    assert mutual_nearest(distances, ratio, farthest).tolist() == [list(pair) for pair in expected]
    assert expected


def test_mutual_nearest_where_there_is_little():
    assert mutual_nearest(np.zeros((0, 3), np.float32)).shape == (0, 2)
    assert mutual_nearest(np.zeros((2, 0), np.float32)).shape == (0, 2)
    assert mutual_nearest(np.ones((1, 1), np.float32), ratio=0.8).tolist() == [[0, 0]]
    assert mutual_nearest(np.zeros((2, 2), np.float32)).tolist() == [[0, 0]]  # of equals the first
    assert mutual_nearest(np.zeros((2, 2), np.float32), ratio=0.8).tolist() == []


@pytest.mark.parametrize("unique", [False, True])
def test_sharing_words_by_enumeration(rng, unique):
    first, second = (np.stack([rng.choice(60, 3, replace=False) for _ in range(count)]) for count in (15, 12))
    counts = [np.bincount(words.ravel(), minlength=60) for words in (first, second)]
    good = (counts[0] == 1) & (counts[1] == 1) if unique else np.ones(60, bool)
    expected = [
        [i, j]
        for i in range(15)
        for j in range(12)
        if any(good[word] for word in set(first[i].tolist()) & set(second[j].tolist()))
    ]
    assert sharing_words(first, second, unique).tolist() == expected
    assert 0 < len(expected) < 15 * 12


def test_sharing_words_where_there_is_little():
    none = np.empty((0, 3), dtype=np.int64)
    some = np.array([[1, 2, 3], [1, 4, 5]])
    assert sharing_words(none, some).shape == sharing_words(some, none).shape == (0, 2)
    assert sharing_words(some, some + 10).shape == (0, 2)
    assert sharing_words(some, some, unique=True).tolist() == [[0, 0], [1, 1]]
    assert sharing_words(some, some).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]
