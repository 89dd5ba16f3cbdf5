"""Matching: the measures against brute force, with pairs that must match and pairs that must not."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fakes import build_trial, draw_texture

import bench
from bench.api import Defense
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.shared_words import find_shared_words
from bench.images.scene import File
from bench.localization import two_view_matching
from bench.rendering.homographies import Pair
from bench.settings import Asset
from bench.task_api import Outcome
from bench.tasks.matching import ACCURACY_LIMITS, Matching, compute_accuracy, transfer
from bench.testing import build_image
from bench.types import Features, Points, Release, WordSets
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.naive_ldp import NaiveLDP
from defenses.none import Undefended

SECRET = draw_features(60, seed=3)
TURN = np.array([[0.9, 0.1, 3.0], [-0.1, 0.9, 8.0], [1e-3, 0, 1]])


@pytest.fixture
def words(tmp_path: Path) -> Asset:
    return write_dictionary(tmp_path, 5_000)


def test_measures_by_enumeration(rng: np.random.Generator) -> None:
    first, second = (rng.uniform(0, 60, (count, 2)).astype(np.float32) for count in (40, 50))
    error = np.empty((40, 50))
    for i, j in np.ndindex(error.shape):
        x, y, depth = TURN @ [*first[i], 1]
        error[i, j] = np.hypot(x / depth - second[j, 0], y / depth - second[j, 1])
    nearest = np.stack([np.arange(0, 40, 2), error[::2].argmin(axis=1)], axis=1)
    matches = np.unique(np.concatenate([nearest, rng.integers(0, 40, (30, 2))]), axis=0)
    errors = np.array([error[i, j] for i, j in matches])
    possible = {i for i in range(40) if error[i].min() < 3}
    right = {int(i) for (i, _), off in zip(matches, errors, strict=True) if off < 3}
    found = compute_accuracy(first, second, TURN, matches)
    assert found["correspondences"] == len(possible)
    assert found["recall"] == pytest.approx(len(right & possible) / len(possible))
    assert found["precision"] == found["mma_03px"] == pytest.approx((errors < 3).mean())
    assert [found[f"mma_{t:02}px"] for t in ACCURACY_LIMITS] == pytest.approx([(errors < t).mean() for t in ACCURACY_LIMITS])
    assert 0 < len(right) < len(possible) < 40


def test_all_measures_are_zero_without_matches() -> None:
    points = np.array([[5, 5], [9, 9]], np.float32)
    found = compute_accuracy(points, points, np.eye(3), np.empty((0, 2), np.int64))
    assert (found["precision"], found["recall"], found["mma_10px"], found["matches"]) == (0, 0, 0, 0)
    assert compute_accuracy(points, points + 50, np.eye(3), np.empty((0, 2), np.int64))["recall"] is None


def test_points_beyond_the_horizon_have_no_position() -> None:
    behind = np.array([[1, 0, 0], [0, 1, 0], [-0.1, 0, 1.0]])
    found = transfer(np.array([[5, 5], [10, 5], [20, 5]], np.float32), behind)
    assert np.isfinite(found[0]).all()
    assert np.isinf(found[1:]).all()
    points = np.array([[20, 5]], np.float32)
    assert compute_accuracy(points, points, behind, np.array([[0, 0]]))["precision"] == 0


@pytest.mark.parametrize("unique", [False, True])
def test_words_in_common_by_enumeration(rng: np.random.Generator, unique: bool) -> None:
    first, second = (np.stack([rng.choice(60, 3, replace=False) for _ in range(count)]) for count in (15, 12))
    counts = [np.bincount(words.ravel(), minlength=60) for words in (first, second)]
    good = np.flatnonzero((counts[0] == 1) & (counts[1] == 1) | (not unique))
    expected = [[i, j] for i in range(15) for j in range(12) if set(first[i]) & set(second[j]) & set(good)]
    assert find_shared_words(first, second, unique).tolist() == expected
    assert 0 < len(expected) < 15 * 12


def test_words_in_common_of_small_sets() -> None:
    none, some = np.empty((0, 3), dtype=np.int64), np.array([[1, 2, 3], [1, 4, 5]])
    assert (
        find_shared_words(none, some).shape
        == find_shared_words(some, none).shape
        == find_shared_words(some, some + 10).shape
        == (0, 2)
    )
    assert find_shared_words(some, some, unique=True).tolist() == [[0, 0], [1, 1]]
    assert find_shared_words(some, some).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]


def release_features(defense: Defense, secret: Features = SECRET, seed: int = 0) -> Release:
    return defense.protect(secret, Public(), np.random.default_rng(seed))


DEFENSES: list[Callable[[Asset], Defense]] = [
    lambda words: Undefended(),
    lambda words: Affine(database=words, dim=2),
    lambda words: LDP(dictionary=words, epsilon=20.0, subset_size=2),
    lambda words: NaiveLDP(epsilon=1e6, subset_size=2),
]


@pytest.mark.parametrize("defense", DEFENSES)
@pytest.mark.parametrize("both", [False, True])
def test_the_same_features_match_themselves(words: Asset, defense: Callable[[Asset], Defense], both: bool) -> None:
    plugin = defense(words)
    second = release_features(plugin, seed=1) if both else two_view_matching.prepare_unprotected(SECRET, plugin, Public())
    found = {tuple(pair) for pair in two_view_matching.match_releases(release_features(plugin), second).tolist()}
    assert len({(i, i) for i in range(60)} & found) > 55
    assert len(found) < 120


@pytest.mark.parametrize("defense", DEFENSES)
def test_shuffled_features_match_at_chance(words: Asset, defense: Callable[[Asset], Defense]) -> None:
    """Negative control: descriptors in another order."""
    plugin, shuffled = defense(words), SECRET.take(np.random.default_rng(0).permutation(60))
    found = two_view_matching.match_releases(
        release_features(plugin), two_view_matching.prepare_unprotected(shuffled, plugin, Public())
    )
    assert (found[:, 0] == found[:, 1]).mean() < 0.15


def evaluate(task: Matching, defense: Defense, secrets: tuple[Features, Features], homography: np.ndarray) -> Outcome:
    """Evaluate a pair without photographs."""
    base = build_trial(defense, secrets[0])
    other = build_image(secrets[1], release_features(defense, secrets[1], seed=5))
    nowhere = File(path=Path("none"), size=(1, 1))
    pair = Pair(name="pair", first=nowhere, second=nowhere, homography=homography)
    sample = replace(base.sample, subject=pair)
    return task.evaluate(replace(base, sample=sample, images=(*base.images, other)))


def create_matching_features(homography: np.ndarray) -> tuple[Features, Features]:
    keypoints = np.random.default_rng(0).uniform(0, 300, (60, 2)).astype(np.float32)
    first = replace(SECRET, keypoints=keypoints)
    return first, replace(SECRET, keypoints=transfer(keypoints, homography).astype(np.float32))


@pytest.mark.parametrize("homography", [np.eye(3), TURN])
def test_matching_features_score_one(homography: np.ndarray) -> None:
    found = evaluate(Matching(), Undefended(), create_matching_features(homography), homography).metrics
    assert (found["precision"], found["recall"], found["mma_01px"], found["matches"]) == (1, 1, 1, 60)


def test_shuffled_positions_give_chance() -> None:
    """Negative control."""
    first, second = create_matching_features(np.eye(3))
    shuffled = replace(second, keypoints=np.random.default_rng(1).permutation(second.keypoints))
    found = evaluate(Matching(), Undefended(), (first, shuffled), np.eye(3)).metrics
    assert found["matches"] == 60
    assert found["precision"] < 0.1


def test_another_dictionary_matches_nothing(tmp_path: Path, words: Asset) -> None:
    """Negative control: the same numbers denote other words."""
    release = release_features(LDP(dictionary=words, epsilon=20.0))
    other = LDP(dictionary=write_dictionary(tmp_path, 5_000, seed=7), epsilon=20.0)
    assert len(two_view_matching.match_releases(release, two_view_matching.prepare_unprotected(SECRET, other, Public()))) < 10


def test_ratio_test_leaves_fewer_and_better_matches() -> None:
    first, second = draw_features(60, seed=1), draw_features(80, seed=2)
    all_of_them = two_view_matching.match_releases(release_features(Undefended(), first), release_features(Undefended(), second))
    strict = two_view_matching.match_releases(
        release_features(Undefended(), first), release_features(Undefended(), second), ratio=0.8
    )
    assert {tuple(pair) for pair in strict} < {tuple(pair) for pair in all_of_them}


def test_runs_on_hpatches(tmp_path: Path) -> None:
    (tmp_path / "v_wall").mkdir()
    for number in range(1, 7):
        draw_texture(0, (160, 128)).save(tmp_path / "v_wall" / f"{number}.ppm")
        np.savetxt(tmp_path / "v_wall" / f"H_1_{number}", np.eye(3))
    records = bench.run([Undefended()], images=tmp_path, task=Matching())
    assert [record["sample"] for record in records] == [f"v_wall-{number}" for number in range(2, 7)]
    assert all(record["metrics"]["recall"] == record["metrics"]["mma_01px"] == 1 for record in records)


def test_invalid_settings_and_inputs_are_refused(tmp_path: Path) -> None:
    for wrong in ({"ratio": 0.0}, {"ratio": 1.1}, {"ratio": float("nan")}, {"each": 0}):
        with pytest.raises(UserError, match="must be"):
            Matching(**wrong)
    with pytest.raises(UserError, match="no sequence of HPatches"):
        Matching().collect(tmp_path, None)
    with pytest.raises(UserError, match="give a folder of HPatches"):
        Matching().collect([tmp_path], None)


def release_words(words: list[list[int]], dictionary: np.ndarray) -> WordSets:
    rows = np.array(words)
    points = Points(keypoints=np.zeros((len(rows), 2), np.float32))
    return WordSets(positions=points, size=(9, 9), candidates=dictionary[rows], words=rows)


def test_words_match_by_their_descriptors() -> None:
    """Word 0 is shared and occurs twice, 1 and 2 are near each other, 3 is near nothing. Unique words miss the first two."""
    dictionary = np.eye(6, 8, dtype=np.float32)
    dictionary[2] = 0.8 * dictionary[1] + 0.6 * dictionary[5]
    first, second = release_words([[0, 3], [1, 4]], dictionary), release_words([[0], [2], [0]], dictionary)
    found = two_view_matching.match_by_word_descriptors(first, second, 0.8)
    assert found.tolist() == [[0, 0], [0, 2], [1, 1]]
    assert two_view_matching.match_releases(first, second).tolist() == [[0, 0], [0, 2]]
    assert two_view_matching.match_releases(first, second, unique=True).tolist() == []
    with pytest.raises(TypeError, match="needs words of a dictionary"):
        two_view_matching.match_by_word_descriptors(replace(first, words=None), second)


def test_words_that_both_images_release_match_by_descriptors_too(words: Asset, rng: np.random.Generator) -> None:
    """With the ratio test, random releases match by little else than the words that both have."""
    defense, public = LDP(dictionary=words, epsilon=0, subset_size=8), Public()
    first, second = (defense.protect(SECRET, public, rng) for _ in range(2))
    assert isinstance(first, WordSets)
    assert isinstance(second, WordSets)
    shared = {tuple(pair) for pair in two_view_matching.match_releases(first, second).tolist()}
    by_descriptors = {tuple(pair) for pair in two_view_matching.match_by_word_descriptors(first, second, 0.8).tolist()}
    assert len(shared) > 20
    assert shared <= by_descriptors
