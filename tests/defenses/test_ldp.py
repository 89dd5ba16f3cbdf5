"""LDP-Feat and the exact ω-subset mechanism beneath it, against enumeration, rational arithmetic and theory.

A statistical check passes at a p-value above ALPHA, with fixed seeds. Each has a control: a wrong mechanism that fails it.
"""

import math
from collections.abc import Callable
from fractions import Fraction
from itertools import combinations
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from bench.api import Privacy
from bench.codebook import dictionary
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.core.exact import Exact, to_fraction
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms import protection
from bench.mechanisms.subset import (
    chance_digits,
    draw_distinct,
    draw_inclusion,
    draw_word_subsets,
    log10_chance,
    most_accurate_size,
    most_informative_size,
    mutual_information,
)
from bench.settings import Asset
from bench.types import Features
from defenses.ldp import PLUGIN as LDP

ALPHA = 1e-4
CERTAINLY_WRONG = 1e-9

Sampler = Callable[[np.ndarray, int, float, int, np.random.Generator], np.ndarray]


# ---- references that share nothing with the implementation


def exp_bounds(power: Fraction, terms: int) -> tuple[Fraction, Fraction]:
    """e^power from Taylor's series in rationals; the remainder is below the last term, once terms > 2 power."""
    total = term = Fraction(1)
    for n in range(1, max(terms, math.ceil(2 * power) + 2)):
        term = term * power / n
        total += term
    return total, total + term


def chance_bounds(epsilon: float, domain: int, size: int, terms: int = 160) -> tuple[Fraction, Fraction]:
    """Return bounds of Eq. (5) in rationals."""
    bounds = exp_bounds(to_fraction(epsilon), terms)
    low, high = (size * power / (size * power + domain - size) for power in bounds)
    return low, high


def short(value: Any) -> str:
    """Return the name of a parameter in pytest's output."""
    return f"2^{value.bit_length() - 1}" if isinstance(value, int) and value > 2**60 else str(value)


def chance(epsilon: float, domain: int, size: int) -> float:
    weight = size * math.exp(epsilon)
    return weight / (weight + domain - size)


def enumerate_sets(epsilon: float, domain: int, size: int) -> dict[tuple[int, ...], list[float]]:
    """Return Pr(Z | v) for all sets Z and all v, normalised to sum to 1 over Z."""
    total = size * math.exp(epsilon) + domain - size
    inside, outside = (domain * weight / total / math.comb(domain, size) for weight in (math.exp(epsilon), 1.0))
    return {Z: [inside if v in Z else outside for v in range(domain)] for Z in combinations(range(domain), size)}


# ---- p, digit by digit


@pytest.mark.parametrize("epsilon", [0.1, 1.0, 8.0, 10.0, 12.5, 16.0, 30.0])
@pytest.mark.parametrize(("domain", "size"), [(6, 2), (256_000, 2), (256_000, 4), (2**1024, 2)], ids=short)
def test_digits_of_p_against_rational_arithmetic(epsilon: float, domain: int, size: int) -> None:
    low, high = chance_bounds(epsilon, domain, size)
    for bits in (1, 64, 128, 192):
        expected = math.floor(low * 2**bits)
        assert expected == math.floor(high * 2**bits), "the reference is not fine enough"
        assert chance_digits(epsilon, domain, size, bits) == expected


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    epsilon=st.floats(0, 20, allow_subnormal=False).filter(lambda e: e == 0 or e > 1e-6),
    domain=st.integers(2, 10**6),
    fraction=st.floats(0, 1),
)
def test_digits_of_p_against_rational_arithmetic_anywhere(epsilon: float, domain: int, fraction: float) -> None:
    size = max(1, round(fraction * domain))
    low, high = chance_bounds(epsilon, domain, size)
    digits = chance_digits(epsilon, domain, size, 64)
    assert math.floor(low * 2**64) <= digits <= math.floor(high * 2**64)


def test_epsilon_is_the_decimal_that_it_is_written_as() -> None:
    """The double 0.1 is not one tenth. Their values of p differ from the 58th digit on."""
    low, high = chance_bounds(0.1, 6, 2)
    binary = [2 * power / (2 * power + 4) for power in exp_bounds(Fraction(0.1), 160)]
    digits = chance_digits(0.1, 6, 2, 128)
    assert math.floor(low * 2**128) == digits == math.floor(high * 2**128)
    assert digits != math.floor(binary[0] * 2**128)


@pytest.mark.parametrize("text", ["1/3", "21/2", "22/7", "0.1000000000000000000000001"])
def test_epsilon_may_be_a_fraction(text: str) -> None:
    low, high = chance_bounds(Exact(text), 6, 2)
    digits = chance_digits(Exact(text), 6, 2, 192)
    assert math.floor(low * 2**192) == digits == math.floor(high * 2**192)
    # The control: the nearest double is another number, unless the fraction is a double.
    assert (digits == chance_digits(float(Exact(text)), 6, 2, 192)) == (text == "21/2")


@pytest.mark.parametrize("epsilon", [100, 1000.0, 1e6, 1e17, 1.7e308])
@pytest.mark.parametrize("domain", [6, 256_000, 2**1024, 2**4096], ids=short)
def test_large_epsilon_neither_overflows_nor_reaches_one(epsilon: float, domain: int) -> None:
    digits = chance_digits(epsilon, domain, 2, 64)
    odds = math.log2(domain) - 1 - epsilon / math.log(2)  # about log2 of (1 - p) / p
    if odds < -64:
        assert digits == 2**64 - 1
    elif odds > 64:
        assert digits == 0
    assert log10_chance(epsilon, domain, 2) <= 0
    # Far enough, the expansion shows that p is not 1; as long as the digits can be written out.
    if epsilon <= 1000:
        assert 0 < chance_digits(epsilon, domain, 2, 8192) < 2**8192 - 1


def test_special_cases_of_p() -> None:
    assert chance_digits(0.0, 6, 2, 64) == 2**64 // 3  # p = m / K
    assert chance_digits(5e-324, 4, 2, 64) == 2**63  # just above one half
    assert chance_digits(math.inf, 6, 2, 64) == 2**64  # p = 1
    assert chance_digits(1.0, 3, 3, 64) == 2**64
    assert log10_chance(math.inf, 6, 2) == 0.0 == log10_chance(1.0, 3, 3)


@pytest.mark.parametrize(
    ("epsilon", "domain", "size"), [(0.0, 6, 2), (10.0, 256_000, 2), (10.0, 2**1024, 2), (16.0, 256_000, 4)], ids=short
)
def test_log10_of_p(epsilon: float, domain: int, size: int) -> None:
    low, _ = chance_bounds(epsilon, domain, size)
    expected = math.log10(low.numerator) - math.log10(low.denominator)
    assert log10_chance(epsilon, domain, size) == pytest.approx(expected, rel=1e-12, abs=1e-12)


# ---- the Bernoulli draw


class Scripted:
    """A generator with a given number of 320 bits per row. It returns the next bits of the rows that still equal p."""

    def __init__(self, numbers: list[int], chance: int) -> None:
        self.numbers, self.chance, self.calls = numbers, chance, 0

    def integers(self, low: int, *, size: int, dtype: Any, endpoint: bool) -> np.ndarray:
        assert (low, dtype, endpoint) == (2**64 - 1, np.uint64, True)
        remaining = 320 - 64 * self.calls  # bits
        undecided = [number for number in self.numbers if number >> remaining == self.chance >> remaining]
        assert len(undecided) == size
        self.calls += 1
        return np.array([number >> (remaining - 64) & (2**64 - 1) for number in undecided], dtype=np.uint64)


@pytest.mark.parametrize(
    ("epsilon", "domain", "size"),
    [(10.0, 256_000, 2), (0.1, 6, 3), (40.0, 7, 2), (10.0, 2**128, 2), (10.0, 2**4096, 2)],
    ids=short,
)
def test_draw_continues_while_the_bits_equal_those_of_p(epsilon: float, domain: int, size: int) -> None:
    low, high = chance_bounds(epsilon, domain, size, terms=400)
    digits = math.floor(low * 2**320)
    assert digits == math.floor(high * 2**320), "the reference is not fine enough"
    near = [digits + sign * 2**digit for digit in (319, 255, 200, 150, 70, 63, 10, 0) for sign in (-1, 1)]
    numbers = [number for number in near if 0 <= number < 2**320]
    expected = [Fraction(number, 2**320) < low for number in numbers]
    rng = Scripted(numbers, digits)
    included = draw_inclusion(len(numbers), epsilon, domain, size, rng)  # type: ignore[arg-type]
    assert included.tolist() == expected
    assert rng.calls == 5
    # The control: 64 bits alone decide wrongly, unless p is so small that no row is included either way.
    assert [number >> 256 < digits >> 256 for number in numbers] != expected or not any(expected)


def test_draw_with_probability_one_and_of_no_rows() -> None:
    rng = np.random.default_rng(0)
    assert draw_inclusion(1000, math.inf, 6, 2, rng).all()
    assert draw_inclusion(1000, 3.0, 2, 2, rng).all()
    assert draw_inclusion(0, 3.0, 6, 2, rng).shape == (0,)
    assert not draw_inclusion(1000, 10.0, 2**4096, 2, rng).any()


# ---- the distribution of the sets


def subsets_fit(sampler: Sampler, domain: int, size: int, epsilon: float, draws: int = 10**6, true: int = 2) -> float:
    """Return the p-value of χ² between `draws` sets and the enumeration."""
    rng = np.random.default_rng([domain, size, int(epsilon * 10)])
    words = sampler(np.full(draws, true), domain, epsilon, size, rng)
    law = enumerate_sets(epsilon, domain, size)
    codes = np.bincount((np.sort(words, axis=1) * domain ** np.arange(size)).sum(axis=1), minlength=domain**size)
    observed = [int(codes[sum(word * domain**digit for digit, word in enumerate(Z))]) for Z in law]
    assert sum(observed) == draws, "a row is no set of `size` words"
    expected = [draws * by_word[true] for by_word in law.values()]
    return float(stats.chisquare(observed, expected).pvalue)


# Some are drawn independently (m² ≤ |K|), some without replacement.
CASES = [(12, 3, 2.0), (6, 2, 0.0), (6, 2, 1.0), (6, 2, 3.0), (6, 3, 0.0), (6, 3, 1.0), (6, 3, 3.0), (6, 1, 1.0), (5, 4, 2.0)]


@pytest.mark.parametrize(("domain", "size", "epsilon"), CASES)
def test_sets_against_enumeration(domain: int, size: int, epsilon: float) -> None:
    assert subsets_fit(draw_word_subsets, domain, size, epsilon) > ALPHA


def test_enumeration_sums_to_one_and_its_ratio_is_e_to_the_epsilon() -> None:
    for domain, size, epsilon in CASES:
        law = enumerate_sets(epsilon, domain, size)
        np.testing.assert_allclose(np.sum(list(law.values()), axis=0), 1.0, rtol=1e-12)
        ratio = max(max(row) / min(row) for row in law.values())
        assert ratio == pytest.approx(math.exp(epsilon), rel=1e-12)
        # Definition 2 as printed has ω in place of |K|, and does not.
        printed = np.sum([np.array(row) * size / domain for row in law.values()], axis=0)
        np.testing.assert_allclose(printed, size / domain, rtol=1e-12)


def mechanism_with(wrong_chance: Callable[[float, int, int], float]) -> Sampler:
    """Return the mechanism with another p."""

    def sample(true: np.ndarray, domain: int, epsilon: float, size: int, rng: np.random.Generator) -> np.ndarray:
        included = rng.random(len(true)) < wrong_chance(epsilon, domain, size)
        words = np.empty((len(true), size), dtype=np.int64)
        for u in (False, True):
            others = draw_distinct(int((included == u).sum()), domain - 1, size - u, rng)
            words[included == u, int(u) :] = others + (others >= true[included == u, None])
        words[included, 0] = true[included]
        return words

    return sample


def true_word_first(true: np.ndarray, domain: int, epsilon: float, size: int, rng: np.random.Generator) -> np.ndarray:
    """Return sets with the right distribution, in an order that reveals the true word."""
    return mechanism_with(chance)(true, domain, epsilon, size, rng)


def test_the_control_mechanism_is_sound_with_the_right_p() -> None:
    assert subsets_fit(mechanism_with(chance), 6, 2, 1.0) > ALPHA


@pytest.mark.parametrize("size", [2, 3])
@pytest.mark.parametrize(
    "wrong",
    [
        lambda e, domain, m: chance(e, domain + 1, m),  # |K| off by one
        lambda e, domain, m: m * math.exp(e) / (m * math.exp(e) + domain),  # |K| for |K| − m
        lambda e, domain, m: math.exp(e) / (math.exp(e) + domain - 1),  # k-ary randomised response
        lambda e, domain, m: m / domain * chance(e, domain, m),  # Definition 2 as printed
        lambda e, domain, m: chance(e + 0.02, domain, m),  # a little above the guarantee
    ],
    ids=["larger K", "K for K - m", "k-RR", "printed", "epsilon + .02"],
)
def test_control_a_wrong_p_fails(wrong: Callable[[float, int, int], float], size: int) -> None:
    assert subsets_fit(mechanism_with(wrong), 6, size, 1.0) < CERTAINLY_WRONG


def test_control_others_that_may_be_the_true_word_fail() -> None:
    def unshifted(true: np.ndarray, domain: int, epsilon: float, size: int, rng: np.random.Generator) -> np.ndarray:
        """Draw the other words from all of K if u = 0."""
        included = draw_inclusion(len(true), epsilon, domain, size, rng)
        words = draw_word_subsets(true, domain, math.inf, size, rng)
        words[~included] = draw_distinct(int((~included).sum()), domain, size, rng)
        return words

    assert subsets_fit(unshifted, 6, 2, 1.0) < CERTAINLY_WRONG


def sampled_ratio(epsilon: float, domain: int, size: int, included: Fraction) -> Fraction:
    """Return the greatest Pr(Z | v1) / Pr(Z | v2) of the mechanism's steps: u with probability `included`, then a uniform set."""
    law = {
        Z: [
            included / math.comb(domain - 1, size - 1) if v in Z else (1 - included) / math.comb(domain - 1, size)
            for v in range(domain)
        ]
        for Z in combinations(range(domain), size)
    }
    assert all(sum(row[v] for row in law.values()) == 1 for v in range(domain))
    return max(max(row) / min(row) for row in law.values())


@pytest.mark.parametrize(("domain", "size", "epsilon"), [case for case in CASES if case[0] > case[1]])
def test_ratio_of_any_two_words_is_e_to_the_epsilon_and_no_more(domain: int, size: int, epsilon: float) -> None:
    included = Fraction(chance_digits(epsilon, domain, size, 256), 2**256)
    bounds = exp_bounds(Fraction(repr(epsilon)), 160)
    assert abs(sampled_ratio(epsilon, domain, size, included) - bounds[0]) < Fraction(1, 2**200)


def test_control_a_ratio_of_a_wrong_p_exceeds_e_to_the_epsilon() -> None:
    included = Fraction(chance(1.0, 6, 2)) + Fraction(1, 10**6)
    assert sampled_ratio(1.0, 6, 2, included) > exp_bounds(Fraction(1), 60)[1]


def test_inclusion_at_full_size() -> None:
    """At |K| = 256,000, ε = 10 and m = 2 the true word is included with probability .1468; all others are equally likely."""
    domain, size, epsilon, draws = 256_000, 2, 10.0, 400_000
    rng = np.random.default_rng(0)
    true = rng.integers(domain, size=draws)
    words = draw_word_subsets(true, domain, epsilon, size, rng)
    included = (words == true[:, None]).any(axis=1)
    expected = chance(epsilon, domain, size)
    assert expected == pytest.approx(0.1468, abs=1e-4)
    assert stats.binomtest(int(included.sum()), draws, expected).pvalue > ALPHA
    assert stats.binomtest(int(included.sum()), draws, chance(10.05, domain, size)).pvalue < ALPHA  # the control
    # The others' distance from the true word is uniform on 1 .. |K| − 1.
    distance = ((words - true[:, None]) % domain)[words != true[:, None]]
    assert distance.min() > 0
    counts = np.bincount((distance - 1) * 100 // (domain - 1), minlength=100)
    ends = np.ceil(np.arange(101) * (domain - 1) / 100)
    assert stats.chisquare(counts, counts.sum() * np.diff(ends) / (domain - 1)).pvalue > ALPHA


@settings(max_examples=80, deadline=None)
@given(domain=st.integers(1, 40), data=st.data())
def test_distinct_numbers_are_distinct_and_in_range(domain: int, data: st.DataObject) -> None:
    size = data.draw(st.integers(0, domain))
    numbers = draw_distinct(20, domain, size, np.random.default_rng(data.draw(st.integers(0, 2**32))))
    assert numbers.shape == (20, size)
    assert all(len(set(row)) == size for row in numbers.tolist())
    assert size == 0 or (numbers.min() >= 0 and numbers.max() < domain)


def test_more_distinct_numbers_than_there_are() -> None:
    with pytest.raises(ValueError, match="cannot draw 3 distinct numbers from 2"):
        draw_distinct(1, 2, 3, np.random.default_rng(0))


@settings(max_examples=80, deadline=None)
@given(domain=st.integers(1, 40), epsilon=st.floats(0, 50) | st.just(math.inf), data=st.data())
def test_every_row_is_a_set_of_words(domain: int, epsilon: float, data: st.DataObject) -> None:
    size = data.draw(st.integers(1, domain))
    true = np.array(data.draw(st.lists(st.integers(0, domain - 1), max_size=20)), dtype=np.int64)
    words = draw_word_subsets(true, domain, epsilon, size, np.random.default_rng(data.draw(st.integers(0, 2**32))))
    assert words.shape == (len(true), size)
    assert (np.diff(words, axis=1) > 0).all()
    assert words.size == 0 or (words.min() >= 0 and words.max() < domain)
    if math.isinf(epsilon) or size == domain:
        assert (words == true[:, None]).any(axis=1).all()


# ---- order


def order_fits(sampler: Sampler, domain: int = 1000, size: int = 3) -> float:
    """Return the p-value of the hypothesis that an included true word has all positions equally often. True words are uniform."""
    rng = np.random.default_rng(5)
    true = rng.integers(domain, size=200_000)
    words = sampler(true, domain, 5.0, size, rng)
    positions = np.nonzero(words == true[:, None])[1]
    return float(stats.chisquare(np.bincount(positions, minlength=size)).pvalue)


def test_the_order_of_words_reveals_nothing() -> None:
    assert order_fits(draw_word_subsets) > ALPHA
    words = draw_word_subsets(np.arange(1000), 1000, 5.0, 4, np.random.default_rng(0))
    assert (np.diff(words, axis=1) > 0).all()  # a function of the set alone


def test_control_the_true_word_first_is_detected() -> None:
    assert subsets_fit(true_word_first, 6, 2, 1.0) > ALPHA  # the sets alone do not show it
    assert order_fits(true_word_first) < CERTAINLY_WRONG


# ---- mutual information


@pytest.mark.parametrize(("domain", "size", "epsilon"), CASES)
def test_information_against_enumeration(domain: int, size: int, epsilon: float) -> None:
    law = np.array(list(enumerate_sets(epsilon, domain, size).values()))  # (sets, words)
    marginal = law.mean(axis=1, keepdims=True)
    expected = (law / domain * np.log(law / marginal)).sum()
    assert mutual_information(epsilon, domain, np.array([size]))[0] == pytest.approx(expected, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("domain", "epsilon"), [(256_000, 10.0), (256_000, 8.0), (262_144, 12.0), (1000, 0.1), (64, 2.0), (50, 300.0)]
)
def test_the_most_informative_size(domain: int, epsilon: float) -> None:
    best = most_informative_size(epsilon, domain)
    chance_true = [chance(epsilon, domain, m) for m in range(1, domain)] if epsilon < 30 else None
    if chance_true is not None:  # independently: I = H(Z) − H(Z | v) without the logarithms of binomials
        included = np.array(chance_true)
        m = np.arange(1, domain)
        with np.errstate(divide="ignore", invalid="ignore"):
            information = included * np.log(included / m * domain) + (1 - included) * np.log((1 - included) / (1 - m / domain))
        assert best == 1 + int(np.nanargmax(information))
    e = math.exp(epsilon)
    assert abs(best - max(1, domain * ((epsilon - 1) * e + 1) / (e - 1) ** 2)) <= 1


def test_the_two_optima_at_full_size() -> None:
    """Mutual information is greatest at about nine times |K| / (e^ε + 1)."""
    assert most_accurate_size(10.0, 256_000) == most_accurate_size(10.0, 262_144) == 12
    assert most_informative_size(10.0, 256_000) == 105
    information = mutual_information(10.0, 256_000, np.array([2, 12, 105]))
    assert information[2] > 1.5 * information[1] > 4 * information[0]
    assert most_informative_size(0.01, 1000) == pytest.approx(500, abs=3) == most_accurate_size(0.01, 1000)
    assert most_informative_size(math.inf, 1000) == 1


def test_the_accurate_size_has_the_least_variance() -> None:
    """Of the unbiased estimate of a rare word's frequency: q (1 − q) / (p − q)², q the rate of a wrong word."""

    def variance(epsilon: float, domain: int, size: int) -> float:
        p = chance(epsilon, domain, size)
        q = (size - p) / (domain - 1)
        return q * (1 - q) / (p - q) ** 2

    for epsilon, domain in ((10.0, 256_000), (3.0, 1000), (0.5, 100)):
        least = min(range(1, 500 if domain > 500 else domain), key=lambda m: variance(epsilon, domain, m))
        assert abs(most_accurate_size(epsilon, domain) - least) <= 1


# ---- an independent implementation


@pytest.mark.slow
def test_inclusion_rates_against_multi_freq_ldpy() -> None:
    """They are compared as sets. The order of its words reveals the true word, as `test_audit.py` detects."""
    from multi_freq_ldpy.pure_frequency_oracles.SS import SS_Client

    domain, epsilon, true, rows = 64, 2.0, 20, 30_000
    size = most_accurate_size(epsilon, domain)
    np.random.seed(1)  # noqa: NPY002  # its source of randomness
    sets = np.stack([SS_Client.py_func(true, domain, epsilon) for _ in range(rows)])
    assert sets.shape == (rows, size)
    theirs = np.bincount(sets.ravel(), minlength=domain)
    rng = np.random.default_rng(2)

    def agree(ours: np.ndarray) -> float:
        """Return the smaller p-value of two hypotheses: equal rates of the true word, and equal rates of the others."""
        counts = np.bincount(ours.ravel(), minlength=domain)
        true_word = stats.chi2_contingency(
            [[counts[true], rows - counts[true]], [theirs[true], rows - theirs[true]]], correction=False
        )
        others = stats.chi2_contingency([np.delete(counts, true), np.delete(theirs, true)])
        return min(true_word.pvalue, others.pvalue)

    assert agree(draw_word_subsets(np.full(rows, true), domain, epsilon, size, rng)) > ALPHA
    assert agree(draw_word_subsets(np.full(rows, true), domain, epsilon + 0.1, size, rng)) < ALPHA  # the controls
    assert agree(np.minimum(draw_word_subsets(np.full(rows, true), domain, epsilon, size, rng), domain - 2)) < ALPHA


# ---- the plugin


def make_dictionary(path: Path, size: int) -> Asset:
    words = np.random.default_rng(1).integers(1, 150, size=(size, 128), dtype=np.uint8)
    dictionary.save(path / f"{size}.safetensors", words, {"photographs": []})
    return Asset(path / f"{size}.safetensors")


def make_features(count: int, seed: int = 0) -> Features:
    rng = np.random.default_rng(seed)
    codes = rng.integers(1, 150, size=(count, 128), dtype=np.uint8)
    keypoints = rng.uniform(0, 64, (count, 2)).astype(np.float32)
    return Features(keypoints=keypoints, descriptors=unit_rows(codes), codes=codes, size=(64, 48))


def nearest_by_hand(secret: Features, words: np.ndarray) -> np.ndarray:
    assert secret.codes is not None
    cosines = secret.codes.astype(float) @ words.astype(float).T / np.linalg.norm(words.astype(float), axis=1)
    return cosines.argmax(axis=1)


def test_releases_words_and_nothing_of_the_secret(tmp_path: Path) -> None:
    asset = make_dictionary(tmp_path, 300)
    secret, public = make_features(50), Public()
    release = LDP(dictionary=asset, subset_size=3).protect(secret, public, np.random.default_rng(0))
    words = public.dictionary(asset).words
    assert release.words is not None
    assert release.words.shape == (50, 3)
    assert (np.diff(release.words, axis=1) > 0).all()
    np.testing.assert_array_equal(release.candidates, unit_rows(words[release.words]))
    np.testing.assert_allclose(np.linalg.norm(release.candidates, axis=2), 1, atol=1e-6)
    assert (release.candidates.dtype, release.words.dtype) == (np.float32, np.int64)
    assert release.size == secret.size
    copies = [array.copy() for array in (release.keypoints, release.candidates, release.words)]
    np.testing.assert_array_equal(release.keypoints, secret.keypoints)
    for array in (secret.keypoints, secret.descriptors, secret.codes, public.nearest_words(asset, secret), words):
        assert array is not None
        array[:] = 0
    for before, after in zip(copies, (release.keypoints, release.candidates, release.words), strict=True):
        np.testing.assert_array_equal(before, after)


def test_is_a_function_of_the_generator(tmp_path: Path) -> None:
    defense, secret = LDP(dictionary=make_dictionary(tmp_path, 300)), make_features(50)
    first, again, other = (defense.protect(secret, Public(), np.random.default_rng(seed)).words for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_infinite_epsilon_is_quantisation(tmp_path: Path) -> None:
    asset = make_dictionary(tmp_path, 300)
    secret, public = make_features(50), Public()
    nearest = nearest_by_hand(secret, public.dictionary(asset).words)
    alone = LDP(dictionary=asset, epsilon=math.inf, subset_size=1).protect(secret, public, np.random.default_rng(0))
    np.testing.assert_array_equal(alone.words, nearest[:, None])
    more = LDP(dictionary=asset, epsilon=math.inf, subset_size=4).protect(secret, public, np.random.default_rng(0))
    assert more.words is not None
    assert (more.words == nearest[:, None]).any(axis=1).all()
    assert LDP(dictionary=asset, epsilon=math.inf).privacy(public) == Privacy("none", None, 0.0)


def test_the_plugins_sets_against_enumeration(tmp_path: Path) -> None:
    """The same χ² for the plugin's releases, over all true words."""
    asset = make_dictionary(tmp_path, 6)
    secret, public = make_features(20_000), Public()
    nearest = nearest_by_hand(secret, public.dictionary(asset).words)
    release = LDP(dictionary=asset, epsilon=1.0, subset_size=2).protect(secret, public, np.random.default_rng(3))
    assert release.words is not None
    law = enumerate_sets(1.0, 6, 2)
    table = np.zeros((6, len(law)), dtype=int)
    columns = {Z: column for column, Z in enumerate(law)}
    for true, Z in zip(nearest.tolist(), map(tuple, release.words.tolist()), strict=True):
        table[true, columns[Z]] += 1
    expected = table.sum(axis=1, keepdims=True) * np.array(list(law.values())).T
    used = table.sum(axis=1) > 0
    assert used.sum() >= 3
    statistic = ((table - expected)[used] ** 2 / expected[used]).sum()
    assert stats.chi2.sf(statistic, used.sum() * (len(law) - 1)) > ALPHA
    # The control: read as a release of ε = 1.2, it does not fit.
    other = table.sum(axis=1, keepdims=True) * np.array(list(enumerate_sets(1.2, 6, 2).values())).T
    assert stats.chi2.sf(((table - other)[used] ** 2 / other[used]).sum(), used.sum() * (len(law) - 1)) < ALPHA


def test_privacy_states_epsilon_and_the_chance_of_the_true_word(tmp_path: Path) -> None:
    promised = LDP(dictionary=make_dictionary(tmp_path, 300), epsilon=4, subset_size=3).privacy(Public())
    assert (promised.guarantee, promised.epsilon) == ("epsilon-ldp", 4)
    assert promised.log10_true == pytest.approx(math.log10(chance(4, 300, 3)), rel=1e-12)


def test_as_many_words_as_the_dictionary_has(tmp_path: Path) -> None:
    defense = LDP(dictionary=make_dictionary(tmp_path, 4), subset_size=4)
    release = defense.protect(make_features(10), Public(), np.random.default_rng(0))
    np.testing.assert_array_equal(release.words, np.tile(np.arange(4), (10, 1)))
    assert defense.privacy(Public()).log10_true == 0.0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"epsilon": -1}, "ldp: epsilon must be at least 0, got -1"),
        ({"epsilon": math.nan}, "ldp: epsilon must be at least 0, got nan"),
        ({"epsilon": -math.inf}, "ldp: epsilon must be at least 0, got -inf"),
        ({"subset_size": 0}, "ldp: subset_size must be at least 1, got 0"),
    ],
)
def test_wrong_configuration(wrong: dict, message: str) -> None:
    with pytest.raises(UserError) as caught:
        LDP(**wrong)
    assert str(caught.value) == message


def test_unsuitable_dictionaries(tmp_path: Path) -> None:
    small = LDP(dictionary=make_dictionary(tmp_path, 3), subset_size=4)
    for use in (
        lambda: small.privacy(Public()),
        lambda: small.protect(make_features(5), Public(), np.random.default_rng(0)),
    ):
        with pytest.raises(UserError, match="ldp: subset_size is 4, but the dictionary has 3 words"):
            use()
    longer = Features(
        keypoints=np.ones((2, 2), np.float32), descriptors=np.eye(2, 256, dtype=np.float32), codes=None, size=(9, 9)
    )
    with pytest.raises(UserError, match=r"descriptors have length 256, the words of .* 128"):
        LDP(dictionary=make_dictionary(tmp_path, 3)).protect(longer, Public(), np.random.default_rng(0))
    signed = LDP(dictionary=write_dictionary(tmp_path, signed=True))
    with pytest.raises(UserError, match=r"8-bit vectors of SIFT, the words of .* have signs"):
        signed.protect(draw_features(), Public(), np.random.default_rng(0))
    signed.protect(draw_features(signed=True), Public(), np.random.default_rng(0))
    with pytest.raises(UserError, match="no such file"):
        LDP(dictionary=Asset(tmp_path / "missing")).privacy(Public())


def test_floats_without_codes_are_quantised_too(tmp_path: Path) -> None:
    asset, secret = make_dictionary(tmp_path, 300), make_features(20)
    floats = Features(keypoints=secret.keypoints, descriptors=secret.descriptors, codes=None, size=secret.size)
    one = LDP(dictionary=asset, epsilon=math.inf, subset_size=1)
    np.testing.assert_array_equal(
        one.protect(floats, Public(), np.random.default_rng(0)).words,
        nearest_by_hand(secret, Public().dictionary(asset).words)[:, None],
    )


def test_supported_settings_are_valid() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        LDP(**{name: setting.sample(rng) for name, setting in LDP.supported_settings.items()})
    assert 12.0 in LDP.supported_settings["epsilon"]
    assert math.inf not in LDP.supported_settings["epsilon"]
    assert 5 not in LDP.supported_settings["subset_size"]


# ---- memoization


def repeating_features(count: int) -> Features:
    """Return features with each of `count` descriptors twice."""
    return make_features(count).take(np.repeat(np.arange(count), 2))


def test_equal_words_get_equal_answers_only_when_memoized(tmp_path: Path) -> None:
    asset, secret = make_dictionary(tmp_path, 300), repeating_features(60)
    memoized = LDP(dictionary=asset, memoize=True).protect(secret, Public(), np.random.default_rng(0)).words
    assert memoized is not None
    np.testing.assert_array_equal(memoized[::2], memoized[1::2])
    forgotten = LDP(dictionary=asset).protect(secret, Public(), np.random.default_rng(0)).words
    assert forgotten is not None
    assert (forgotten[::2] != forgotten[1::2]).any(axis=1).sum() > 40


@pytest.mark.slow
def test_memoized_answers_have_the_law_of_the_mechanism(tmp_path: Path) -> None:
    """The law is that of answers over devices, not over keypoints."""
    asset, public = make_dictionary(tmp_path, 6), Public()
    one, defense = make_features(1), LDP(dictionary=asset, epsilon=1.0, memoize=True)
    nearest = int(nearest_by_hand(one, public.dictionary(asset).words)[0])
    draws = 4000
    releases = [defense.protect(one, public, np.random.default_rng(device)).words for device in range(draws)]
    found = [tuple(words[0].tolist()) for words in releases if words is not None]
    law = enumerate_sets(1.0, 6, 2)
    observed, expected = [found.count(Z) for Z in law], [draws * by_word[nearest] for by_word in law.values()]
    assert stats.chisquare(observed, expected).pvalue > ALPHA
    wrong = [draws * by_word[(nearest + 1) % 6] for by_word in law.values()]
    assert stats.chisquare(observed, wrong).pvalue < ALPHA  # the control


def test_a_memoized_defense_has_another_guarantee(tmp_path: Path) -> None:
    asset = make_dictionary(tmp_path, 300)
    memoized, forgetful = (LDP(dictionary=asset, memoize=memoize) for memoize in (True, False))
    assert (memoized.is_memoized(), forgetful.is_memoized()) == (True, False)
    assert memoized.privacy(Public()).guarantee == "epsilon-ldp-by-word"
    assert forgetful.privacy(Public()).guarantee == "epsilon-ldp"


# ---- speed


ROWS = 100_000
SPEEDS = [(2, 64, "seeded"), (2, 256_000, "seeded"), (2, 2**30, "seeded"), (12, 256_000, "seeded"), (2, 256_000, "cipher")]


def works(size: int, domain: int, generator: str) -> dict[str, Callable[[], object]]:
    """Sampling, and its floor: drawing m + 1 random 64-bit numbers per descriptor."""
    rng = protection.create_generator(bytes(32)) if generator == "cipher" else np.random.default_rng(0)
    true = np.random.default_rng(1).integers(domain, size=ROWS)
    return {
        "sets": lambda: draw_word_subsets(true, domain, 10.0, size, rng),
        "random words": lambda: rng.integers(2**64 - 1, size=(ROWS, size + 1), dtype=np.uint64, endpoint=True),
    }


@pytest.mark.benchmark
@pytest.mark.parametrize("work", ["random words", "sets"])
@pytest.mark.parametrize(("size", "domain", "generator"), SPEEDS, ids=short)
def test_speed_of_sampling(benchmark: Any, size: int, domain: int, generator: str, work: str) -> None:
    benchmark.group = f"m = {size}, |K| = {short(domain)}, {generator}"
    benchmark(works(size, domain, generator)[work])


@pytest.mark.benchmark
@pytest.mark.parametrize(("size", "domain", "generator"), SPEEDS, ids=short)
def test_sampling_takes_at_most_five_times_its_floor(benchmark: Any, size: int, domain: int, generator: str) -> None:
    """Alternating, in processor time, so that other processes have little effect."""
    seconds: dict[str, list[float]] = {}

    def both() -> None:
        for name, work in works(size, domain, generator).items():
            started = process_time()
            work()
            seconds.setdefault(name, []).append(process_time() - started)

    benchmark.group = "both"
    benchmark.pedantic(both, rounds=15)
    assert min(seconds["sets"]) <= 5 * min(seconds["random words"])
