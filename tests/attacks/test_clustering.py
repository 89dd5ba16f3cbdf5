"""Clustering and intersection where the answer is known: few words, and releases of others that do or do not share them."""

import dataclasses

import numpy as np
import pytest
from fakes import trial

from attacks.clustering import Clustering, clustered
from attacks.intersection import Intersection
from bench.api import Asset, DescriptorAttack
from bench.codebook import dictionary
from bench.codebook.examples import example_features, small_dictionary
from bench.codebook.public import Public
from bench.tasks.reconstruction import view
from bench.types import Features, Subspaces
from defenses.affine import Affine

SECRET = example_features(40, seed=0)
NEAR = 20.0  # degrees


@pytest.fixture
def private(tmp_path) -> Asset:
    return small_dictionary(tmp_path, 400, seed=1)


@pytest.fixture
def public_words(tmp_path, private) -> Asset:
    """Z: words about the secret's descriptors and about those of W, none of them the same."""
    rng = np.random.default_rng(0)
    rows = np.concatenate([SECRET.codes, Public().dictionary(private).words]).astype(np.int64)
    about = np.concatenate([np.clip(rows + rng.integers(-6, 7, rows.shape), 0, 255) for _ in range(3)]).astype(np.uint8)
    dictionary.save(tmp_path / "Z.safetensors", about, {"photographs": []})
    return Asset(tmp_path / "Z.safetensors")


def strangers(database: Asset) -> list[Subspaces]:
    defense = Affine(dim=4, sub_databases=1, database=database)
    return [defense.protect(example_features(120, seed), Public(), np.random.default_rng(seed)) for seed in range(50, 60)]


def found(
    attack: DescriptorAttack, database: Asset, others: list[Subspaces], secret: Features = SECRET, seed: int = 0
) -> np.ndarray:
    """Whether each estimate is near its descriptor."""
    defense = Affine(dim=4, sub_databases=1, database=database)
    release = defense.protect(secret, Public(), np.random.default_rng(seed))
    seen = view(dataclasses.replace(trial(defense, secret, others=others).released(release), attack=attack))
    estimates = attack.recover(seen, np.random.default_rng(0))
    return (estimates * secret.descriptors).sum(axis=1) > np.cos(np.radians(NEAR))


def test_others_that_share_the_words_tell_the_descriptor(private, public_words):
    attack = Clustering(database=public_words, neighbours=9, coverage=1.0)
    assert found(attack, private, strangers(private)).mean() > 0.8


def test_clustering_is_at_chance_where_nobody_shares_a_word(private, public_words, tmp_path):
    """Negative control: each descriptor by itself, so that its own photograph has no other subspaces, and others of another W."""
    attack = Clustering(database=public_words, neighbours=9, coverage=1.0)
    others = strangers(small_dictionary(tmp_path, 400, seed=7))
    alone = [found(attack, private, others, SECRET.take(np.array([row])), row)[0] for row in range(len(SECRET))]
    assert 0.1 < np.mean(alone) < 0.6  # one of three


def test_intersection_needs_the_others(private, tmp_path):
    with_others = found(Intersection(neighbours=50, coverage=1.0), private, strangers(private))
    of_another = found(Intersection(neighbours=50, coverage=1.0), private, strangers(small_dictionary(tmp_path, 400, seed=7)))
    assert with_others.mean() >= of_another.mean()


def test_every_cluster_has_a_member(rng):
    rows = rng.normal(size=(5, 30, 16))
    labels = clustered((rows / np.linalg.norm(rows, axis=2, keepdims=True)).astype(np.float32), 4)
    assert all(set(row) == {0, 1, 2, 3} for row in labels.tolist())
