"""Naive LDP: the mechanism on all bit patterns, of one byte against enumeration, of 128 and 512 bytes at the extremes."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from bench.api import Privacy
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.subset import draw_inclusion, draw_pattern_subsets
from bench.types import Features
from defenses.naive_ldp import PLUGIN as NAIVE
from defenses.naive_ldp import read_finite_floats

ALPHA = 1e-4
CERTAINLY_WRONG = 1e-9


def make_features(count: int, seed: int = 0, codes: bool = True) -> Features:
    rng = np.random.default_rng(seed)
    values = rng.integers(1, 150, size=(count, 128), dtype=np.uint8)
    keypoints = rng.uniform(0, 64, (count, 2)).astype(np.float32)
    return Features(keypoints=keypoints, descriptors=unit_rows(values), codes=values if codes else None, size=(64, 48))


def draw_repeatedly(epsilon: float, count: int) -> np.ndarray:
    """Return whether each released pattern is the descriptor, for many copies of it. -> (N, m) bool"""
    one = make_features(1)
    assert one.codes is not None
    many = Features(
        keypoints=np.repeat(one.keypoints, count, 0),
        descriptors=np.repeat(one.descriptors, count, 0),
        codes=np.repeat(one.codes, count, 0),
        size=one.size,
    )
    release = NAIVE(epsilon=epsilon).protect(many, Public(), np.random.default_rng(1))
    return (release.candidates == one.descriptors[0]).all(axis=2)


# ---- the mechanism


Sampler = Callable[[np.ndarray, float, int, np.random.Generator], np.ndarray]


def pairs_fit(sampler: Sampler, epsilon: float, draws: int = 10**6, true: int = 77) -> float:
    """Return the smaller p-value of two tests: χ² over all C(256, 2) sets of two bytes, and the rate of the true byte."""
    drawn = sampler(np.full((draws, 1), true, dtype=np.uint8), epsilon, 2, np.random.default_rng(0))
    assert drawn.shape == (draws, 2, 1)
    low, high = np.sort(drawn[..., 0].astype(int), axis=1).T
    assert (low < high).all(), "a pattern twice"
    observed = np.bincount(low * 256 + high, minlength=2**16)
    total = 2 * math.exp(epsilon) + 256 - 2
    everything = np.arange(2**16)
    is_set = everything // 256 < everything % 256
    holds = (everything // 256 == true) | (everything % 256 == true)
    law = np.where(holds, math.exp(epsilon), 1.0) * 256 / total / math.comb(256, 2)
    assert law[is_set].sum() == pytest.approx(1, abs=1e-12)
    rate = stats.binomtest(int(observed[is_set & holds].sum()), draws, law[is_set & holds].sum())
    return float(min(stats.chisquare(observed[is_set], draws * law[is_set]).pvalue, rate.pvalue))


@pytest.mark.parametrize("epsilon", [0.0, 1.0, 5.0])
def test_sets_of_bytes_against_enumeration(epsilon: float) -> None:
    assert pairs_fit(draw_pattern_subsets, epsilon) > ALPHA


@pytest.mark.slow
def test_control_an_approximate_domain_fails() -> None:
    """u is drawn for |K| = 256 + 8, or with the approximation p = m e^ε / |K|."""

    def sampler(domain: float) -> Sampler:
        def sample(true: np.ndarray, epsilon: float, size: int, rng: np.random.Generator) -> np.ndarray:
            included = rng.random(len(true)) < size * math.exp(epsilon) / domain
            drawn = np.empty((len(true), size, 1), dtype=np.uint8)
            drawn[included] = draw_pattern_subsets(true[included], math.inf, size, rng)
            # Sets without the true byte: those of ε = 0 that lack it.
            rest = np.flatnonzero(~included)
            while len(rest):
                drawn[rest] = draw_pattern_subsets(true[rest], 0.0, size, rng)
                rest = rest[(drawn[rest] == true[rest, None]).any(axis=(1, 2))]
            return drawn

        return sample

    total = 2 * math.exp(3.0) + 256 - 2
    assert pairs_fit(sampler(total), 3.0) > ALPHA  # the right p: nothing else is wrong
    assert pairs_fit(sampler(total + 8), 3.0) < CERTAINLY_WRONG
    assert pairs_fit(sampler(256), 3.0) < CERTAINLY_WRONG


class Repeating:
    """A generator whose first patterns are given, and whose later ones are random."""

    def __init__(self, *given: np.ndarray) -> None:
        self.given, self.rng = list(given), np.random.default_rng(0)

    def integers(self, high: int, **how: Any) -> np.ndarray:
        if how["dtype"] == np.uint8 and self.given:
            given = self.given.pop(0)
            assert given.shape == how["size"]
            return given
        return self.rng.integers(high, **how)


def test_repetitions_are_drawn_again() -> None:
    true = np.arange(3 * 128, dtype=np.uint8).reshape(3, 128)
    random = np.random.default_rng(5).integers(256, size=(3, 2, 128), dtype=np.uint8)
    first = random.copy()
    first[0, 1] = first[0, 0]  # twice the same
    first[1, 1] = true[1]  # the descriptor itself, although u = 0
    again = random[:2].copy()
    again[1, 0] = true[1]
    rng = Repeating(first, again)
    drawn = draw_pattern_subsets(true, 10.0, 2, rng)  # type: ignore[arg-type]
    assert not rng.given
    for row in range(3):
        assert len({bytes(pattern) for pattern in drawn[row]} | {bytes(true[row])}) == 3
    assert {bytes(pattern) for pattern in drawn[2]} == {bytes(pattern) for pattern in random[2]}
    assert {bytes(pattern) for pattern in drawn[0]} == {bytes(pattern) for pattern in random[0]}


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 6), st.sampled_from([1, 3, 128]), st.sampled_from([0.0, 3.0, 720.0, math.inf]))
def test_rows_are_in_byte_order(seed: int, size: int, length: int, epsilon: float) -> None:
    rng = np.random.default_rng(seed)
    true = rng.integers(256, size=(9, length), dtype=np.uint8) * rng.integers(2, size=(9, length), dtype=np.uint8)
    for row in draw_pattern_subsets(true, epsilon, size, rng):
        patterns = [bytes(pattern) for pattern in row]
        assert patterns == sorted(set(patterns))


def test_the_order_of_patterns_reveals_nothing_and_the_control_is_detected() -> None:
    rng = np.random.default_rng(0)
    true = rng.integers(256, size=(50_000, 128), dtype=np.uint8)
    drawn = draw_pattern_subsets(true, math.inf, 2, rng)
    first = (drawn[:, 0] == true).all(axis=1)
    assert stats.binomtest(int(first.sum()), len(true)).pvalue > ALPHA
    included_first = np.concatenate([true[:, None], np.where((drawn == true[:, None]).all(2, keepdims=True), 0, drawn)], axis=1)
    assert stats.binomtest(int((included_first[:, 0] == true).all(axis=1).sum()), len(true)).pvalue < CERTAINLY_WRONG


# ---- probabilities far beyond a double's range


@pytest.mark.parametrize(("element", "bits"), [("uint8", 1024), ("float32", 4096)])
def test_chance_of_the_true_pattern_in_log_space(element: Any, bits: int) -> None:
    promised = NAIVE(element=element).privacy(Public())
    assert (promised.guarantee, promised.epsilon) == ("epsilon-ldp", 10.0)
    expected = math.log10(2) + 10 / math.log(10) - bits * math.log10(2)  # m e^ε is negligible against |K|
    assert promised.log10_true == pytest.approx(expected, abs=1e-9)
    assert promised.log10_true == pytest.approx({"uint8": -303.61, "float32": -1228.37}[element], abs=0.01)


def test_infinite_epsilon_always_includes_the_true_pattern() -> None:
    included = draw_repeatedly(math.inf, 50)
    assert (included.sum(axis=1) == 1).all()
    assert NAIVE(epsilon=math.inf).privacy(Public()) == Privacy("none", None, 0.0)


def test_the_rate_at_a_chance_of_one_half() -> None:
    """ε = 709 is about where p is one half in 1024 bits: e^ε is near the greatest double and |K| near its double."""
    included = draw_repeatedly(709.0, 5_000)
    p = 1 / (1 + math.exp(1024 * math.log(2) - math.log(2) - 709))
    assert 0.4 < p < 0.6
    assert 10 ** NAIVE(epsilon=709.0).privacy(Public()).log10_true == pytest.approx(p, rel=1e-9)  # type: ignore[operator]
    assert stats.binomtest(int(included.any(axis=1).sum()), len(included), p).pvalue > ALPHA
    assert stats.binomtest(int(included.any(axis=1).sum()), len(included), p * 1.2).pvalue < ALPHA  # the control
    positions = included[included.any(axis=1)].argmax(axis=1)
    assert stats.binomtest(int(positions.sum()), len(positions), compute_second_position_chance()).pvalue > ALPHA


def compute_second_position_chance() -> float:
    """Return the probability that the bytes of the repeated descriptor follow those of a random pattern."""
    codes = make_features(1).codes
    assert codes is not None
    return int.from_bytes(codes[0].tobytes(), "big") / 2**1024


def test_at_epsilon_10_the_true_pattern_is_never_included() -> None:
    included = draw_repeatedly(10.0, 5_000)
    assert not included.any()
    assert not draw_inclusion(10**5, 10.0, 2**4096, 2, np.random.default_rng(0)).any()


# ---- the release


@pytest.mark.parametrize("element", ["uint8", "float32"])
def test_candidates_are_finite_unit_rows(element: Any) -> None:
    secret = make_features(300)
    release = NAIVE(element=element, subset_size=3).protect(secret, Public(), np.random.default_rng(0))
    assert release.words is None
    assert (release.candidates.shape, release.candidates.dtype) == ((300, 3, 128), np.float32)
    np.testing.assert_allclose(np.linalg.norm(release.candidates.astype(float), axis=2), 1, atol=1e-6)
    copies = release.candidates.copy(), release.keypoints.copy()
    np.testing.assert_array_equal(release.keypoints, secret.keypoints)
    for array in (secret.keypoints, secret.descriptors, secret.codes):
        assert array is not None
        array[:] = 0
    np.testing.assert_array_equal(release.candidates, copies[0])
    np.testing.assert_array_equal(release.keypoints, copies[1])


def test_an_included_float_descriptor_is_unchanged() -> None:
    secret = make_features(20, codes=False)
    release = NAIVE(element="float32", epsilon=math.inf, subset_size=1).protect(secret, Public(), np.random.default_rng(0))
    np.testing.assert_allclose(release.candidates[:, 0], secret.descriptors, atol=1e-7)


def test_components_that_are_not_finite_are_read_as_zero() -> None:
    values = np.zeros((1, 2, 4), dtype="<f4")
    values[0, 0] = [np.nan, 3.0, -np.inf, -4.0]
    values[0, 1] = [np.inf, np.nan, -np.inf, np.nan]
    patterns = values.view(np.uint8)
    patterns[0, 1, 4:8] = [1, 0, 0x80, 0x7F]  # a signalling NaN
    finite = read_finite_floats(patterns)
    np.testing.assert_array_equal(finite, [[[0, 3, 0, -4], [0, 0, 0, 0]]])
    np.testing.assert_allclose(unit_rows(finite), [[[0, 0.6, 0, -0.8], [0, 0, 0, 0]]], atol=1e-7)


def test_extreme_finite_patterns_scale_without_overflow() -> None:
    values = np.zeros((1, 2, 128), dtype="<f4")
    values[0, 0] = np.finfo(np.float32).max
    values[0, 1] = np.finfo(np.float32).smallest_subnormal
    np.testing.assert_allclose(unit_rows(read_finite_floats(values.view(np.uint8))), 128**-0.5, rtol=1e-6)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"epsilon": -0.5}, "naive-ldp: epsilon must be at least 0, got -0.5"),
        ({"epsilon": math.nan}, "naive-ldp: epsilon must be at least 0, got nan"),
        ({"subset_size": 0}, "naive-ldp: subset_size must be at least 1, got 0"),
        ({"element": "int8"}, "naive-ldp: element must be uint8, float32 or float32x64, got int8"),
    ],
)
def test_wrong_configuration(wrong: dict, message: str) -> None:
    with pytest.raises(UserError) as caught:
        NAIVE(**wrong)
    assert str(caught.value) == message


def test_features_that_do_not_fit() -> None:
    with pytest.raises(UserError, match="use element=float32"):
        NAIVE().protect(make_features(2, codes=False), Public(), np.random.default_rng(0))
    longer = Features(
        keypoints=np.ones((2, 2), np.float32), descriptors=np.eye(2, 256, dtype=np.float32), codes=None, size=(9, 9)
    )
    with pytest.raises(UserError, match="must have length 128, got 256"):
        NAIVE(element="float32").protect(longer, Public(), np.random.default_rng(0))


def test_name() -> None:
    assert NAIVE.name() == "naive-ldp"
