"""Intersections of subspaces against least squares in float64, and database reconstruction."""

from dataclasses import replace

import numpy as np
import pytest

from bench.codebook import dictionary
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.geometry import intersections
from bench.geometry.database_reconstruction import find_byte_vectors, reconstruct_database
from bench.geometry.intersections import INTERSECTION_DISTANCE, find_intersections, find_intersections_within, find_nearest_points
from bench.geometry.nearest_words import unit_rows
from bench.geometry.shared_sub_database import find_shared_sub_database, stack_subspaces
from bench.settings import Asset
from bench.types import Subspaces
from defenses import affine
from defenses.affine import Affine


@pytest.fixture
def database(tmp_path):
    return write_dictionary(tmp_path, 24)


def release_features(database: Asset, dim: int, seed: int, count: int = 12) -> Subspaces:
    defense = Affine(dim=dim, sub_databases=1, database=database)
    return defense.protect(draw_features(count, seed), Public(), np.random.default_rng(seed))


def measure_distance(one: Subspaces, i: int, other: Subspaces, j: int) -> float:
    """Return the distance of two subspaces, by least squares over the directions of both."""
    directions = np.concatenate([one.bases[i], other.bases[j]]).astype(np.float64).T  # (D, dim + dim')
    between = (other.origins[j] - one.origins[i].astype(np.float64))[:, None]
    return float(np.linalg.norm(between - directions @ np.linalg.lstsq(directions, between, rcond=None)[0]))


@pytest.mark.parametrize("dim", [2, 4, 16])
def test_intersecting_pairs_against_least_squares(database, dim):
    one, other = release_features(database, dim, 1), release_features(database, dim, 2, 9)
    distances = np.array([[measure_distance(one, i, other, j) for j in range(9)] for i in range(12)])
    expected = {(int(i), int(j)) for i, j in np.argwhere(distances < INTERSECTION_DISTANCE)}
    found = find_intersections(one, other)
    assert set(zip(found.first.tolist(), found.second.tolist(), strict=True)) == expected
    assert 0 < len(expected) < 12 * 9
    assert (
        distances[distances > INTERSECTION_DISTANCE].min() > 100 * INTERSECTION_DISTANCE
    )  # zero and small distances are well separated


def orthogonalize_in_float32(rows: np.ndarray) -> np.ndarray:
    """Orthonormalize by the modified Gram-Schmidt process in float32, as the published code does. (N, dim, D)"""
    rows = rows.astype(np.float32)
    for i in range(rows.shape[1]):
        for j in range(i):
            rows[:, i] -= (rows[:, i] * rows[:, j]).sum(axis=1, keepdims=True) * rows[:, j]
        rows[:, i] /= np.linalg.norm(rows[:, i], axis=1, keepdims=True)
    return rows


def lift_in_float32(d: np.ndarray, span: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Reparameterise subspaces with the operations of the published code, all in float32. (N, D), (N, dim, D)"""
    d, span = d.astype(np.float32), orthogonalize_in_float32(span)
    random = rng.uniform(-1, 1, (span.shape[1] + 1, *d.shape)).astype(np.float32)
    points = [d + (((point - d)[:, None] * span).sum(axis=2)[..., None] * span).sum(axis=1) for point in random]
    return points[0], orthogonalize_in_float32(np.stack([point - points[0] for point in points[1:]], axis=1))


def round_to_half(rows: np.ndarray) -> np.ndarray:
    return rows.astype(np.float16).astype(np.float32)


def add_noise(rows: np.ndarray) -> np.ndarray:
    """Move each row by a thousandth of its length, so that bases are not orthonormal."""
    noise = np.random.default_rng(len(rows)).normal(0, 1e-3 / 128**0.5, rows.shape)
    return (rows + noise * np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


def release_with_errors(
    database: Asset, dim: int, error: str, seed: int, count: int, monkeypatch
) -> tuple[Subspaces, np.ndarray]:
    """Return a release with errors, and the words of each subspace."""
    if error == "float32 arithmetic":
        monkeypatch.setattr(affine, "reparameterise", lift_in_float32)
    defense = Affine(dim=dim, sub_databases=1, database=database)
    lifted = defense.lift(draw_features(count, seed), Public(), np.random.default_rng(seed))
    change = {"float16": round_to_half, "noise": add_noise}.get(error, lambda rows: rows)
    release = lifted.release
    return replace(release, origins=change(release.origins), bases=change(release.bases)), lifted.words


def find_pairs(one: Subspaces, other: Subspaces) -> set[tuple[int, int]]:
    found = find_intersections(one, other)
    return set(zip(found.first.tolist(), found.second.tolist(), strict=True))


@pytest.mark.parametrize("error", ["none", "float32 arithmetic", "float16", "noise"])
@pytest.mark.parametrize("dim", [2, 4, 16])
def test_tolerance_follows_the_errors_of_the_release(tmp_path, monkeypatch, dim, error):
    database = write_dictionary(tmp_path, 400)
    one, words = release_with_errors(database, dim, error, 11, 300 // dim, monkeypatch)
    other, other_words = release_with_errors(database, dim, error, 12, 300 // dim, monkeypatch)
    common = (words[:, None, :, None] == other_words[None, :, None, :]).sum(axis=(2, 3))  # (N, N) number of common words
    expected = {(int(i), int(j)) for i, j in np.argwhere(common)}
    assert len(expected) > 20
    assert find_pairs(one, other) == expected
    found = find_intersections(one, other)
    assert (found.single == (common[found.first, found.second] == 1)).all()
    assert (found.tolerances == INTERSECTION_DISTANCE).all() == (error == "none")
    monkeypatch.setattr(intersections, "LARGEST_TOLERANCE", INTERSECTION_DISTANCE)  # negative control: a constant tolerance
    constant = find_pairs(one, other)
    if error == "none" or (error == "float32 arithmetic" and dim < 16):
        assert constant <= expected
    else:
        assert constant < expected


def test_words_are_reconstructed_despite_errors(tmp_path, monkeypatch):
    database = write_dictionary(tmp_path, 24)
    release, _ = release_with_errors(database, 4, "float16", 11, 60, monkeypatch)
    truth = unit_rows(Public().dictionary(database).words)
    found = reconstruct_database(find_intersections_within(release))
    distances = np.linalg.norm(found[:, None] - truth, axis=2)
    assert (distances.min(axis=1) < 5e-3).all()
    assert len(np.unique(distances.argmin(axis=1))) > 20
    monkeypatch.setattr(intersections, "LARGEST_TOLERANCE", INTERSECTION_DISTANCE)  # negative control: a constant tolerance
    assert len(reconstruct_database(find_intersections_within(release))) == 0


@pytest.mark.parametrize("error", ["none", "float16"])
def test_coverage_counts_each_word_once(tmp_path, monkeypatch, error):
    database = write_dictionary(tmp_path, 24)
    target, words = release_with_errors(database, 4, error, 11, 10, monkeypatch)
    other, other_words = release_with_errors(database, 4, error, 12, 40, monkeypatch)
    alone = (words[:, None, :, None] == other_words[None, :, None, :]).sum(axis=(2, 3)) == 1  # one common word
    within = (words[:, None, :, None] == words[None, :, None, :]).sum(axis=(2, 3)) == 1
    partners = [np.concatenate([other_words[alone[i]], words[within[i]]]).ravel() for i in range(10)]
    expected = np.mean([np.isin(words[i], partners[i]).mean() for i in range(10)])
    shared = find_shared_sub_database(target, iter([other]), 2, enough=1.1)
    assert shared.coverage == pytest.approx(expected)


def test_subspaces_of_other_databases_do_not_intersect(database, tmp_path):
    """Negative control."""
    other_database = write_dictionary(tmp_path, 24, seed=9)
    assert len(find_intersections(release_features(database, 4, 1), release_features(other_database, 4, 2))) == 0


def test_pairs_within_a_release_come_once(database):
    release = release_features(database, 4, 1)
    within, both = find_intersections_within(release), find_intersections(release, release)
    pairs = {(i, j) for i, j in zip(both.first.tolist(), both.second.tolist(), strict=True) if i < j}
    assert set(zip(within.first.tolist(), within.second.tolist(), strict=True)) == pairs
    assert (within.first < within.second).all()


def test_two_liftings_of_one_descriptor_intersect_in_it(database):
    defense, secret = Affine(dim=6, sub_databases=1, database=database), draw_features(30, 3)
    one, other = (defense.protect(secret, Public(), np.random.default_rng(seed)) for seed in (1, 2))
    points, distances, single = find_nearest_points(one, other)
    assert (distances < INTERSECTION_DISTANCE).all()
    assert single.mean() > 0.5  # others share a word, and so a line
    np.testing.assert_allclose(points[single], secret.descriptors[single], atol=1e-5)


def test_words_are_reconstructed_exactly(database):
    words = Public().dictionary(database).words
    found = reconstruct_database(find_intersections_within(release_features(database, 4, 1, 60)))
    words_by_bytes = {row.tobytes() for row in words // np.gcd.reduce(words.astype(np.int64), axis=1)[:, None].astype(np.uint8)}
    assert len(found) > 20
    assert all(row.tobytes() in words_by_bytes for row in found)


def test_points_that_are_not_words_are_excluded(rng):
    """Negative control: with noise of a hundredth of the last bit, points are not 8-bit vectors."""
    codes = draw_features(20).codes
    points = unit_rows(codes).astype(np.float64)
    assert len(find_byte_vectors(points)) == 20
    assert len(find_byte_vectors(points + rng.normal(0, 1e-3, points.shape))) == 0


def test_more_photographs_reconstruct_more_words(tmp_path):
    path = tmp_path / "W.safetensors"
    dictionary.save(path, draw_features(400, 5).codes, {"photographs": []})
    parts = [release_features(Asset(path), 4, seed, 30) for seed in range(8)]
    counts = [len(reconstruct_database(find_intersections_within(stack_subspaces(parts[:number])))) for number in (1, 4, 8)]
    assert counts[0] < counts[1] < counts[2] <= 400


def test_signed_words_are_reconstructed_to_the_precision_of_the_release(tmp_path):
    database = write_dictionary(tmp_path, 24, length=64, signed=True)
    defense = Affine(dim=4, sub_databases=1, database=database)
    release = defense.protect(draw_features(60, 1, 64, signed=True), Public(), np.random.default_rng(1))
    words, found = unit_rows(Public().dictionary(database).words), reconstruct_database(find_intersections_within(release))
    nearest = np.linalg.norm(found[:, None] - words, axis=2).argmin(axis=1)
    np.testing.assert_allclose(found, words[nearest], atol=2e-5)
    assert 20 < len(found) == len(np.unique(nearest))  # each word once
    alone = defense.protect(draw_features(60, 1, 64, signed=True), Public(), np.random.default_rng(1)).take(np.arange(1))
    assert len(reconstruct_database(find_intersections_within(alone))) == 0  # negative control: nothing intersects
