"""The words nearest to subspaces against least squares in float64; the search time against a bare matrix product."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from floor import build_bare_product

from bench.codebook.public import Public
from bench.extractors.sift import Sift
from bench.geometry import subspaces
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import feet_and_frames, find_nearest_to_subspaces, project
from bench.images import photographs
from bench.types import Points, Subspaces
from defenses.affine import Affine, lift, reparameterise

ROUNDING = 1e-12  # of two ways to compute one distance in float64


def build_subspaces(origins: np.ndarray, bases: np.ndarray) -> Subspaces:
    keypoints = np.zeros((len(origins), 2), np.float32)
    return Subspaces(
        positions=Points(keypoints=keypoints), size=(64, 64), origins=origins.astype(np.float32), bases=bases.astype(np.float32)
    )


def draw_subspaces(rng: np.random.Generator, count: int, dim: int, length: int = 128) -> Subspaces:
    """Draw subspaces about as far from zero as those of unit descriptors."""
    bases = np.linalg.qr(rng.normal(size=(count, length, dim)))[0].transpose(0, 2, 1)
    return build_subspaces(rng.normal(size=(count, length)) / length**0.5, bases)


def distances(release: Subspaces, rows: np.ndarray) -> np.ndarray:
    """Return dist(D, w), by solving for the coordinates. -> (N, K)"""
    found = []
    for origin, basis in zip(release.origins.astype(float), release.bases.astype(float), strict=True):
        offsets = (rows.astype(float) - origin).T  # (D, K)
        coordinates = np.linalg.lstsq(basis.T, offsets, rcond=None)[0]
        found.append(np.linalg.norm(offsets - basis.T @ coordinates, axis=0))
    return np.array(found)


def agree(release: Subspaces, words: np.ndarray, count: int) -> bool:
    """Whether the nearest words and their distances are those of least squares over all words."""
    found, measured = find_nearest_to_subspaces(release, words, count)
    expected = distances(release, unit_rows(words))
    order = np.argsort(expected, axis=1, kind="stable")[:, :count]
    return np.array_equal(found, order) and bool(np.abs(measured - np.take_along_axis(expected, order, axis=1)).max() < ROUNDING)


@pytest.fixture
def words(rng):
    """Words similar to SIFT's: few large components, and many near zero."""
    return np.minimum(rng.gamma(0.6, 40.0, (5000, 128)) + 1, 255).astype(np.uint8)


@pytest.fixture(params=[torch.bfloat16, torch.float32], ids=["bf16", "float32"])
def fast_pass(request, monkeypatch):
    """Both formats of the fast pass, on any processor."""
    monkeypatch.setattr(subspaces, "pick_dtype", lambda device: request.param)


# ---- exact


@pytest.mark.usefixtures("fast_pass")
@pytest.mark.parametrize(("dim", "count"), [(1, 1), (2, 8), (5, 3), (16, 70)])
def test_agrees_with_least_squares(rng, words, dim, count):
    assert agree(draw_subspaces(rng, 12, dim), words, count)


@pytest.mark.usefixtures("fast_pass")
def test_float_words_of_any_norm(rng, words):
    rows = (words * rng.uniform(0.01, 10, (len(words), 1))).astype(np.float32)
    assert agree(draw_subspaces(rng, 12, 4), rows, 8)


@pytest.mark.usefixtures("fast_pass")
def test_more_subspaces_than_one_batch(rng, words):
    count = subspaces.ROWS // 3 + 5
    assert agree(draw_subspaces(rng, count, 2), words[: subspaces.GROUP + 1], 2)


@pytest.mark.parametrize("size", [1, 2, 31, 33])
@pytest.mark.parametrize("count", [1, 40])
def test_few_words(rng, words, size, count):
    release = draw_subspaces(rng, 3, 2)
    assert agree(release, words[:size], count)
    assert find_nearest_to_subspaces(release, words[:size], count)[0].shape == (3, min(size, count))


def test_no_subspaces(rng, words):
    found, measured = find_nearest_to_subspaces(draw_subspaces(rng, 0, 3), words, 7)
    assert found.shape == measured.shape == (0, 7)


def test_ties_go_to_the_lowest_index(rng, words):
    doubled = np.concatenate([words, words[::-1], words])  # each word occurs three times, in different blocks
    found, measured = find_nearest_to_subspaces(draw_subspaces(rng, 20, 4), doubled, 6)
    last = len(words) - 1
    twins = np.stack([found[:, ::3], 2 * last + 1 - found[:, ::3], found[:, ::3] + 2 * last + 2], axis=2).reshape(20, 6)
    assert (found[:, ::3] <= last).all()
    assert np.array_equal(found, twins)
    np.testing.assert_allclose(measured[:, ::3], measured[:, 2::3], atol=ROUNDING)


def test_zero_and_small_distances_are_distinguished(rng):
    """Two words at 1e-7 from D and two in it: the fast pass cannot distinguish them, and the order is exact."""
    length, dim = 128, 4
    bases = np.zeros((1, dim, length))
    bases[0, np.arange(dim), np.arange(dim)] = 1  # D = the first four axes, shifted by 1/2 along the fifth
    origins = np.zeros((1, length))
    origins[0, dim] = 0.5
    rows = unit_rows(rng.normal(size=(4000, length)).astype(np.float32))
    inside = np.zeros((4, length), np.float32)
    inside[:, :dim] = 0.75**0.5 * unit_rows(rng.normal(size=(4, dim)).astype(np.float32))
    inside[:, dim] = 0.5
    off = np.array([1e-7, 0, 0, 2e-7], np.float32)
    inside[:, dim + 1] = off
    rows[[50, 2100, 2101, 3999]] = inside
    found, measured = find_nearest_to_subspaces(build_subspaces(origins, bases), rows, 5)
    assert found[0, :4].tolist() == [2100, 2101, 50, 3999]
    np.testing.assert_allclose(measured[0, :4], [0, 0, 1e-7, 2e-7], atol=5e-8)
    assert measured[0, 4] > 0.1


def test_words_of_a_lifted_photograph_are_found_at_zero(rng, words):
    """The basis of the database attack: after rounding to float32, adversarial words are still far nearer than all others."""
    d = unit_rows(words[:30])
    origins, bases = reparameterise(d.astype(float), lift(d.astype(float), words[1000:], 4, 8, rng)[0], rng)
    _, measured = find_nearest_to_subspaces(build_subspaces(origins, bases), words[1000:], 5)
    assert measured[:, :4].max() < 1e-6
    assert measured[:, 4].min() > 0.1


# ---- the bound that makes it exact


def scores_and_bound(release: Subspaces, words: np.ndarray, dtype: torch.dtype) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the fast pass and their bounds. -> (N, K), (N,)"""
    feet, frames = feet_and_frames(release)
    exact = np.concatenate([feet[:, None], frames], axis=1).transpose(1, 0, 2)
    planes = torch.from_numpy(exact).to(dtype)
    fast = subspaces._compute_scores(planes, torch.from_numpy(words)).double().numpy()
    true = 1 + np.square(feet).sum(axis=1, keepdims=True) - np.square(distances(release, unit_rows(words)))
    return np.abs(fast - true), subspaces._bound_error(exact, planes.double().numpy(), dtype, words.dtype)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
@pytest.mark.parametrize("kind", [np.uint8, np.float32])
@pytest.mark.parametrize("dim", [1, 16])
def test_the_fast_pass_errs_within_its_bound(rng, words, dtype, kind, dim):
    wrong, bound = scores_and_bound(draw_subspaces(rng, 10, dim), words.astype(kind), dtype)
    assert (wrong <= bound[:, None]).all()


@pytest.mark.slow
def test_without_the_bound_it_would_be_wrong(rng, words, monkeypatch):
    """Negative control of the tests above: the fast pass alone does not decide."""
    monkeypatch.setattr(subspaces, "pick_dtype", lambda device: torch.bfloat16)
    release = draw_subspaces(rng, 60, 4)
    assert agree(release, words, 8)
    monkeypatch.setattr(subspaces, "_bound_error", lambda exact, *rest: np.zeros(exact.shape[1]))
    assert not agree(release, words, 8)


# ---- projection


def test_projection_is_the_nearest_point(rng):
    release, points = draw_subspaces(rng, 9, 5), rng.normal(size=(9, 128))
    projected = project(release, points)
    assert np.diagonal(distances(release, projected)).max() < ROUNDING
    np.testing.assert_allclose(np.linalg.norm(projected - points, axis=1), np.diagonal(distances(release, points)), atol=ROUNDING)


# ---- speed: 2·N·(dim + 1)·K·D operations

SUBSPACES, WORDS, NEAREST = 200, 65_536, 8

by_dim = pytest.mark.parametrize(
    "dim", [pytest.param(dim, marks=pytest.mark.benchmark(group=f"nearest to subspaces, dim {dim}")) for dim in (2, 16)]
)


@pytest.fixture(scope="module")
def lifted() -> Callable[[int], tuple[Subspaces, np.ndarray]]:
    """The release of a photograph's first keypoints, and words of the shipped database."""

    def lift_to(dim: int) -> tuple[Subspaces, np.ndarray]:
        features = Sift().extract(photographs.read(photographs.list_builtin()[0].path).pixels)
        release = Affine(dim=dim).protect(features, Public(), np.random.default_rng(0))
        few = slice(SUBSPACES)
        return build_subspaces(release.origins[few], release.bases[few]), Public().dictionary("shipped").words[:WORDS]

    return lift_to


@by_dim
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["float32", "bf16"])
def test_speed_of_the_bare_product(benchmark, lifted, dim, dtype):
    release, words = lifted(dim)
    benchmark(build_bare_product(len(release) * (dim + 1), words, dtype))


@by_dim
def test_speed_of_the_search(benchmark, lifted, dim):
    release, words = lifted(dim)
    benchmark(find_nearest_to_subspaces, release, words, NEAREST)
