"""Plateau against enumeration and theory; with a plateau of one word it is `ldp`."""

import dataclasses
import math
from collections import Counter
from fractions import Fraction
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from bench.audit.auditor import audit, create_features_near_words
from bench.audit.exhaustive import compute_law
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.core.exact import Exact
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.subset import chance_digits, draw_word_subsets
from bench.types import Features, Points, WordSets
from defenses.ldp import LDP
from defenses.plateau import Plateau, draw_plateau_subsets

ALPHA, CERTAINLY_WRONG = 1e-4, 1e-9


def theorem(plateau: set[int], domain: int, epsilon: float, size: int) -> dict[tuple[int, ...], float]:
    """Return Pr(Z | v) for all sets Z, by counting those with a word of the plateau."""
    sets = list(combinations(range(domain), size))
    weights = [math.exp(epsilon) if plateau & set(Z) else 1.0 for Z in sets]
    return {Z: weight / sum(weights) for Z, weight in zip(sets, weights, strict=True)}


CASES = [(7, 1, 1, 1.0), (7, 2, 2, 1.5), (6, 3, 2, 0.5), (8, 2, 4, 2.0), (5, 4, 3, 1.0), (6, 2, 5, 1.0), (7, 1, 3, 0.0)]


@pytest.mark.slow
@pytest.mark.parametrize(("domain", "size", "near", "epsilon"), CASES)
def test_sets_against_the_theorem(domain: int, size: int, near: int, epsilon: float) -> None:
    draws = 100_000
    plateau = np.sort(np.random.default_rng(near).permutation(domain)[:near])
    drawn = draw_plateau_subsets(np.tile(plateau, (draws, 1)), domain, epsilon, size, np.random.default_rng(0))
    assert (np.diff(drawn, axis=1) > 0).all()
    observed = Counter(map(tuple, drawn.tolist()))
    expected = theorem(set(plateau.tolist()), domain, epsilon, size)
    assert stats.chisquare([observed[Z] for Z in expected], [draws * chance for chance in expected.values()]).pvalue > ALPHA
    if epsilon and near + size <= domain:
        control = theorem(set(plateau.tolist()), domain, epsilon + 0.4, size)
        assert stats.chisquare([observed[Z] for Z in expected], [draws * chance for chance in control.values()]).pvalue < 1e-6


@pytest.mark.slow
def test_the_sampler_has_the_law_of_the_theorem() -> None:
    """All sequences of draws are enumerated. The law agrees to within 2^-58, the precision of p."""
    domain, size, epsilon = 5, 2, 1.0
    intersecting, every = math.comb(5, 2) - math.comb(3, 2), math.comb(5, 2)
    p = Fraction(chance_digits(epsilon, every, intersecting, 128), 2**128)
    found = compute_law(lambda rng: tuple(draw_plateau_subsets(np.array([[1, 3]]), domain, epsilon, size, rng)[0].tolist()))
    for Z in combinations(range(domain), size):
        expected = p / intersecting if {1, 3} & set(Z) else (1 - p) / (every - intersecting)
        assert found.chances[Z] <= expected + Fraction(1, 2**120)
        assert expected <= found.at_most(Z) + Fraction(1, 2**120)


@pytest.mark.slow
def test_a_plateau_of_one_is_ldp() -> None:
    for size in (1, 2):
        laws = [
            compute_law(lambda rng: tuple(draw_plateau_subsets(np.array([[2]]), 4, 1.5, size, rng)[0].tolist())),  # noqa: B023
            compute_law(lambda rng: tuple(draw_word_subsets(np.array([2]), 4, 1.5, size, rng)[0].tolist())),  # noqa: B023
        ]
        assert laws[0].chances.keys() == laws[1].chances.keys()
        for Z, chance in laws[0].chances.items():
            assert abs(chance - laws[1].chances[Z]) < Fraction(1, 2**56)


def test_near_words_are_released_nearly_as_often_as_the_true_one(tmp_path: Path) -> None:
    public, asset = Public(), write_dictionary(tmp_path, 400)
    loaded = public.dictionary(asset)
    secrets = create_features_near_words(LDP(dictionary=asset), public).take(np.full(4000, 17))
    T = loaded.neighbours.find_nearest(np.array([17]), 4)[0]
    release = Plateau(epsilon=4.0, near=4, dictionary=asset).protect(secrets, public, np.random.default_rng(0))
    rates = np.array([(release.words == word).any(axis=1).mean() for word in T])
    chance_true = 10 ** (Plateau(epsilon=4.0, near=4, dictionary=asset).privacy(public).log10_true or 0)
    np.testing.assert_allclose(rates, chance_true, atol=0.03)
    ldp = 10 ** (LDP(epsilon=4.0, dictionary=asset).privacy(public).log10_true or 0)
    assert chance_true < ldp < rates.sum()
    np.testing.assert_allclose(release.candidates, unit_rows(loaded.words[release.words]))


def test_the_chance_of_the_true_word_against_the_theorem(tmp_path: Path) -> None:
    for domain, size, near, epsilon in ((12, 3, 4, 1.5), (9, 1, 2, 0.5), (6, 4, 3, 2.0)):
        defense = Plateau(epsilon=epsilon, subset_size=size, near=near, dictionary=write_dictionary(tmp_path, domain))
        expected = sum(chance for Z, chance in theorem(set(range(near)), domain, epsilon, size).items() if 0 in Z)
        assert 10 ** (defense.privacy(Public()).log10_true or 0) == pytest.approx(expected, rel=1e-9)
    assert Plateau(epsilon=math.inf, dictionary=write_dictionary(tmp_path)).privacy(Public()).guarantee == "none"


# ---- the audit


@pytest.mark.slow
@pytest.mark.parametrize(
    ("defense", "words"),
    [(Plateau(epsilon=2.0), 64), (Plateau(epsilon=Exact("1/3"), subset_size=1, near=2), 4), (Plateau(epsilon=100.0), 64)],
)
def test_the_guarantee_holds(defense: Plateau, words: int, tmp_path: Path) -> None:
    found = audit(defense, words, 10_000, 0, tmp_path)
    assert found.verdict != "violated"
    if defense.epsilon == 2.0:
        assert found.strongest.epsilon > 1.3
    if words == 4:
        assert found.enumeration is not None
        assert found.enumeration.low == pytest.approx(1 / 3, abs=1e-14) == found.enumeration.high


@dataclasses.dataclass(frozen=True, kw_only=True)
class OneWordForAll(Plateau):
    """Includes the true word as often as a plateau of `near` words may include any of them."""

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        loaded = public.dictionary(self.dictionary)
        release = super().protect(secret, public, rng)
        true, words = public.nearest_words(self.dictionary, secret), release.words
        assert words is not None
        intersecting = (loaded.neighbours.find_nearest(true, self.near)[:, :, None] == words[:, None]).any(axis=(1, 2))
        replaced = intersecting & ~(words == true[:, None]).any(axis=1)
        words[replaced, 0] = true[replaced]
        words = np.sort(words, axis=1)
        return dataclasses.replace(release, words=words, candidates=unit_rows(loaded.words[words]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class AsManyAsAreAlike(Plateau):
    """Uses a larger plateau for one half of the dictionary, so that normalisers differ."""

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        loaded = public.dictionary(self.dictionary)
        words = np.empty((len(secret), self.subset_size), dtype=np.int64)
        for row, true in enumerate(public.nearest_words(self.dictionary, secret)):
            plateau = loaded.neighbours.find_nearest(np.array([true]), self.near + 1 if true < len(loaded) // 2 else 1)
            words[row] = draw_plateau_subsets(plateau, len(loaded), self.epsilon, self.subset_size, rng)[0]
        return WordSets(
            positions=Points(keypoints=secret.keypoints.copy()),
            size=secret.size,
            candidates=unit_rows(loaded.words[words]),
            words=words,
        )


@pytest.mark.slow
def test_broken_variants_are_detected(tmp_path: Path) -> None:
    found = audit(OneWordForAll(epsilon=2.0), 64, 20_000, 0, tmp_path)
    assert {finding.family for finding in found.findings if finding.certain_epsilon > 2.0} >= {"membership"}
    found = audit(AsManyAsAreAlike(epsilon=0.5, subset_size=1, near=2), 4, 400, 0, tmp_path)
    assert found.enumeration is not None
    assert found.enumeration.exceeds


# ---- configuration


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"epsilon": -1.0}, "epsilon must be at least 0"),
        ({"near": 0}, "near must be at least 1"),
        ({"subset_size": 0}, "subset_size and near must be at least 1"),
        ({"words": 1}, "words must be 0 for all"),
    ],
)
def test_invalid_settings_are_refused(given: dict[str, float], complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        Plateau(**given)  # type: ignore[arg-type]


def test_a_dictionary_with_too_few_words_is_refused(tmp_path: Path) -> None:
    defense = Plateau(near=9, dictionary=write_dictionary(tmp_path, 8))
    with pytest.raises(UserError, match="near 9, but the dictionary has 8 words"):
        defense.protect(draw_features(3), Public(), np.random.default_rng(0))
