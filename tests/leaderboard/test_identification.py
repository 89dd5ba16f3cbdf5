"""Bits of identification against SciPy's optimiser and closed forms; coverage of the interval by simulation."""

import math
from functools import cache

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import binom, binomtest, norm, sem, t

from bench.core.errors import UserError
from leaderboard.chance import PHOTOGRAPHS, RECIPROCAL_RANK
from leaderboard.identification import (
    _evaluate_codes,
    _measure_expected_gains,
    measure_bits,
    measure_reciprocal,
    summarize_identification,
)
from leaderboard.intervals import Interval

RANKS = np.arange(1, PHOTOGRAPHS + 1)
BLANK = 1 / 128.5


def compute_power_law(exponent: float, uniform: float) -> np.ndarray:
    """Return the probability of each rank. (256,)"""
    powers = RANKS**-exponent
    return (1 - uniform) * powers / powers.sum() + uniform / PHOTOGRAPHS


def compute_gaussian_ranks(shift: float) -> np.ndarray:
    """Return the probability of each rank if similarities are standard normal, and that of the true one is shifted. (256,)

    The code is not made for these ranks.
    """
    similarity = np.linspace(shift - 8, shift + 8, 4001)
    density = norm.pdf(similarity - shift)
    return binom.pmf(RANKS[:, None] - 1, PHOTOGRAPHS - 1, norm.sf(similarity)) @ (density / density.sum())


# ---- both ends


@pytest.mark.parametrize("count", [1, 7, 100])
def test_a_blank_image_gains_nothing_and_the_photograph_itself_8_bits(count: int) -> None:
    blank, itself = measure_bits([BLANK] * count), measure_bits([1.0] * count)
    assert (blank.mean, blank.low, blank.high, blank.count) == (0.0, 0.0, 0.0, count)
    assert itself.mean == itself.high == 8.0
    assert itself.low < 8.0, "that n photographs are identified does not mean that all are"


def test_the_interval_of_the_photograph_itself_narrows() -> None:
    lows = [measure_bits([1.0] * count).low for count in (1, 3, 7, 30, 100, 1000)]
    assert lows == sorted(lows)
    assert lows[-1] > 7.8


def test_ties_gain_nothing_beside_identified_photographs() -> None:
    assert measure_bits([1.0, BLANK, 1.0, BLANK]).mean == 4.0
    both = measure_bits([1 / 3, 1 / 40, 1.0, *[BLANK] * 3])
    alone = measure_bits([1 / 3, 1 / 40, 1.0])
    assert (both.mean, both.low, both.high) == pytest.approx((alone.mean / 2, alone.low / 2, alone.high / 2))


# ---- the fit


@pytest.mark.parametrize(("exponent", "uniform"), [(1.0, 0.2), (2.5, 0.0), (0.4, 0.0), (1.5, 0.7)])
def test_the_fit_is_the_maximum_of_the_likelihood(exponent: float, uniform: float, rng: np.random.Generator) -> None:
    ranks = rng.choice(RANKS, 200, p=compute_power_law(exponent, uniform))

    def measure_length(parameters: np.ndarray) -> float:
        return -float(np.log2(compute_power_law(*parameters)[ranks - 1]).mean())

    starts = [(0.5, 0.1), (1.5, 0.5), (3.0, 0.9)]
    bounds = [(0.0, 60.0), (1e-9, 1.0)]
    best = min(minimize(measure_length, start, bounds=bounds, method="L-BFGS-B").fun for start in starts)
    assert measure_bits(1 / ranks).mean == pytest.approx(8 - best, abs=5e-3)
    assert measure_bits(1 / ranks).mean <= 8 - best + 1e-6


def test_codes_are_distributions() -> None:
    codes = _evaluate_codes(RANKS.astype(float))
    np.testing.assert_allclose(codes.sum(axis=1), 1, atol=1e-12)
    assert codes.min() > 0
    gains = _measure_expected_gains()
    assert (gains.min(), gains.max()) == (0.0, 8.0)


def test_the_gain_is_a_lower_bound_of_the_information(rng: np.random.Generator) -> None:
    """If a rank is 1 or 2 with probability ½ each, the reconstruction gives 7 bits."""
    gain = measure_bits(1 / rng.integers(1, 3, 2000)).mean
    assert 6 < gain < 7.0


def test_order_and_copies_do_not_matter(rng: np.random.Generator) -> None:
    values = 1 / rng.integers(1, 60, 40)
    first = measure_bits(values)
    assert measure_bits(values[::-1]) == first
    twice = measure_bits(np.tile(values, 2))
    assert twice.mean == pytest.approx(first.mean)
    assert twice.high - twice.low < first.high - first.low


def test_seeds_of_a_photograph_do_not_count_as_photographs(rng: np.random.Generator) -> None:
    values = 1 / rng.integers(1, 60, 40)
    once = measure_bits(values)
    assert measure_bits(np.stack([values] * 3, axis=1)) == once
    by_seed = 1 / rng.integers(1, 60, (40, 2))
    together, all_separate = measure_bits(by_seed), measure_bits(by_seed.ravel())
    assert (together.mean, together.count) == (pytest.approx(all_separate.mean), 40)
    assert together.high - together.low > all_separate.high - all_separate.low


# ---- bias and coverage


def draw_ranks(probabilities: np.ndarray, count: int, repetitions: int, seed: int) -> np.ndarray:
    """-> (repetitions, count)"""
    return np.random.default_rng(seed).choice(RANKS, (repetitions, count), p=probabilities / probabilities.sum())


@pytest.mark.slow
@pytest.mark.parametrize("count", [24, 100])
def test_a_random_guess_gains_less_than_the_stated_bias(count: int) -> None:
    """A fit to uniform ranks is at the edge of the family, so its bias is less than half a nat per parameter."""
    uniform = np.full(PHOTOGRAPHS, 1 / PHOTOGRAPHS)
    gains = [measure_bits(1 / ranks).mean for ranks in draw_ranks(uniform, count, 150, 1)]
    assert min(gains) >= 0
    assert 0 < np.mean(gains) < summarize_identification([1.0] * count).bias == pytest.approx(1 / (count * math.log(2)))


@pytest.mark.exhaustive
def test_the_bias_of_a_fit_within_the_family_is_the_stated_one() -> None:
    truth, count = compute_power_law(1.0, 0.2), 100
    gains = [measure_bits(1 / ranks).mean for ranks in draw_ranks(truth, count, 600, 3)]
    excess = np.mean(gains) - compute_gain(truth)
    error = np.std(gains) / math.sqrt(len(gains))
    assert abs(excess - summarize_identification([1.0] * count).bias) < 4 * error


TRUTHS = {
    "chance": np.full(PHOTOGRAPHS, 1 / PHOTOGRAPHS),
    "power law": compute_power_law(1.0, 0.2),
    "half identified": compute_power_law(60.0, 0.5),
    "nearly all identified": compute_power_law(60.0, 0.05),
    "weak signal": compute_gaussian_ranks(1.0),
    "strong signal": compute_gaussian_ranks(3.0),
    "one of the first 59": (RANKS <= 59) / 59,  # unlike every code
}


@cache
def compute_codes() -> np.ndarray:
    """(codes, 256)"""
    return np.log2(_evaluate_codes(RANKS.astype(float)))


def compute_gain(truth: np.ndarray) -> float:
    """Return the gain of the best code on new photographs, in bits."""
    return 8 + float((compute_codes() @ truth).max())


def measure_coverage(intervals: list[Interval], value: float, part: float = 1.0) -> float:
    """Return the fraction of the intervals that contain the value, after narrowing them to a part of their width."""
    lows = np.array([one.mean - part * (one.mean - one.low) for one in intervals])
    highs = np.array([one.mean + part * (one.high - one.mean) for one in intervals])
    return float(((lows <= value + 1e-9) & (value - 1e-9 <= highs)).mean())


@pytest.mark.slow
@pytest.mark.parametrize("count", [7, 100])
@pytest.mark.parametrize("truth", TRUTHS)
def test_the_interval_covers_the_gain_on_new_photographs(truth: str, count: int) -> None:
    """At least 95% of 200 intervals, less three deviations: 90.4%."""
    intervals = [measure_bits(1 / ranks) for ranks in draw_ranks(TRUTHS[truth], count, 200, 2)]
    assert measure_coverage(intervals, compute_gain(TRUTHS[truth])) >= 0.95 - 3 * math.sqrt(0.95 * 0.05 / 200)


@pytest.mark.slow
def test_control_half_an_interval_does_not_cover() -> None:
    truth = TRUTHS["strong signal"]
    intervals = [measure_bits(1 / ranks) for ranks in draw_ranks(truth, 100, 300, 2)]
    assert measure_coverage(intervals, compute_gain(truth)) > 0.95
    assert measure_coverage(intervals, compute_gain(truth), part=0.5) < 0.9


# ---- rank-1 rate, mean reciprocal rank, chance


def test_rank_1_has_wilsons_interval() -> None:
    values = [1.0] * 5 + [1 / 1.5, 0.5, BLANK]
    rate = summarize_identification(values).rank_1
    wilson = binomtest(5, 8).proportion_ci(0.95, method="wilson")
    assert (rate.mean, rate.low, rate.high, rate.count) == pytest.approx((5 / 8, wilson.low, wilson.high, 8))


def test_mean_reciprocal_rank_of_constant_images_is_chance() -> None:
    assert np.mean(1 / RANKS) == pytest.approx(RECIPROCAL_RANK)
    assert BLANK < RECIPROCAL_RANK, "so that random images would beat constant ones by their mean reciprocal rank"
    assert measure_reciprocal([BLANK] * 9).mean == RECIPROCAL_RANK
    assert measure_reciprocal([1.0, BLANK]).mean == pytest.approx((1 + RECIPROCAL_RANK) / 2)


def test_mean_reciprocal_rank_of_others_has_students_interval(rng: np.random.Generator) -> None:
    values = 1 / rng.integers(1, 60, 40)
    reciprocal = measure_reciprocal(values)
    expected = t.interval(0.95, 39, values.mean(), sem(values))
    assert (reciprocal.mean, reciprocal.low, reciprocal.high) == pytest.approx((values.mean(), *expected))
    few = measure_reciprocal([1.0, 1 / 256, 0.5])
    assert (few.low, few.high) == (1 / 256, 1.0), "within the range of the metric"


@pytest.mark.parametrize("values", [[], [0.0], [1.1], [float("nan")], [[1.0]], [1 / 257]], ids=str)
def test_other_values_are_refused(values: list) -> None:
    with pytest.raises((ValueError, UserError), match="reciprocal ranks"):
        summarize_identification(values)
