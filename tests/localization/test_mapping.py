"""A map of rendered views with known depths, with queries that must be localized in it and queries that must not."""

from collections.abc import Callable

import numpy as np
import pytest
from gallery_stretch import QUERY, REFERENCES, STRETCH, WORDS, list_images, render_view

from bench.codebook.build import cluster
from bench.codebook.examples import draw_features
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import WordIndex, unit_rows
from bench.images.scene import Reference
from bench.localization import covisibility, mapping, pose
from bench.localization.map_matching import Correspondences, MutualNN, RetrievedReferences, Vocabulary
from bench.localization.maps import Map
from bench.localization.retrieval import Bags
from bench.mechanisms.subset import draw_word_subsets
from bench.types import Bytes, Descriptors, Features, Points, WordSets

pytestmark = pytest.mark.slow

TRIALS = 3000

Views = tuple[list[Reference], list[Features]]


@pytest.fixture(scope="module")
def stretch() -> Views:
    images = list(list_images())
    return images, [Sift(max_keypoints=400).extract(image.pixels.read()) for image in images]


@pytest.fixture(scope="module")
def references(stretch: Views) -> Views:
    return [stretch[0][index] for index in REFERENCES], [stretch[1][index] for index in REFERENCES]


@pytest.fixture(scope="module")
def queries(stretch: Views) -> Views:
    between = range(QUERY // 2, len(STRETCH), QUERY)
    return [stretch[0][index] for index in between], [stretch[1][index] for index in between]


@pytest.fixture(scope="module")
def scene_map(references: Views) -> Map:
    return mapping.build_map(*references, 0.8)


@pytest.mark.slow
def test_points_lie_where_they_were_rendered(scene_map: Map, references: Views) -> None:
    assert len(scene_map.xyz) > 300
    off, foreground = [], []
    for number, image in enumerate(references[0]):
        rows = scene_map.rows(number)
        has_point = scene_map.points[rows] >= 0
        keypoints, xyz = scene_map.keypoints[rows][has_point], scene_map.xyz[scene_map.points[rows][has_point]]
        assert np.median(pose.compute_reprojection_errors(image.cam_from_world, image.camera, keypoints, xyz)) < 1
        x, y = np.floor(keypoints).astype(int).T
        view = render_view(STRETCH[REFERENCES[number]])
        depths = view.depth[y, x]
        off.append(np.abs((image.cam_from_world * xyz)[:, 2] / depths - 1))
        foreground.append(view.foreground[y, x])
    assert np.median(np.concatenate(off)) < 0.01
    assert np.quantile(np.concatenate(off), 0.8) < 0.05
    assert np.concatenate(foreground).mean() < 0.02  # each person is in one image only


def test_map_has_the_keypoints_of_all_references_in_order(scene_map: Map, references: Views) -> None:
    images, features = references
    assert scene_map.names == tuple(image.name for image in images)
    for number, each in enumerate(features):
        np.testing.assert_array_equal(scene_map.keypoints[scene_map.rows(number)], each.keypoints)
        np.testing.assert_array_equal(scene_map.descriptors[scene_map.rows(number)], each.descriptors)
    assert scene_map.codes is not None
    np.testing.assert_array_equal(scene_map.codes, np.concatenate([each.codes for each in features if each.codes is not None]))


def test_same_references_give_the_same_map(scene_map: Map, references: Views) -> None:
    again = mapping.build_map(*references, 0.8)
    np.testing.assert_array_equal(again.points, scene_map.points)
    np.testing.assert_array_equal(again.xyz, scene_map.xyz)


def test_matches_against_the_poses_are_dropped(references: Views) -> None:
    images, features = references
    count = min(len(features[0]), len(features[1]))
    random = np.stack([np.arange(count), np.random.default_rng(0).permutation(count)], axis=1)
    inliers = mapping.verify_matches(images, features, [((0, 1), random)])[0, 1]
    assert len(inliers) < 0.2 * count


def test_references_without_overlap_give_no_map(references: Views) -> None:
    noise = [draw_features(100, seed=number) for number in range(len(references[0]))]
    with pytest.raises(UserError, match="the map has no point: do the references overlap"):
        mapping.build_map(references[0], noise, 0.8)


def test_neighbours_are_the_nearest_that_look_the_same_way(references: Views) -> None:
    images = references[0]
    chosen = covisibility.select_pairs(images, neighbours=3, max_angle=40)
    expected = set()
    for a, one in enumerate(images):
        found = []
        for b, other in enumerate(images):
            turned = one.cam_from_world.rotation.inverse() * np.array([0, 0, 1.0])
            cosine = turned @ (other.cam_from_world.rotation.inverse() * np.array([0, 0, 1.0]))
            if a != b and np.degrees(np.arccos(min(1, cosine))) < 40:
                offset = one.cam_from_world.inverse().translation - other.cam_from_world.inverse().translation
                found.append((np.linalg.norm(offset), b))
        expected |= {(min(a, b), max(a, b)) for _, b in sorted(found)[:3]}
    assert chosen == sorted(expected)


# Localization from end to end. Controls: the same with one part broken must fail.

Match = Callable[[Features, np.ndarray], Correspondences]


@pytest.fixture(scope="module")
def words(scene_map: Map) -> Bytes:
    assert scene_map.codes is not None
    return cluster(scene_map.codes, WORDS, np.random.default_rng(0))


def recall(scene_map: Map, queries: Views, words: Bytes, match: Match, *, shuffled: bool = False, larger: float = 1.0) -> float:
    """Fraction of queries within (0.25 m, 2°), optionally with shuffled points or a scaled map."""
    assert scene_map.codes is not None
    bags = Bags(words=WordIndex(words).find_nearest(scene_map.codes), starts=scene_map.starts, size=len(words))
    correct = 0
    for image, features in zip(*queries, strict=True):
        assert features.codes is not None
        found = match(features, bags.rank(WordIndex(words).find_nearest(features.codes), 8))
        points = np.random.default_rng(1).permutation(found.points) if shuffled else found.points
        xy, xyz = features.keypoints[found.keypoints].astype(np.float64), larger * scene_map.xyz[points]
        estimate = pose.estimate(xy, xyz, image.camera, trials=TRIALS, seed=0)
        if estimate is not None:
            distance, angle = pose.compute_errors(estimate.cam_from_world, image.cam_from_world)
            correct += distance < 0.25 and angle < 2
    return correct / len(queries[0])


@pytest.fixture(scope="module")
def raw(scene_map: Map) -> Match:
    def match(features: Features, references: np.ndarray) -> Correspondences:
        release = Descriptors(
            positions=Points(keypoints=features.keypoints), size=features.size, descriptors=features.descriptors
        )
        return MutualNN().match(release, RetrievedReferences(map=scene_map, references=references))

    return match


def private(scene_map: Map, words: Bytes, server_words: Bytes) -> Match:
    """Release sets of two of `words`, the nearest among them, and match them with the map's nearest `server_words`."""
    assert scene_map.codes is not None
    map_words = WordIndex(server_words).find_nearest(scene_map.codes)

    def match(features: Features, references: np.ndarray) -> Correspondences:
        assert features.codes is not None
        drawn = draw_word_subsets(WordIndex(words).find_nearest(features.codes), len(words), np.inf, 2, np.random.default_rng(0))
        candidates = unit_rows(words[drawn.ravel()]).reshape(*drawn.shape, -1)
        release = WordSets(positions=Points(keypoints=features.keypoints), size=features.size, candidates=candidates, words=drawn)
        return Vocabulary().match(release, RetrievedReferences(map=scene_map, references=references, words=map_words))

    return match


def test_raw_descriptors_localize(scene_map: Map, queries: Views, words: Bytes, raw: Match) -> None:
    assert recall(scene_map, queries, words, raw) == 1


def test_words_localize(scene_map: Map, queries: Views, words: Bytes) -> None:
    assert recall(scene_map, queries, words, private(scene_map, words, words)) >= 0.8


def test_shuffled_matches_localize_nothing(scene_map: Map, queries: Views, words: Bytes, raw: Match) -> None:
    assert recall(scene_map, queries, words, raw, shuffled=True) == 0


def test_words_of_another_dictionary_localize_nothing(scene_map: Map, queries: Views, words: Bytes) -> None:
    other = draw_features(WORDS, seed=9).codes
    assert other is not None
    assert recall(scene_map, queries, words, private(scene_map, words, other)) == 0


def test_map_of_twice_the_size_fails_the_metric_thresholds(scene_map: Map, queries: Views, words: Bytes, raw: Match) -> None:
    assert recall(scene_map, queries, words, raw, larger=2.0) == 0
