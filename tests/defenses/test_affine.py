"""Affine lifting: the contents of D, the independence of re-parameterisations, and controls that reveal d."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from bench.api import Privacy
from bench.codebook import dictionary
from bench.codebook.public import Public
from bench.core.errors import SampleError, UserError
from bench.geometry.nearest_words import unit_rows
from bench.settings import Asset
from bench.testing import are_equal
from bench.types import Features
from defenses.affine import PLUGIN as AFFINE
from defenses.affine import lift, reparameterise

ALPHA = 1e-4
CERTAINLY_WRONG = 1e-9
EXACT = 1e-5

LIFTINGS = ["random", "adversarial", "hybrid"]
DIMS = [2, 4, 6, 8, 10, 12, 14, 16]
COUNT = {"random": lambda dim: 0, "adversarial": lambda dim: dim, "hybrid": lambda dim: dim // 2}


def make_words(size: int = 1600, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 150, size=(size, 128), dtype=np.uint8)


def make_database(folder: Path, words: np.ndarray) -> Asset:
    dictionary.save(folder / "words.safetensors", words, {"photographs": []})
    return Asset(folder / "words.safetensors")


def make_features(count: int, seed: int = 0) -> Features:
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, 150, size=(count, 128), dtype=np.uint8)
    keypoints = rng.uniform(0, 64, (count, 2)).astype(np.float32)
    return Features(keypoints=keypoints, descriptors=unit_rows(codes), codes=codes, size=(64, 48))


def distances(points: np.ndarray, origins: np.ndarray, bases: np.ndarray) -> np.ndarray:
    """Return the distance of each point to each subspace, in float64. (K, D), (N, D), (N, dim, D) -> (N, K)"""
    away = points.astype(float)[None] - origins.astype(float)[:, None]  # (N, K, D)
    along = np.einsum("nkd,nid->nki", away, bases.astype(float))
    return np.linalg.norm(away - np.einsum("nki,nid->nkd", along, bases.astype(float)), axis=2)


def projectors(bases: np.ndarray) -> np.ndarray:
    return np.einsum("nid,nie->nde", bases.astype(float), bases.astype(float))


# ---- the contents of D


@pytest.mark.parametrize("lifting", LIFTINGS)
@pytest.mark.parametrize("dim", DIMS)
def test_the_descriptor_and_words_of_one_sub_database_lie_in_d(tmp_path: Path, lifting: Any, dim: int) -> None:
    words = make_words()
    secret = make_features(30)
    defense = AFFINE(lifting=lifting, dim=dim, database=make_database(tmp_path, words))
    lifted = defense.lift(secret, Public(), np.random.default_rng(dim))
    release = lifted.release
    assert are_equal(release, defense.protect(secret, Public(), np.random.default_rng(dim)))
    assert (release.origins.dtype, release.bases.dtype) == (np.float32, np.float32)
    assert (release.origins.shape, release.bases.shape) == ((30, 128), (30, dim, 128))
    own = np.diagonal(distances(secret.descriptors, release.origins, release.bases))
    assert own.max() < EXACT
    gram = np.einsum("nid,njd->nij", release.bases.astype(float), release.bases.astype(float))
    assert np.abs(gram - np.eye(dim)).max() < EXACT
    # Exactly the configured number of words, all of one sub-database.
    inside = distances(unit_rows(words), release.origins, release.bases) < EXACT  # (N, K)
    assert (inside.sum(axis=1) == COUNT[lifting](dim)).all()
    assert np.array_equal(np.nonzero(inside)[1].reshape(30, -1), np.sort(lifted.words, axis=1))  # the words in `LiftedRelease`
    assert len(np.unique(np.nonzero(inside)[1] // 100)) <= 1  # 16 sub-databases of 100 words
    # The control: words that were not drawn and other descriptors are far away.
    others = distances(unit_rows(words), release.origins, release.bases)[~inside]
    assert others.min() > 0.01
    other_distances = distances(secret.descriptors, release.origins, release.bases)[~np.eye(30, dtype=bool)]
    assert other_distances.min() > 0.01


def test_one_sub_database_per_photograph_and_all_equally_often(tmp_path: Path) -> None:
    words, public, secret = make_words(64), Public(), make_features(3)
    defense = AFFINE(dim=4, sub_databases=4, database=make_database(tmp_path, words))
    used = np.zeros(4, dtype=int)
    counts = np.zeros(64, dtype=int)
    for seed in range(400):
        release = defense.protect(secret, public, np.random.default_rng(seed))
        inside = distances(unit_rows(words), release.origins, release.bases) < EXACT
        parts = np.unique(np.nonzero(inside)[1] // 16)
        assert len(parts) == 1
        used[parts] += 1
        counts += inside.sum(axis=0)
    assert stats.chisquare(used).pvalue > ALPHA
    for part in range(4):  # within a sub-database, every word equally often
        assert stats.chisquare(counts[part * 16 : part * 16 + 16]).pvalue > ALPHA


# ---- re-parameterisation

Parameters = tuple[np.ndarray, np.ndarray]
Reparameterise = Callable[[np.ndarray, np.ndarray, np.random.Generator], Parameters]


def lift_examples(count: int = 200, dim: int = 4, adversarial: int = 2) -> Parameters:
    """Return descriptors (N, D) and orthonormal directions (N, dim, D)."""
    d = make_features(count).descriptors.astype(float)
    return d, lift(d, make_words(), adversarial, dim, np.random.default_rng(7))[0]


def hides_the_descriptor(reparameterise: Reparameterise) -> bool:
    """The origin is as far from d as the projection of U([-1, 1])^n is: |d − o|² = |P(d − e)|², about dim / 3."""
    d, span = lift_examples()
    origins, _ = reparameterise(d, span, np.random.default_rng(0))
    far = np.square(origins - d).sum(axis=1)
    return bool(far.min() > 1e-3 and abs(far.mean() - 4 / 3) < 0.4)


def shares_nothing_but_d(reparameterise: Reparameterise) -> bool:
    """Two re-parameterisations of one D: the same D to 1e-5, and independent bases and origins."""
    d, span = lift_examples()
    (o1, b1), (o2, b2) = (reparameterise(d, span, np.random.default_rng(seed)) for seed in (1, 2))
    assert np.abs(projectors(b1) - projectors(b2)).max() < EXACT
    apart = (o2 - o1).astype(float)
    assert np.abs(apart - np.einsum("nde,ne->nd", projectors(b1), apart)).max() < EXACT
    # In coordinates of D, basis vectors are uniform directions, so cosines have mean 0 and mean square 1 / dim.
    cosines = np.einsum("nid,njd->nij", b1.astype(float), b2.astype(float))  # (N, dim, dim)
    error = 1 / np.sqrt(len(d) * 4)
    unlike = np.abs(cosines.mean(axis=0)).max() < 5 * error and np.abs(np.square(cosines).mean(axis=0) - 1 / 4).max() < 5 * error
    return bool(unlike and np.linalg.norm(apart, axis=1).min() > 1e-3)


def is_invariant(reparameterise: Reparameterise) -> bool:
    """With the same random vectors, all points and bases that describe D give the same release."""
    d, span = lift_examples()
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.normal(size=(len(d), 4, 4))).Q
    elsewhere = d + np.einsum("ni,nid->nd", rng.normal(size=(len(d), 4)), span)
    o1, b1 = reparameterise(d, span, np.random.default_rng(1))
    o2, b2 = reparameterise(elsewhere, turn @ span, np.random.default_rng(1))
    return bool(np.abs(o1 - o2).max() < EXACT and np.abs(b1 - b2).max() < EXACT)


def keeps_the_origin(d: np.ndarray, span: np.ndarray, rng: np.random.Generator) -> Parameters:
    return d, reparameterise(d, span, rng)[1]


def keeps_the_basis(d: np.ndarray, span: np.ndarray, rng: np.random.Generator) -> Parameters:
    return reparameterise(d, span, rng)[0], span


def keeps_lapacks_signs(d: np.ndarray, span: np.ndarray, rng: np.random.Generator) -> Parameters:
    """Return the basis of plain QR, whose first vector is always on one side of the first direction of `span`."""
    rows, dim, length = span.shape
    e = rng.uniform(-1, 1, (rows, dim, length))
    mixing = np.linalg.qr(span @ e.transpose(0, 2, 1)).Q
    return reparameterise(d, span, rng)[0], mixing.transpose(0, 2, 1) @ span


def hides_the_directions(reparameterise: Reparameterise) -> bool:
    """Whether the first basis vector is equally often on both sides of the first direction, which leads from d to a word."""
    d, span = lift_examples(1000)
    _, bases = reparameterise(d, span, np.random.default_rng(0))
    cosines = np.einsum("nid,njd->ijn", bases, span)  # (dim, dim, N)
    sides = (cosines > 0).sum(axis=2)
    return min(stats.binomtest(int(side), len(d)).pvalue for side in sides.flat) > ALPHA


def test_reparameterisation() -> None:
    assert hides_the_descriptor(reparameterise)
    assert shares_nothing_but_d(reparameterise)
    assert is_invariant(reparameterise)
    assert hides_the_directions(reparameterise)


def test_control_an_origin_at_the_descriptor_is_detected() -> None:
    assert not hides_the_descriptor(keeps_the_origin)
    assert not shares_nothing_but_d(keeps_the_origin)
    assert not is_invariant(keeps_the_origin)


def test_control_a_reused_basis_is_detected() -> None:
    assert not shares_nothing_but_d(keeps_the_basis)
    assert not is_invariant(keeps_the_basis)


def test_control_a_basis_with_lapacks_signs_is_detected() -> None:
    assert not is_invariant(keeps_lapacks_signs)
    assert not hides_the_directions(keeps_lapacks_signs)


def test_the_plugins_release_hides_the_descriptor(tmp_path: Path) -> None:
    """The check of `hides_the_descriptor`, for releases of the plugin."""
    secret = make_features(200)
    defense = AFFINE(database=make_database(tmp_path, make_words()))
    release = defense.protect(secret, Public(), np.random.default_rng(0))
    far = np.square(release.origins - secret.descriptors).sum(axis=1)
    assert far.min() > 1e-3
    assert abs(far.mean() - 4 / 3) < 0.4
    # And no basis vector points from the origin to it.
    towards = unit_rows(secret.descriptors - release.origins)
    cosines = np.einsum("nid,nd->ni", release.bases, towards)
    assert (cosines.max(axis=1) > 0.999).mean() < 0.1


# ---- degenerate draws


def test_a_word_that_is_the_descriptor_is_never_drawn() -> None:
    """Half of the sub-database is the descriptor itself, so most draws must be repeated."""
    secret = make_features(1)
    assert secret.codes is not None
    words = np.concatenate([np.repeat(secret.codes, 10, axis=0), make_words(10)])
    d = np.repeat(secret.descriptors, 100, axis=0).astype(float)
    span, _ = lift(d, words, 2, 4, np.random.default_rng(0))
    inside = distances(unit_rows(words[10:]), d, span) < EXACT
    assert (inside.sum(axis=1) == 2).all()
    np.testing.assert_allclose(np.einsum("nid,njd->nij", span, span), np.tile(np.eye(4), (100, 1, 1)), atol=1e-9)


def test_a_database_of_the_descriptor_alone_fails_the_sample() -> None:
    secret = make_features(1)
    assert secret.codes is not None
    with pytest.raises(SampleError, match="every draw of 2 words"):
        lift(secret.descriptors.astype(float), np.repeat(secret.codes, 5, axis=0), 2, 4, np.random.default_rng(0))


# ---- the release and its configuration


def test_shares_no_memory_and_is_a_function_of_the_generator(tmp_path: Path) -> None:
    secret, public = make_features(20), Public()
    defense = AFFINE(database=make_database(tmp_path, make_words()))
    release, again, other = (defense.protect(secret, public, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(release.origins, again.origins)
    np.testing.assert_array_equal(release.bases, again.bases)
    assert np.abs(release.bases - other.bases).max() > 0.01
    np.testing.assert_array_equal(release.keypoints, secret.keypoints)
    secret.keypoints[:] = 0
    secret.descriptors[:] = 0
    np.testing.assert_array_equal(release.keypoints, other.keypoints)
    np.testing.assert_array_equal(release.origins, again.origins)
    assert release.dim == 4


def test_random_lifting_needs_no_database(tmp_path: Path) -> None:
    defense = AFFINE(lifting="random", dim=3, database=Asset(tmp_path / "missing"))
    assert defense.protect(make_features(5), Public(), np.random.default_rng(0)).dim == 3
    assert defense.privacy(Public()) == Privacy("none")


def test_dimensions_up_to_one_below_the_space(tmp_path: Path) -> None:
    secret = make_features(3)
    release = AFFINE(lifting="random", dim=127).protect(secret, Public(), np.random.default_rng(0))
    assert np.diagonal(distances(secret.descriptors, release.origins, release.bases)).max() < EXACT
    with pytest.raises(UserError, match="affine: dim must be below the descriptors' length, 128, got 128"):
        AFFINE(lifting="random", dim=128).protect(secret, Public(), np.random.default_rng(0))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"dim": 0}, "affine: dim must be at least 1, got 0"),
        ({"dim": 3}, "affine: dim must be even with lifting=hybrid, got 3"),
        ({"sub_databases": 0}, "affine: sub_databases must be at least 1, got 0"),
        ({"lifting": "sub-hybrid"}, "affine: lifting must be random, adversarial or hybrid, got sub-hybrid"),
    ],
)
def test_wrong_configuration(wrong: dict, message: str) -> None:
    with pytest.raises(UserError) as caught:
        AFFINE(**wrong)
    assert str(caught.value) == message


def test_odd_dimensions_without_hybrid_lifting() -> None:
    assert AFFINE(lifting="adversarial", dim=3).adversarial == 3
    assert AFFINE(lifting="random", dim=3).adversarial == 0


def test_unsuitable_databases(tmp_path: Path) -> None:
    database = make_database(tmp_path, make_words(47))  # 16 sub-databases of 2 or 3 words
    with pytest.raises(UserError, match="affine: 3 words per keypoint, but 47 words in 16 sub-databases leave 2 each"):
        AFFINE(dim=6, database=database).protect(make_features(2), Public(), np.random.default_rng(0))
    assert AFFINE(dim=4, database=database).protect(make_features(2), Public(), np.random.default_rng(0)).dim == 4
    longer = Features(
        keypoints=np.ones((2, 2), np.float32), descriptors=np.eye(2, 256, dtype=np.float32), codes=None, size=(9, 9)
    )
    with pytest.raises(UserError, match=r"descriptors have length 256, the words of .* 128"):
        AFFINE(database=database).protect(longer, Public(), np.random.default_rng(0))


def test_supported_settings_are_valid() -> None:
    for dim in AFFINE.supported_settings["dim"].values:  # type: ignore[union-attr]
        AFFINE(dim=dim)
    assert 3 not in AFFINE.supported_settings["dim"]
