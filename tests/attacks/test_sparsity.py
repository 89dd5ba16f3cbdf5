"""The sparsity attack, against all vertices by brute force and against linear programs by HiGHS."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from lifted import build_features, change_bases, create_view, draw_centres, extract_sift, lift_features, measure_errors
from scipy.optimize import linprog

from attacks.sparsity import Sparsity
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.geometry.subspaces import guess_descriptors
from bench.geometry.vertices import find_unit_vertices
from bench.types import Points, Subspaces
from defenses.affine import Affine

EXACT = 1e-6


def draw_sparse(rng: np.random.Generator, count: int, length: int, zeros: int) -> np.ndarray:
    """Draw non-negative unit vectors with `zeros` zeros at random indices. -> (count, length)"""
    rows = rng.uniform(0.05, 1, (count, length))
    np.put_along_axis(rows, rng.random((count, length)).argsort(axis=1)[:, :zeros], 0, axis=1)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def build_subspace(points: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Build an affine subspace through points (p, D) along directions (r, D). -> origin (D,), basis (p - 1 + r, D)"""
    basis = np.linalg.qr(np.concatenate([points[1:] - points[0], directions]).T).Q.T
    return points[0] + 0.7 * basis.sum(axis=0), basis


def never_stop(x):
    return x[:, 0] > 2


@pytest.mark.slow
def test_finds_every_degenerate_vertex_of_planes(rng):
    """Planes through two sparse vectors each, and all intersections of two of their lines x_i = 0."""
    length, total = 20, 0
    origins, bases = [], []
    for _ in range(12):
        points = draw_sparse(rng, 2, length, zeros=int(rng.integers(2, 8)))
        origin, basis = build_subspace(points, rng.uniform(-1, 1, (1, length)))
        origins.append(origin)
        bases.append(basis)
    owners, vertices = find_unit_vertices(np.array(origins), np.array(bases), 400, never_stop, rng)
    for plane, (origin, basis) in enumerate(zip(origins, bases, strict=True)):
        expected: list[np.ndarray] = []
        for pair in itertools.combinations(range(length), 2):
            if abs(np.linalg.det(basis[:, pair])) < 1e-9:  # both vanish on the line through the two vectors
                continue
            x = origin + np.linalg.solve(basis[:, pair].T, -origin[list(pair)]) @ basis
            wanted = (np.abs(x) < 1e-9).sum() > 2 and x.min() > -1e-9 and abs(np.linalg.norm(x) - 1) < 1e-9
            if wanted and not any(np.allclose(x, other, atol=1e-6) for other in expected):
                expected.append(x)
        mine = vertices[owners == plane]
        assert len(mine) == len(expected)
        assert all(np.linalg.norm(mine - x, axis=1).min() < EXACT for x in expected)
        total += len(expected)
    assert total > 12


def solve_linear_programs(origin: np.ndarray, basis: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Return the first degenerate vertex of norm 1 that HiGHS finds, by reweighted L1 from 20 random initial weights."""
    for _ in range(20):
        weights = rng.random(len(origin))
        for _ in range(5):
            solved = linprog(basis @ weights, A_ub=-basis.T, b_ub=origin, bounds=(None, None), method="highs")
            x = origin + solved.x @ basis
            if (np.abs(x) < 1e-6).sum() > len(basis) and abs(np.linalg.norm(x) - 1) < 1e-5:
                return x
            weights = 1 / (np.maximum(x, 0) + 0.02)
    return None


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 6])
def test_agrees_with_highs(rng, dim):
    secrets = draw_sparse(rng, 5, 60, zeros=26)
    spaces = [build_subspace(d[None], rng.uniform(-1, 1, (dim, 60))) for d in secrets]
    reference = [solve_linear_programs(origin, basis, rng) for origin, basis in spaces]
    origins, bases = (np.array(part) for part in zip(*spaces, strict=True))
    owners, vertices = find_unit_vertices(origins, bases, 100 * dim, never_stop, rng)
    assert np.array_equal(owners, np.arange(5))
    for d, mine, theirs in zip(secrets, vertices, reference, strict=True):
        assert np.linalg.norm(mine - d) < EXACT
        assert theirs is not None
        assert np.linalg.norm(mine - theirs) < EXACT


@pytest.mark.slow
@pytest.mark.parametrize(("dim", "fraction"), [(2, 0.9), (8, 0.5)])
def test_recovers_sift(tmp_path: Path, rng, dim, fraction):
    secret = extract_sift(150)
    release = lift_features(secret, tmp_path, draw_centres(640), dim=dim)
    found = Sparsity().recover(create_view(release), rng)
    exact = measure_errors(found, secret) < EXACT
    assert found.dtype == np.float32
    assert exact.mean() > fraction
    # Without a degenerate vertex, the estimate is the direction of the point nearest to zero.
    assert secret.codes is not None
    few = (secret.codes == 0).sum(axis=1) <= dim
    assert not exact[few].any()
    owners, _ = Sparsity().find_candidates(release, np.random.default_rng(0))
    left = np.setdiff1d(np.arange(len(secret)), owners)
    assert np.array_equal(
        Sparsity().recover(create_view(release), np.random.default_rng(0))[left], guess_descriptors(release)[left]
    )


@pytest.mark.slow
def test_the_random_basis_has_no_effect(tmp_path: Path, rng):
    secret = extract_sift(100)
    release = lift_features(secret, tmp_path, draw_centres(640), dim=4)
    one, other = (
        Sparsity().recover(create_view(same), np.random.default_rng(1)) for same in (release, change_bases(release, rng))
    )
    assert (np.linalg.norm(one - other, axis=1) < 1e-4).mean() > 0.95
    assert abs((measure_errors(one, secret) < EXACT).mean() - (measure_errors(other, secret) < 2 * EXACT).mean()) < 0.05


def test_is_a_function_of_the_generator(tmp_path: Path):
    release = lift_features(extract_sift(40), tmp_path, draw_centres(640), dim=8)
    one, again, other = (Sparsity(pivots=4).recover(create_view(release), np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)


def test_the_order_of_components_has_no_effect(tmp_path: Path, rng):
    secret = extract_sift(100)
    release = lift_features(secret, tmp_path, draw_centres(640), dim=2)
    order = rng.permutation(128)
    shuffled = Subspaces(
        positions=Points(keypoints=release.keypoints),
        size=release.size,
        origins=release.origins[:, order],
        bases=release.bases[:, :, order],
    )
    found = Sparsity().recover(create_view(shuffled), rng)
    assert (np.linalg.norm(found - secret.descriptors[:, order], axis=1) < EXACT).mean() > 0.85


# ---- controls


@pytest.mark.slow
def test_control_a_descriptor_without_zeros_is_not_certified(tmp_path: Path, rng):
    secret = build_features(rng.integers(1, 150, (60, 128), dtype=np.uint8))
    release = lift_features(secret, tmp_path, draw_centres(640), dim=2)
    owners, _ = Sparsity().find_candidates(release, rng)
    assert len(owners) == 0
    assert np.array_equal(Sparsity().recover(create_view(release), rng), guess_descriptors(release))


@pytest.mark.slow
def test_control_an_origin_of_another_subspace_is_not_certified(tmp_path: Path, rng):
    release = lift_features(extract_sift(60), tmp_path, draw_centres(640), dim=2)
    astray = Subspaces(
        positions=Points(keypoints=release.keypoints),
        size=release.size,
        origins=np.roll(release.origins, 1, axis=1),
        bases=release.bases,
    )
    assert len(Sparsity().find_candidates(astray, rng)[0]) == 0


@pytest.mark.slow
def test_control_noise_in_the_descriptor_hides_its_zeros(tmp_path: Path, rng):
    secret = extract_sift(60)
    noisy = np.abs(secret.descriptors + rng.normal(0, 1e-3, secret.descriptors.shape)).astype(np.float32)
    secret.descriptors[:] = noisy / np.linalg.norm(noisy, axis=1, keepdims=True)
    assert len(Sparsity().find_candidates(lift_features(secret, tmp_path, draw_centres(640), dim=2), rng)[0]) == 0


def test_with_a_database_of_raw_descriptors_the_attack_guesses(tmp_path: Path, rng):
    """Every word is as sparse as the secret, so at dim 2 the attack guesses one of two."""
    secret, others = extract_sift(150), extract_sift(500, photograph=1)
    assert others.codes is not None
    words = np.unique(others.codes, axis=0)
    release = lift_features(secret, tmp_path, words, dim=2, sub_databases=1)
    exact = measure_errors(Sparsity().recover(create_view(release), rng), secret) < EXACT
    assert 0.3 < exact.mean() < 0.75


# ---- applicability


def test_applies_to_extractors_that_declare_zeros():
    class Dense(Sift):
        exact_zeros = False

    assert Sparsity().explain_not_applicable(Affine(), Sift(), Public()) is None
    assert "exact zeros; dense" in (Sparsity().explain_not_applicable(Affine(), Dense(), Public()) or "").replace(
        "test-sparsity", "dense"
    )


def test_zero_pivots_are_refused():
    with pytest.raises(UserError, match="at least 1"):
        Sparsity(pivots=0)
