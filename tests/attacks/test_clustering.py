"""The clustering and the intersection attack with known answers: few words, and other releases with or without them."""

import dataclasses

import numpy as np
import pytest
from fakes import build_trial

from attacks.clustering import Clustering, cluster
from attacks.intersection import Intersection
from bench.api import DescriptorAttack
from bench.codebook import dictionary
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.settings import Asset
from bench.tasks.reconstruction import build_view
from bench.types import Features, Subspaces
from defenses.affine import Affine

SECRET = draw_features(40, seed=0)
NEAR = 20.0  # degrees


@pytest.fixture
def private(tmp_path) -> Asset:
    return write_dictionary(tmp_path, 400, seed=1)


@pytest.fixture
def public_words(tmp_path, private) -> Asset:
    """Z: words near the descriptors and near the words of W, but not equal to them."""
    rng = np.random.default_rng(0)
    rows = np.concatenate([SECRET.codes, Public().dictionary(private).words]).astype(np.int64)
    about = np.concatenate([np.clip(rows + rng.integers(-6, 7, rows.shape), 0, 255) for _ in range(3)]).astype(np.uint8)
    dictionary.save(tmp_path / "Z.safetensors", about, {"photographs": []})
    return Asset(tmp_path / "Z.safetensors")


def release_others(database: Asset) -> list[Subspaces]:
    defense = Affine(dim=4, sub_databases=1, database=database)
    return [defense.protect(draw_features(120, seed), Public(), np.random.default_rng(seed)) for seed in range(50, 60)]


def attack_succeeds(
    attack: DescriptorAttack, database: Asset, others: list[Subspaces], secret: Features = SECRET, seed: int = 0
) -> np.ndarray:
    """Return whether each estimate is near its descriptor."""
    defense = Affine(dim=4, sub_databases=1, database=database)
    release = defense.protect(secret, Public(), np.random.default_rng(seed))
    trial = dataclasses.replace(build_trial(defense, secret, others=others).with_release(release), attack=attack)
    estimates = attack.recover(build_view(trial), np.random.default_rng(0))
    return (estimates * secret.descriptors).sum(axis=1) > np.cos(np.radians(NEAR))


def test_clustering_finds_the_descriptor_with_releases_that_share_the_words(private, public_words):
    attack = Clustering(database=public_words, neighbours=9, coverage=1.0)
    assert attack_succeeds(attack, private, release_others(private)).mean() > 0.8


@pytest.mark.slow
def test_clustering_is_at_chance_if_no_release_shares_a_word(private, public_words, tmp_path):
    """Negative control: photographs with a single descriptor have no other subspaces, and other releases use another W."""
    attack = Clustering(database=public_words, neighbours=9, coverage=1.0)
    others = release_others(write_dictionary(tmp_path, 400, seed=7))
    alone = [attack_succeeds(attack, private, others, SECRET.take(np.array([row])), row)[0] for row in range(len(SECRET))]
    assert 0.1 < np.mean(alone) < 0.6  # one of three


@pytest.mark.slow
def test_intersection_needs_other_releases(private, tmp_path):
    with_others = attack_succeeds(Intersection(neighbours=50, coverage=1.0), private, release_others(private))
    of_another = attack_succeeds(
        Intersection(neighbours=50, coverage=1.0), private, release_others(write_dictionary(tmp_path, 400, seed=7))
    )
    assert with_others.mean() >= of_another.mean()


def test_every_cluster_has_a_member(rng):
    rows = rng.normal(size=(5, 30, 16))
    labels = cluster((rows / np.linalg.norm(rows, axis=2, keepdims=True)).astype(np.float32), 4)
    assert all(set(row) == {0, 1, 2, 3} for row in labels.tolist())
