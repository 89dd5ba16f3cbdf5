"""A map of rendered views, whose depths are known, and queries in it: what must be found, and what must not."""

from collections.abc import Callable

import numpy as np
import pytest
from gallery_stretch import KEPT, QUERY, STRETCH, WALK, WORDS

from bench.codebook.build import cluster
from bench.codebook.examples import example_features
from bench.core.errors import UserError
from bench.datasets.gallery import shot
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import WordIndex, unit_rows
from bench.images.scene import Reference
from bench.localization import covisibility, mapping, pose
from bench.localization.map_matching import Correspondences, MutualNN, Retrieved, Vocabulary
from bench.localization.maps import Map
from bench.localization.retrieval import Bags
from bench.mechanisms.subset import word_subsets
from bench.types import Bytes, Descriptors, Features, WordSets

TRIALS = 3000

Taken = tuple[list[Reference], list[Features]]


@pytest.fixture(scope="module")
def stretch() -> Taken:
    images = [WALK.scene().references[number] for number in STRETCH]
    return images, [Sift(max_keypoints=400).extract(image.pixels.read()) for image in images]


@pytest.fixture(scope="module")
def references(stretch: Taken) -> Taken:
    return [stretch[0][place] for place in KEPT], [stretch[1][place] for place in KEPT]


@pytest.fixture(scope="module")
def queries(stretch: Taken) -> Taken:
    kept = range(QUERY // 2, len(STRETCH), QUERY)
    return [stretch[0][place] for place in kept], [stretch[1][place] for place in kept]


@pytest.fixture(scope="module")
def built(references: Taken) -> Map:
    return mapping.build(*references)


def test_points_lie_where_they_were_rendered(built: Map, references: Taken) -> None:
    assert len(built.xyz) > 300
    off, before = [], []
    for number, image in enumerate(references[0]):
        rows = built.rows(number)
        seen = built.points[rows] >= 0
        keypoints, xyz = built.keypoints[rows][seen], built.xyz[built.points[rows][seen]]
        assert np.median(pose.reprojection(image.cam_from_world, image.camera, keypoints, xyz)) < 1
        x, y = np.floor(keypoints).astype(int).T
        view = shot(WALK, "reference", STRETCH[KEPT[number]])
        depths = view.depth[y, x]
        off.append(np.abs((image.cam_from_world * xyz)[:, 2] / depths - 1))
        before.append(view.foreground[y, x])
    assert np.median(np.concatenate(off)) < 0.01
    assert np.quantile(np.concatenate(off), 0.8) < 0.05
    assert np.concatenate(before).mean() < 0.02  # people are in one image only


def test_map_has_the_keypoints_of_all_references_in_order(built: Map, references: Taken) -> None:
    images, features = references
    assert built.names == tuple(image.name for image in images)
    for number, each in enumerate(features):
        np.testing.assert_array_equal(built.keypoints[built.rows(number)], each.keypoints)
        np.testing.assert_array_equal(built.descriptors[built.rows(number)], each.descriptors)
    assert built.codes is not None
    np.testing.assert_array_equal(built.codes, np.concatenate([each.codes for each in features if each.codes is not None]))


def test_same_references_make_the_same_map(built: Map, references: Taken) -> None:
    again = mapping.build(*references)
    np.testing.assert_array_equal(again.points, built.points)
    np.testing.assert_array_equal(again.xyz, built.xyz)


def test_matches_against_the_poses_are_dropped(references: Taken) -> None:
    images, features = references
    count = min(len(features[0]), len(features[1]))
    random = np.stack([np.arange(count), np.random.default_rng(0).permutation(count)], axis=1)
    kept = mapping.verified(images, features, [((0, 1), random)])[0, 1]
    assert len(kept) < 0.2 * count


def test_references_that_share_nothing_make_no_map(references: Taken) -> None:
    noise = [example_features(100, seed=number) for number in range(len(references[0]))]
    with pytest.raises(UserError, match="the map has no point: do the references overlap"):
        mapping.build(references[0], noise)


def test_neighbours_are_the_nearest_that_look_the_same_way(references: Taken) -> None:
    images = references[0]
    chosen = covisibility.pairs(images, neighbours=3, turn=40)
    expected = set()
    for a, one in enumerate(images):
        found = []
        for b, other in enumerate(images):
            turned = one.cam_from_world.rotation.inverse() * np.array([0, 0, 1.0])
            cosine = turned @ (other.cam_from_world.rotation.inverse() * np.array([0, 0, 1.0]))
            if a != b and np.degrees(np.arccos(min(1, cosine))) < 40:
                apart = one.cam_from_world.inverse().translation - other.cam_from_world.inverse().translation
                found.append((np.linalg.norm(apart), b))
        expected |= {(min(a, b), max(a, b)) for _, b in sorted(found)[:3]}
    assert chosen == sorted(expected)


# Localization from end to end. Controls: what must fail is the same with one part broken.

Match = Callable[[Features, np.ndarray], Correspondences]


@pytest.fixture(scope="module")
def words(built: Map) -> Bytes:
    assert built.codes is not None
    return cluster(built.codes, WORDS, np.random.default_rng(0))


def recall(built: Map, queries: Taken, words: Bytes, match: Match, *, shuffled: bool = False, larger: float = 1.0) -> float:
    """Share of queries within (0.25 m, 2°), be the points of pairs shuffled, or the map larger by a factor."""
    assert built.codes is not None
    bags = Bags(words=WordIndex(words).nearest(built.codes), starts=built.starts, size=len(words))
    right = 0
    for image, features in zip(*queries, strict=True):
        assert features.codes is not None
        found = match(features, bags.rank(WordIndex(words).nearest(features.codes), 8))
        points = np.random.default_rng(1).permutation(found.points) if shuffled else found.points
        xy, xyz = features.keypoints[found.keypoints].astype(np.float64), larger * built.xyz[points]
        estimate = pose.estimate(xy, xyz, image.camera, trials=TRIALS, seed=0)
        if estimate is not None:
            apart, turned = pose.errors(estimate.cam_from_world, image.cam_from_world)
            right += apart < 0.25 and turned < 2
    return right / len(queries[0])


@pytest.fixture(scope="module")
def raw(built: Map) -> Match:
    def match(features: Features, references: np.ndarray) -> Correspondences:
        release = Descriptors(keypoints=features.keypoints, size=features.size, descriptors=features.descriptors)
        return MutualNN().match(release, Retrieved(map=built, references=references))

    return match


def private(built: Map, words: Bytes, asked: Bytes) -> Match:
    """Sets of two words of `words`, the nearest among them, matched by the words that the map has in `asked`."""
    assert built.codes is not None
    mapped = WordIndex(asked).nearest(built.codes)

    def match(features: Features, references: np.ndarray) -> Correspondences:
        assert features.codes is not None
        drawn = word_subsets(WordIndex(words).nearest(features.codes), len(words), np.inf, 2, np.random.default_rng(0))
        candidates = unit_rows(words[drawn.ravel()]).reshape(*drawn.shape, -1)
        release = WordSets(keypoints=features.keypoints, size=features.size, candidates=candidates, words=drawn)
        return Vocabulary().match(release, Retrieved(map=built, references=references, words=mapped))

    return match


def test_raw_descriptors_localize(built: Map, queries: Taken, words: Bytes, raw: Match) -> None:
    assert recall(built, queries, words, raw) == 1


def test_words_localize(built: Map, queries: Taken, words: Bytes) -> None:
    assert recall(built, queries, words, private(built, words, words)) >= 0.8


def test_shuffled_matches_localize_nothing(built: Map, queries: Taken, words: Bytes, raw: Match) -> None:
    assert recall(built, queries, words, raw, shuffled=True) == 0


def test_words_of_another_dictionary_localize_nothing(built: Map, queries: Taken, words: Bytes) -> None:
    other = example_features(WORDS, seed=9).codes
    assert other is not None
    assert recall(built, queries, words, private(built, words, other)) == 0


def test_map_of_twice_the_size_fails_the_metric_thresholds(built: Map, queries: Taken, words: Bytes, raw: Match) -> None:
    assert recall(built, queries, words, raw, larger=2.0) == 0
