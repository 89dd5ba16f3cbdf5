"""Exact draws of classes against rational arithmetic, given bits and expected frequencies."""

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from bench.mechanisms.classes import chances, draw_classes, edges, exponentials
from bench.mechanisms.subset import chance_digits

ALPHA, CERTAINLY_WRONG = 1e-4, 1e-9


def exp_bounds(power: Fraction, terms: int = 120) -> tuple[Fraction, Fraction]:
    """e^power for power ≥ 0 from Taylor's series in rationals; the remainder is below the last term, once terms > 2 power."""
    total = term = Fraction(1)
    for n in range(1, max(terms, math.ceil(2 * power) + 2)):
        term = term * power / n
        total += term
    return total, total + term


def compute_reference_edges(counts: list[int], powers: list[Fraction], bits: int) -> list[int]:
    """Return the result of `edges`, computed with rationals alone."""
    least = min(powers)
    bounds = [exp_bounds(power - least) for power in powers]
    found = []
    for index in range(1, len(counts)):
        ends = []
        for lower, upper in ((0, 1), (1, 0)):
            below = sum(count * bound[lower] for count, bound in zip(counts[:index], bounds[:index], strict=True))
            above = sum(count * bound[upper] for count, bound in zip(counts[index:], bounds[index:], strict=True))
            ends.append(math.floor(below / (below + above) * 2**bits))
        assert ends[0] == ends[1], "the reference is not fine enough"
        found.append(ends[0])
    return found


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    counts=st.lists(st.integers(0, 10**6), min_size=2, max_size=6).filter(any),
    step=st.fractions(0, 4, max_denominator=64).filter(lambda f: f == 0 or f > Fraction(1, 100)),
    bits=st.sampled_from([1, 64, 128]),
)
def test_edges_against_rational_arithmetic(counts: list[int], step: Fraction, bits: int) -> None:
    powers = [step * index for index in range(len(counts))]
    assert edges(counts, powers, bits) == compute_reference_edges(counts, powers, bits)


def test_two_classes_are_the_coin_of_the_subset_mechanism() -> None:
    for epsilon, domain, size in (("0.1", 6, 2), ("10", 256_000, 2), ("100", 6, 3), ("1000", 7, 2)):
        powers = [Fraction(epsilon), Fraction(0)]
        for bits in (64, 192):
            assert edges([size, domain - size], powers, bits) == [chance_digits(float(epsilon), domain, size, bits)]


def test_special_cases() -> None:
    assert edges([0, 3, 0], [Fraction(1), Fraction(2), Fraction(3)], 64) == [0, 2**64]
    assert edges([1, 2], [Fraction(5)] * 2, 8) == [2**8 // 3]
    assert edges([1, 0, 1], [Fraction(0), Fraction(10**9), Fraction(0)], 8) == [2**7, 2**7]  # an empty class
    assert edges([1, 1], [Fraction(0), Fraction(10**6)], 64) == [0]
    assert edges([1, 1], [Fraction(10**6), Fraction(0)], 64) == [2**64 - 1]  # below 1, however little
    below, above = exponentials((Fraction(-1, 3),), 200)[0]
    assert below < math.exp(-1 / 3) * 2**200 * (1 + 1e-15)
    assert above > math.exp(-1 / 3) * 2**200 * (1 - 1e-15)
    assert 1 <= above - below <= 3


class Scripted:
    """A generator that returns given numbers, 64 bits at a time."""

    def __init__(self, *numbers: int) -> None:
        self.numbers = list(numbers)

    def integers(self, low: int, *, dtype: Any, endpoint: bool, size: int | None = None) -> Any:
        assert (low, dtype, endpoint) == (2**64 - 1, np.uint64, True)
        taken = [self.numbers.pop(0) for _ in range(size or 1)]
        return np.array(taken, dtype=np.uint64) if size else taken[0]


def test_draw_continues_where_bits_equal_those_of_an_edge() -> None:
    counts, powers = [5, 7, 11], [Fraction(0), Fraction(1, 2), Fraction(1)]
    first, second = edges(counts, powers, 64), edges(counts, powers, 192)
    words = [[edge >> shift & (2**64 - 1) for shift in (128, 64, 0)] for edge in second]
    for index in (0, 1):
        assert words[index][0] == first[index]
        for last, expected in ((words[index][2] - 1, index), (words[index][2] + 1, index + 1)):
            rng = Scripted(first[index], words[index][1], last)
            assert draw_classes([counts], powers, np.zeros(1, dtype=np.int64), rng)[0] == expected  # type: ignore[arg-type]
            assert rng.numbers == []
    rng = Scripted(0, first[0] - 1, first[0] + 1, first[1] + 1, 2**64 - 1)
    assert draw_classes([counts], powers, np.zeros(5, dtype=np.int64), rng).tolist() == [0, 0, 1, 2, 2]  # type: ignore[arg-type]


@pytest.mark.parametrize("powers", [[0, 0, 0], [0, 1, 2]])
def test_frequencies(powers: list[int]) -> None:
    profiles, which = [[5, 0, 2], [1, 3, 1]], np.arange(60_000) % 2
    drawn = draw_classes(profiles, [Fraction(power) for power in powers], which, np.random.default_rng(0))
    for profile in (0, 1):
        expected = chances(np.array(profiles[profile]), powers)
        np.testing.assert_allclose(expected.sum(), 1)
        observed = np.bincount(drawn[which == profile], minlength=3)
        used = expected > 0
        assert observed[~used].sum() == 0
        assert stats.chisquare(observed[used], 30_000 * expected[used]).pvalue > ALPHA
        other = chances(np.array(profiles[1 - profile]), powers)[used] + 1e-9  # the control
        assert stats.chisquare(observed[used], 30_000 * other / other.sum()).pvalue < CERTAINLY_WRONG


def test_numbers_of_any_size() -> None:
    """Like the numbers of sets of `plateau`."""
    counts = [math.comb(256_000, 16) * 3, math.comb(256_000, 16)]
    drawn = draw_classes([counts], [Fraction(0)] * 2, np.zeros(20_000, dtype=np.int64), np.random.default_rng(0))
    assert stats.binomtest(int((drawn == 0).sum()), 20_000, 0.75).pvalue > ALPHA
