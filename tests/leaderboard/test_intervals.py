"""Intervals and p-values against SciPy, their coverage by simulation, and Holm's correction against its definition."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from leaderboard.intervals import combine_independent, correct_holm, estimate_mean, interval, proportion, rank_correlation

Draw = Callable[[np.random.Generator, tuple[int, int]], np.ndarray]
DISTRIBUTIONS: dict[str, tuple[Draw, float]] = {  # with their means
    "normal": (lambda rng, shape: rng.normal(size=shape), 0.0),
    "skewness 1": (lambda rng, shape: rng.gamma(4.0, size=shape), 4.0),
}


def test_interval_and_p_values_are_those_of_scipy(rng: np.random.Generator) -> None:
    values = rng.gamma(2.0, size=30)
    ours, expected = estimate_mean(values), stats.ttest_1samp(values, 1.9, alternative="greater")
    likely = stats.ttest_1samp(values, 1.9).confidence_interval(0.9)
    assert (ours.interval(0.9).low, ours.interval(0.9).high) == pytest.approx((likely.low, likely.high))
    assert ours.p_above(1.9) == pytest.approx(expected.pvalue)
    assert ours.p_below(1.9) == pytest.approx(1 - expected.pvalue)


def test_independent_means_are_compared_as_welch_does(rng: np.random.Generator) -> None:
    one, other = rng.gamma(2.0, size=30), rng.normal(3.0, 2.0, size=12)
    expected = stats.ttest_ind(one, other, equal_var=False)
    ours = combine_independent([one, other], [1.0, -1.0])
    likely = expected.confidence_interval()
    assert 2 * min(ours.p_above(0.0), ours.p_below(0.0)) == pytest.approx(expected.pvalue)
    assert (ours.interval().low, ours.interval().high) == pytest.approx((likely.low, likely.high))
    assert ours.count == 12


@pytest.mark.parametrize("excluded", [1.0, 0.9, 1.3])
def test_p_values_and_intervals_agree(rng: np.random.Generator, excluded: float) -> None:
    """The interval's end is the bound with the p-value of that level."""
    ours = estimate_mean(rng.normal(size=9))
    likely = ours.interval(0.9)
    assert ours.p_above(likely.low) == pytest.approx(0.05)
    assert ours.p_below(likely.high) == pytest.approx(0.05)
    assert (ours.p_above(excluded) < 0.05) == (likely.low > excluded)


def test_one_sample_and_equal_samples() -> None:
    one = estimate_mean([3.0])
    assert (one.interval().low, one.interval().high) == (-math.inf, math.inf)
    assert (one.p_above(0.0), one.p_below(0.0)) == (1.0, 1.0)
    equal = estimate_mean([0.5] * 7)
    assert (equal.interval().low, equal.interval().high) == (0.5, 0.5)
    assert (equal.p_above(0.4), equal.p_above(0.5), equal.p_below(0.6)) == (0.0, 1.0, 0.0)
    assert (equal.p_above(-math.inf), equal.p_above(math.inf)) == (0.0, 1.0)
    mixed = combine_independent([[1.0], [0.5, 0.6, 0.4]], [1.0, -1.0])
    assert math.isinf(mixed.interval().high)


def measure_coverage(count: int, name: str, compute: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], trials: int) -> float:
    draw, mean = DISTRIBUTIONS[name]
    low, high = compute(draw(np.random.default_rng(7), (trials, count)))
    return float(np.mean((low < mean) & (mean < high)))


def compute_ours(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    intervals = [interval(sample) for sample in samples]
    return np.array([one.low for one in intervals]), np.array([one.high for one in intervals])


def compute_percentile(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    chosen = np.random.default_rng(0).integers(samples.shape[1], size=(2000, samples.shape[1]))
    low, high = np.array([np.quantile(sample[chosen].mean(axis=1), (0.025, 0.975)) for sample in samples]).T
    return low, high


@pytest.mark.parametrize("name", DISTRIBUTIONS)
@pytest.mark.parametrize(("count", "low", "high"), [(7, 0.92, 0.97), (100, 0.93, 0.97)])
def test_intervals_cover_the_mean_at_their_level(name: str, count: int, low: float, high: float) -> None:
    assert low <= measure_coverage(count, name, compute_ours, 2000) <= high


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_a_percentile_bootstrap_covers_less_at_seven_photographs(name: str) -> None:
    """The negative control: the interval that these tables had before."""
    assert measure_coverage(7, name, compute_percentile, 1000) < 0.9


def correct_by_definition(p_values: list[float], level: float) -> list[bool]:
    """Return which tests Holm's procedure rejects: from the least p-value on, while p ≤ level / (number of remaining tests)."""
    rejected = [False] * len(p_values)
    for step, index in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        if p_values[index] > level / (len(p_values) - step):
            break
        rejected[index] = True
    return rejected


@pytest.mark.parametrize("level", [0.05, 0.2])
def test_holms_correction_is_its_definition(level: float) -> None:
    for p_values in itertools.product((0.001, 0.012, 0.02, 0.04, 0.3), repeat=4):
        assert list(correct_holm(p_values) <= level + 1e-12) == correct_by_definition(list(p_values), level + 1e-12)


def test_holms_correction_is_the_closed_test_of_bonferroni(rng: np.random.Generator) -> None:
    """Holm is the closed test of Bonferroni: a hypothesis is rejected if every set that contains it is rejected."""
    for _ in range(50):
        values = rng.beta(0.5, 3.0, size=5)
        sets = [subset for size in range(1, 6) for subset in itertools.combinations(range(5), size)]
        closed = [
            max(min(1.0, len(subset) * values[list(subset)].min()) for subset in sets if index in subset) for index in range(5)
        ]
        np.testing.assert_allclose(correct_holm(values), closed)
    assert correct_holm([]).shape == (0,)


def test_without_correction_chance_decides_too_often(rng: np.random.Generator) -> None:
    """Of families of ten true hypotheses, one in twenty has a rejection; uncorrected, two in five have one."""
    families = [[estimate_mean(sample).p_above(0.0) for sample in rng.normal(size=(10, 8))] for _ in range(400)]
    corrected = np.mean([correct_holm(family).min() <= 0.05 for family in families])
    assert corrected < 0.09
    assert np.mean([min(family) <= 0.05 for family in families]) > 0.3


@pytest.mark.parametrize(("hits", "count"), [(7, 10), (0, 5), (5, 5), (1, 3000)])
def test_fractions_have_wilsons_interval(hits: int, count: int) -> None:
    expected = stats.binomtest(hits, count).proportion_ci(0.95, "wilson")
    ours = proportion([1.0] * hits + [0.0] * (count - hits), 100.0)
    assert ours.mean == pytest.approx(100 * hits / count)
    assert (ours.low, ours.high) == (100 * expected.low, 100 * expected.high)


@pytest.mark.parametrize("ties", [False, True])
def test_rank_correlation_is_that_of_scipy(rng: np.random.Generator, ties: bool) -> None:
    one, other = rng.normal(size=(2, 20))
    if ties:
        one, other = one.round(), other.round()
    assert rank_correlation(list(one), list(other)) == pytest.approx(stats.spearmanr(one, other).statistic)
    assert rank_correlation([1, 2, 3], [10, 100, 1000]) == pytest.approx(1)  # of ranks, not of values
