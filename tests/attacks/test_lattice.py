"""The lattice attack and its kernel, against brute force, least squares and planted vectors."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from lifted import build_features, change_bases, create_view, draw_centres, extract_sift, lift_features, measure_errors

from attacks.lattice import Lattice
from bench.codebook.public import Public
from bench.extractors.sift import Sift
from bench.geometry.lattice import enumerate_short_vectors, find_integer_vectors, find_unit_integer_points, reduce_basis
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import guess_descriptors
from bench.types import Points, Subspaces
from defenses.affine import Affine

LONGEST = 520.0


def find_contents(release: Subspaces, rows: np.ndarray) -> list[set[int]]:
    """Return which rows lie in each subspace, by least squares."""
    inside = []
    for origin, basis in zip(release.origins.astype(float), release.bases.astype(float), strict=True):
        away = (rows.astype(float) - origin).T
        left = away - basis.T @ np.linalg.lstsq(basis.T, away, rcond=None)[0]
        inside.append(set(np.flatnonzero(np.linalg.norm(left, axis=0) < 1e-5).tolist()))
    return inside


# ---- the kernel


def test_reduced_spans_the_same_lattice_and_is_reduced(rng):
    basis = rng.integers(-1000, 1000, (6, 6)).astype(float)
    short = reduce_basis(basis)
    change = short @ np.linalg.inv(basis)
    np.testing.assert_allclose(change, np.rint(change), atol=1e-6)
    assert abs(round(np.linalg.det(change))) == 1
    triangle = np.linalg.qr(short.T.astype(float)).R
    size = np.abs(triangle / np.diagonal(triangle)[:, None])[np.triu_indices(6, 1)]
    assert size.max() < 0.52
    steps = np.diagonal(triangle) ** 2
    assert (steps[1:] > (0.98 - (np.diagonal(triangle, 1) / np.diagonal(triangle)[:-1]) ** 2) * steps[:-1]).all()


def test_all_short_vectors_are_found(rng):
    bases = rng.normal(size=(4, 3, 5))
    grams = bases @ bases.transpose(0, 2, 1)
    bounds = np.array([1.0, 4.0, 9.0, 0.0])
    owners, found = enumerate_short_vectors(grams, bounds)
    box = np.array(list(itertools.product(range(-40, 41), repeat=3)))
    for lattice, (gram, bound) in enumerate(zip(grams, bounds, strict=True)):
        expected = box[np.einsum("ci,ij,cj->c", box, gram, box) <= bound]
        mine = found[owners == lattice]
        assert np.abs(expected).max() < 40
        assert {tuple(row) for row in mine.tolist()} == {tuple(row) for row in expected.tolist()}
        assert len(mine) == len(expected)


@pytest.mark.parametrize(("planted", "random"), [(1, 3), (3, 0), (3, 3), (5, 8)])
def test_planted_integer_vectors_are_found(rng, planted, random):
    vectors = rng.integers(0, 120, (4, planted, 128)).astype(float)
    spans = np.linalg.qr(np.concatenate([vectors, rng.normal(size=(4, random, 128))], axis=1).transpose(0, 2, 1)).Q
    for mine, truth in zip(find_integer_vectors(spans, 2000.0), vectors, strict=True):
        assert mine.shape == (planted, 128)
        change = np.linalg.lstsq(truth.T, mine.T.astype(float), rcond=None)[0]
        np.testing.assert_allclose(change, np.rint(change), atol=1e-6)
        assert abs(round(np.linalg.det(change))) == 1


def test_control_a_random_subspace_has_no_integer_vectors(rng):
    spans = np.linalg.qr(rng.normal(size=(20, 128, 5))).Q
    assert all(len(found) == 0 for found in find_integer_vectors(spans, LONGEST))


# ---- the attack


@pytest.mark.parametrize(
    ("lifting", "dim", "words"), [("hybrid", 2, 1), ("hybrid", 8, 4), ("adversarial", 4, 4), ("random", 2, 0), ("random", 7, 0)]
)
def test_candidates_are_the_descriptor_and_the_words(tmp_path: Path, lifting, dim, words):
    secret, others = extract_sift(40), extract_sift(500, photograph=1)
    assert others.codes is not None
    database = np.unique(others.codes, axis=0)
    release = lift_features(secret, tmp_path, database, lifting=lifting, dim=dim)
    known = np.concatenate([secret.descriptors, unit_rows(database)])  # (K, D)
    owners, rows = find_unit_integer_points(release, LONGEST)
    for keypoint, expected in enumerate(find_contents(release, known)):
        mine = {int(index) for row in rows[owners == keypoint] for index in np.flatnonzero((known == row).all(axis=1))}
        assert len(rows[owners == keypoint]) == words + 1
        assert mine == expected
        assert keypoint in mine


@pytest.mark.slow
@pytest.mark.parametrize(("lifting", "dim"), [("hybrid", 2), ("hybrid", 16), ("adversarial", 6), ("random", 16)])
def test_with_a_database_of_centres_all_descriptors_are_found(tmp_path: Path, rng, lifting, dim):
    secret = extract_sift(30)
    release = lift_features(secret, tmp_path, draw_centres(640), lifting=lifting, dim=dim)
    found = Lattice().recover(create_view(release), rng)
    assert found.dtype == np.float32
    assert np.array_equal(found, secret.descriptors)
    assert np.array_equal(Lattice().recover(create_view(change_bases(release, rng)), rng), found)


def test_needs_no_zeros(tmp_path: Path, rng):
    codes = np.rint(draw_centres(30, seed=1) / 1.6).astype(np.uint8)
    codes[:, :6] = codes.max(axis=1, keepdims=True)  # as after SIFT's clipping
    assert codes.min() > 0
    secret = build_features(codes)
    release = lift_features(secret, tmp_path, draw_centres(640), dim=4)
    assert np.array_equal(Lattice().recover(create_view(release), rng), secret.descriptors)


def test_with_a_database_of_raw_descriptors_the_attack_guesses(tmp_path: Path, rng):
    """It guesses among dim / 2 + 1 descriptors, since no word occurs twice."""
    secret = extract_sift(150)
    others = extract_sift(500, photograph=1)
    assert others.codes is not None
    release = lift_features(secret, tmp_path, np.unique(others.codes, axis=0), dim=2, sub_databases=1)
    exact = measure_errors(Lattice().recover(create_view(release), rng), secret) == 0
    assert 0.3 < exact.mean() < 0.7


# ---- controls


def test_control_descriptors_off_the_grid_are_not_found(tmp_path: Path, rng):
    """Noise of a twentieth of an 8-bit unit: the words are found, the descriptor is not."""
    secret = extract_sift(30)
    noisy = secret.descriptors + rng.normal(0, 1e-4, secret.descriptors.shape)
    secret.descriptors[:] = noisy / np.linalg.norm(noisy, axis=1, keepdims=True)
    words = draw_centres(640)
    owners, rows = find_unit_integer_points(lift_features(secret, tmp_path, words, dim=2), LONGEST)
    assert np.array_equal(owners, np.arange(30))
    assert all((unit_rows(words) == row).all(axis=1).any() for row in rows)
    owners, _ = find_unit_integer_points(lift_features(secret, tmp_path, words, lifting="random", dim=2), LONGEST)
    assert len(owners) == 0


def test_control_half_precision_is_not_enough(tmp_path: Path, rng):
    release = lift_features(extract_sift(30), tmp_path, draw_centres(640), dim=2)
    half = Subspaces(
        positions=Points(keypoints=release.keypoints),
        size=release.size,
        origins=release.origins.astype(np.float16).astype(np.float32),
        bases=release.bases.astype(np.float16).astype(np.float32),
    )
    assert len(find_unit_integer_points(half, LONGEST)[0]) == 0
    assert np.array_equal(Lattice().recover(create_view(half), rng), guess_descriptors(half))


def test_applies_to_extractors_that_declare_8_bit_descriptors():
    class Real(Sift):
        eight_bit = False

    assert Lattice().explain_not_applicable(Affine(), Sift(), Public()) is None
    assert "8-bit" in (Lattice().explain_not_applicable(Affine(), Real(), Public()) or "")
