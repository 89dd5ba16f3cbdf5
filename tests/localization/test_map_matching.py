"""Matchers against loops over all pairs."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from subspace_cases import draw_subspaces, residual

from bench.api import Defense
from bench.codebook.examples import draw_features
from bench.geometry.nearest_words import unit_rows
from bench.localization import map_matching
from bench.localization.map_matching import (
    Matcher,
    MutualNN,
    PointToSubspace,
    RetrievedReferences,
    SubspaceToSubspace,
    Vocabulary,
)
from bench.localization.maps import Map, from_arrays
from bench.types import Descriptors, Indices, Points, Release, Subspaces, WordSets
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.naive_ldp import NaiveLDP
from defenses.none import Undefended

WORDS = 12


@pytest.fixture
def scene_map(rng: np.random.Generator) -> Map:
    """Five references of 14 keypoints each. Some keypoints observe points of the map, and share them."""
    count = 70
    codes = draw_features(count, seed=3).codes
    assert codes is not None
    return Map(
        names=tuple("abcde"),
        starts=np.arange(0, count + 1, 14),
        keypoints=rng.uniform(0, 99, (count, 2)).astype(np.float32),
        descriptors=unit_rows(codes),
        codes=codes,
        points=rng.integers(-1, 20, count),
        xyz=rng.normal(size=(20, 3)),
    )


@pytest.fixture
def retrieved(scene_map: Map, rng: np.random.Generator) -> RetrievedReferences:
    return RetrievedReferences(map=scene_map, references=np.array([3, 0, 4]), words=rng.integers(0, WORDS, 70))


def draw_near(scene_map: Map, rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Draw descriptors of the map's keypoints, with noise. (*shape, D)"""
    chosen = scene_map.descriptors[rng.integers(0, 70, shape)]
    return unit_rows((chosen + rng.normal(0, 0.05, chosen.shape)).astype(np.float32))


def word_sets(scene_map: Map, rng: np.random.Generator, words: bool = True) -> WordSets:
    drawn = np.sort(np.array([rng.permutation(WORDS)[:3] for _ in range(10)]), axis=1)
    return WordSets(
        positions=Points(keypoints=np.zeros((10, 2), dtype=np.float32)),
        size=(9, 9),
        candidates=draw_near(scene_map, rng, 10, 3),
        words=drawn if words else None,
    )


def raw(scene_map: Map, rng: np.random.Generator) -> Descriptors:
    return Descriptors(
        positions=Points(keypoints=np.zeros((10, 2), dtype=np.float32)), size=(9, 9), descriptors=draw_near(scene_map, rng, 10)
    )


def pairs(found: map_matching.Correspondences) -> list[tuple[int, int]]:
    return list(zip(found.keypoints.tolist(), found.points.tolist(), strict=True))


def check_rows(found: map_matching.Correspondences, retrieved: RetrievedReferences) -> None:
    """Rows belong to retrieved references and to the matched points."""
    assert (retrieved.map.points[found.rows] == found.points).all()
    assert np.isin(found.rows // 14, retrieved.references).all()


def test_vocabulary(scene_map: Map, retrieved: RetrievedReferences, rng: np.random.Generator) -> None:
    release = word_sets(scene_map, rng)
    assert release.words is not None
    assert retrieved.words is not None
    expected = set()
    for n, words in enumerate(release.words):
        for reference in retrieved.references:
            for row in range(14 * reference, 14 * reference + 14):
                if scene_map.points[row] >= 0 and retrieved.words[row] in words:
                    expected.add((n, int(scene_map.points[row])))
    found = Vocabulary().match(release, retrieved)
    assert pairs(found) == sorted(expected)
    assert len(expected) > 20
    check_rows(found, retrieved)


@pytest.mark.parametrize("ratio", [1.0, 0.8])
@pytest.mark.parametrize("kind", [raw, word_sets])
def test_mutual_nn(scene_map: Map, retrieved: RetrievedReferences, rng: np.random.Generator, ratio: float, kind: type) -> None:
    release = kind(scene_map, rng)
    rows = release.descriptors[:, None] if isinstance(release, Descriptors) else release.candidates
    flat = [(n, row.astype(np.float64)) for n, candidates in enumerate(rows) for row in candidates]
    apart = np.array([[np.linalg.norm(row - other) for other in scene_map.descriptors.astype(np.float64)] for _, row in flat])
    found = MutualNN(ratio=ratio).match(release, retrieved)
    assert pairs(found) == loops(apart, [n for n, _ in flat], retrieved, ratio)
    check_rows(found, retrieved)


@pytest.mark.parametrize("ratio", [1.0, 0.95])
def test_point_to_subspace(scene_map: Map, retrieved: RetrievedReferences, rng: np.random.Generator, ratio: float) -> None:
    release = draw_subspaces(rng, 10, 4)
    apart = np.array([[residual(release.bases[n].T, u - release.origins[n]) for u in scene_map.descriptors] for n in range(10)])
    found = PointToSubspace(ratio=ratio).match(release, retrieved)
    assert pairs(found) == loops(apart, list(range(10)), retrieved, ratio)
    check_rows(found, retrieved)


def test_subspace_to_subspace(scene_map: Map, retrieved: RetrievedReferences, rng: np.random.Generator) -> None:
    release, theirs = draw_subspaces(rng, 10, 4), draw_subspaces(rng, 70, 2)
    apart = np.array(
        [
            [
                residual(np.hstack([release.bases[n].T, theirs.bases[k].T]), theirs.origins[k] - release.origins[n])
                for k in range(70)
            ]
            for n in range(10)
        ]
    )

    def lift(reference: int) -> Subspaces:
        rows = scene_map.rows(reference)
        return replace(
            theirs, positions=Points(keypoints=theirs.keypoints[rows]), origins=theirs.origins[rows], bases=theirs.bases[rows]
        )

    found = SubspaceToSubspace().match(release, replace(retrieved, lift=lift))
    assert pairs(found) == loops(apart, list(range(10)), retrieved, 1.0)
    check_rows(found, retrieved)
    with pytest.raises(TypeError, match="subspace-to-subspace needs a release of subspaces, and lifted references"):
        SubspaceToSubspace().match(release, retrieved)


def loops(apart: np.ndarray, owners: list[int], retrieved: RetrievedReferences, ratio: float) -> list[tuple[int, int]]:
    """Match mutual nearest neighbours by loops, reference by reference."""
    found = set()
    for reference in retrieved.references.tolist():
        of = range(14 * reference, 14 * reference + 14)
        for row in range(len(apart)):
            nearest, second = sorted(of, key=lambda column: apart[row, column])[:2]
            mutual = min(range(len(apart)), key=lambda other: apart[other, nearest]) == row
            clear = ratio == 1 or apart[row, nearest] < ratio * apart[row, second]
            if mutual and clear and retrieved.map.points[nearest] >= 0:
                found.add((owners[row], int(retrieved.map.points[nearest])))
    assert found
    return sorted(found)


def test_subspace_through_a_descriptor_matches_it(scene_map: Map, rng: np.random.Generator) -> None:
    """Lifted descriptors of a reference match that reference's keypoints."""
    rows = np.arange(14)
    lifted = draw_subspaces(rng, 14, 2)
    origins = scene_map.descriptors[rows] + (rng.normal(size=(14, 1, 2)) @ lifted.bases)[:, 0]
    release = Subspaces(
        positions=Points(keypoints=lifted.keypoints), size=(9, 9), origins=origins.astype(np.float32), bases=lifted.bases
    )
    found = PointToSubspace(ratio=0.5).match(release, RetrievedReferences(map=scene_map, references=np.array([0])))
    assert pairs(found) == sorted((n, int(scene_map.points[n])) for n in rows if scene_map.points[n] >= 0)


@pytest.mark.parametrize("matcher", [MutualNN(), PointToSubspace(), Vocabulary()])
def test_nothing_retrieved_matches_nothing(scene_map: Map, rng: np.random.Generator, matcher: Matcher) -> None:
    release: Release = draw_subspaces(rng, 3, 2) if isinstance(matcher, PointToSubspace) else word_sets(scene_map, rng)
    none: Indices = np.empty(0, dtype=np.int64)
    assert (
        len(matcher.match(release, RetrievedReferences(map=scene_map, references=none, words=np.zeros(70, dtype=np.int64)))) == 0
    )


def test_matcher_is_chosen_by_type() -> None:
    chosen: dict[Defense, str] = {
        Undefended(): "mutual-nn",
        LDP(): "vocabulary",
        NaiveLDP(): "mutual-nn",
        Affine(): "point-to-subspace",
    }
    assert {defense: map_matching.select_matcher(defense) for defense in chosen} == chosen
    assert map_matching.explain_not_applicable("mutual-nn", LDP()) is None
    assert map_matching.explain_not_applicable("vocabulary", Affine()) == "vocabulary matches WordSets; affine releases Subspaces"
    assert (
        map_matching.explain_not_applicable("vocabulary", NaiveLDP())
        == "vocabulary matches words of a dictionary; naive-ldp has none"
    )


def test_release_of_another_type_is_refused(scene_map: Map, retrieved: RetrievedReferences, rng: np.random.Generator) -> None:
    with pytest.raises(TypeError, match="point-to-subspace matches subspaces, not Descriptors"):
        PointToSubspace().match(raw(scene_map, rng), retrieved)
    with pytest.raises(TypeError, match="mutual-nn matches descriptors, not Subspaces"):
        MutualNN().match(draw_subspaces(rng, 2, 2), retrieved)
    with pytest.raises(TypeError, match="a release of a dictionary's words"):
        Vocabulary().match(word_sets(scene_map, rng, words=False), retrieved)


def test_map_survives_being_stored(scene_map: Map) -> None:
    arrays, meta = scene_map.to_arrays()
    assert "descriptors" not in arrays  # the codes are four times smaller
    again = from_arrays(arrays, meta)
    for field in ("starts", "keypoints", "descriptors", "codes", "points", "xyz"):
        np.testing.assert_array_equal(getattr(again, field), getattr(scene_map, field))
    assert again.names == scene_map.names
    assert Counter(scene_map.rows(1).indices(70)) == Counter((14, 28, 1))
