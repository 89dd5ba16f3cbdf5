"""The nearest attack, against distances in float64 by least squares."""

import numpy as np
import pytest

from attacks.nearest import Nearest
from bench.features import dictionary
from bench.features.sift import Sift
from bench.kernels.search import unit_rows
from bench.kernels.subspaces import nearest_to_subspaces
from bench.plugin import Asset, View
from bench.public import Public
from bench.types import Features, Knowledge, Subspaces
from defenses.affine import Affine


def distances(release: Subspaces, words: np.ndarray) -> np.ndarray:
    """dist(D, w) by solving for the coordinates. -> (N, K)"""
    found = []
    for origin, basis in zip(release.origins.astype(float), release.bases.astype(float), strict=True):
        offsets = (words.astype(float) - origin).T  # (D, K)
        coordinates = np.linalg.lstsq(basis.T, offsets, rcond=None)[0]
        found.append(np.linalg.norm(offsets - basis.T @ coordinates, axis=0))
    return np.array(found)


@pytest.fixture
def words(rng):
    return rng.integers(0, 200, (3000, 128), dtype=np.uint8)


@pytest.fixture
def release(rng, words, tmp_path):
    """Lifted through a database of other words."""
    private = tmp_path / "W.safetensors"
    dictionary.save(private, rng.integers(0, 200, (640, 128), dtype=np.uint8), {"photographs": []})
    codes = rng.integers(0, 200, (40, 128), dtype=np.uint8)
    secret = Features(keypoints=np.zeros((40, 2), np.float32), descriptors=unit_rows(codes), codes=codes, size=(256, 256))
    return Affine(dim=6, database=Asset(private)).protect(secret, Public(), rng)


def test_agrees_with_least_squares(release, words):
    found, distance = nearest_to_subspaces(release, unit_rows(words))
    expected = distances(release, unit_rows(words))
    assert np.array_equal(found, expected.argmin(axis=1))
    np.testing.assert_allclose(distance, expected.min(axis=1), atol=1e-5)


def test_ties_go_to_the_lowest_index(release, words):
    rows = unit_rows(words)
    assert (nearest_to_subspaces(release, np.concatenate([rows, rows]))[0] < len(rows)).all()


def test_fewer_words_than_the_shortlist(release, words):
    found, _ = nearest_to_subspaces(release, unit_rows(words[:2]))
    assert np.array_equal(found, distances(release, unit_rows(words[:2])).argmin(axis=1))


def test_returns_words_of_the_public_database(release, words, tmp_path, rng):
    public = dictionary.save(tmp_path / "Z.safetensors", words, {"photographs": []})
    view = View(
        release=release,
        defense=Affine(dim=6),
        extractor=Sift(),
        knowledge={Knowledge.PUBLIC_DATABASE: lambda: public},
    )
    found = Nearest().recover(view, rng)
    assert found.dtype == np.float32
    assert np.array_equal(found, unit_rows(words)[nearest_to_subspaces(release, unit_rows(words))[0]])


def test_in_the_defenses_own_database_it_finds_an_adversary(rng, tmp_path):
    """Why the attack uses Z: in W the nearest word is one that the defense put there, at distance zero."""
    private = tmp_path / "W.safetensors"
    words = dictionary.save(private, rng.integers(0, 200, (640, 128), dtype=np.uint8), {"photographs": []}).words
    codes = rng.integers(0, 200, (40, 128), dtype=np.uint8)
    secret = Features(keypoints=np.zeros((40, 2), np.float32), descriptors=unit_rows(codes), codes=codes, size=(256, 256))
    release = Affine(dim=6, database=Asset(private)).protect(secret, Public(), rng)
    _, distance = nearest_to_subspaces(release, unit_rows(words))
    assert (distance < 1e-5).all()
