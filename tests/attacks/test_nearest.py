"""The nearest attack."""

import numpy as np
import pytest

from attacks.nearest import Nearest
from bench.api import View
from bench.codebook import dictionary
from bench.codebook.public import Public
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import find_nearest_to_subspaces
from bench.settings import Asset
from bench.threat_model import PublicDatabase
from bench.types import Features
from defenses.affine import Affine


@pytest.fixture
def words(rng):
    return rng.integers(0, 200, (3000, 128), dtype=np.uint8)


@pytest.fixture
def release(rng, words, tmp_path):
    """Subspaces lifted through a database of other words."""
    private = tmp_path / "W.safetensors"
    dictionary.save(private, rng.integers(0, 200, (640, 128), dtype=np.uint8), {"photographs": []})
    codes = rng.integers(0, 200, (40, 128), dtype=np.uint8)
    secret = Features(keypoints=np.zeros((40, 2), np.float32), descriptors=unit_rows(codes), codes=codes, size=(256, 256))
    return Affine(dim=6, database=Asset(private)).protect(secret, Public(), rng)


def test_returns_words_of_the_public_database(release, words, tmp_path, rng):
    public = dictionary.save(tmp_path / "Z.safetensors", words, {"photographs": []})
    view = View(
        release=release,
        defense=Affine(dim=6),
        extractor=Sift(),
        knowledge={PublicDatabase: lambda: PublicDatabase(words=public.words)},
    )
    found = Nearest().recover(view, rng)
    assert found.dtype == np.float32
    assert np.array_equal(found, unit_rows(words)[find_nearest_to_subspaces(release, words)[0][:, 0]])


def test_in_the_defenses_own_database_it_finds_an_adversary(rng, tmp_path):
    """In W the nearest word is an adversarial one at distance zero, so the attack needs Z."""
    private = tmp_path / "W.safetensors"
    words = dictionary.save(private, rng.integers(0, 200, (640, 128), dtype=np.uint8), {"photographs": []}).words
    codes = rng.integers(0, 200, (40, 128), dtype=np.uint8)
    secret = Features(keypoints=np.zeros((40, 2), np.float32), descriptors=unit_rows(codes), codes=codes, size=(256, 256))
    release = Affine(dim=6, database=Asset(private)).protect(secret, Public(), rng)
    _, distance = find_nearest_to_subspaces(release, words)
    assert (distance < 1e-5).all()
