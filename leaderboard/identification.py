"""Identification: rank-1 rate, mean reciprocal rank, and bits about the photograph among 256, from the metric `identified`.

Bits. Without a reconstruction, the photograph takes log2 256 = 8 bits. With it, the rank r of the photograph takes −log2 p(r)
bits in a code that expects p. The bits that a reconstruction gains are 8 minus the mean length of the best code of the family

    p(r) = (1 − l) r^−a / Σ_k k^−a + l / 256,    a ≥ 0, 0 ≤ l ≤ 1,

fitted by maximum likelihood. The gain of a fixed code on new photographs is a lower bound of the mutual information between
reconstruction and photograph, if all 256 are equally likely. The fit to n photographs exceeds it by about 2 / (2 n ln 2) bits,
half a nat per parameter (Wilks 1938); `Identification.bias` states it, and `bits` is not corrected by it.

A constant image has equal similarity to all 256. Its tie is known from the mean rank 128.5. Every code gives it exactly 8 bits,
so it gains 0. The photograph itself always has rank 1 and gains 8.

The interval of the bits contains 8 minus the entropy of each code in the 95% likelihood region of both parameters. That is the
gain of the code if the ranks follow it. As the region is a joint one, the coverage is above 95%. Unlike a bootstrap or
Student's interval, it has a width if all ranks are equal.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from bench.core.errors import UserError
from leaderboard.chance import PHOTOGRAPHS, RECIPROCAL_RANK
from leaderboard.intervals import LEVEL, Interval, interval, proportion

Doubles = NDArray[np.float64]

TOTAL = math.log2(PHOTOGRAPHS)  # bits
TIED_RANK = (PHOTOGRAPHS + 1) / 2  # of a constant image
PARAMETERS = 2
# The fit takes the best of these pairs. At a = 60 the power of rank 1 exceeds all others by 2^60.
EXPONENTS = np.concatenate([np.arange(0, 2, 0.05), np.arange(2, 4, 0.1), np.arange(4, 12.5, 0.5), [60.0]])
UNIFORM_FRACTIONS = np.sin(np.linspace(0, np.pi / 2, 51)) ** 2  # dense near 0 and 1


@dataclass(frozen=True, kw_only=True)
class Identification:
    """Three summaries of the ranks of n photographs among 256 candidates each, with 95% intervals."""

    rank_1: Interval  # fraction of photographs that are identified, with Wilson's interval
    reciprocal: Interval  # mean reciprocal rank
    bits: Interval  # from 0 to 8; chance is 0
    bias: float  # of the fit, in bits


def summarize_identification(reciprocals: ArrayLike) -> Identification:
    """Return the summaries of (n,) values of the metric `identified`, one per photograph, n ≥ 1.

    `leaderboard.chance` has the values of a random order for the rank-1 rate and the mean reciprocal rank.

    Raises
    ------
    ValueError
        if there is no value.
    UserError
        if a value is no reciprocal rank among 256.
    """
    values = _validate(reciprocals)
    return Identification(
        rank_1=proportion(values == 1.0),
        reciprocal=measure_reciprocal(values),
        bits=measure_bits(values),
        bias=PARAMETERS / (2 * len(values) * math.log(2)),
    )


def measure_bits(reciprocals: ArrayLike) -> Interval:
    """Return the bits that reconstructions give about the photograph among 256, with an interval of at least 95%.

    Constant images gain 0 bits, and their number counts as given. Values of shape (n, s) are those of s seeds for each
    photograph. The likelihood of a photograph is then the geometric mean over its seeds, so that n photographs count as n.

    Raises
    ------
    ValueError
        if there is no value.
    UserError
        if a value is no reciprocal rank among 256.
    """
    table = np.asarray(reciprocals, dtype=np.float64)
    photographs, seeds = len(table), table.shape[1] if table.ndim == 2 else 1
    values = _validate(table.ravel() if table.ndim == 2 else table)
    ranks = 1 / values[~_is_tied(values)]
    if len(ranks) == 0:
        return Interval(0.0, 0.0, 0.0, photographs)
    unique, counts = np.unique(ranks, return_counts=True)
    likelihood = np.log2(_evaluate_codes(unique)) @ (counts / seeds)  # (codes,), of all ranks
    region = likelihood.max() - likelihood <= special.chdtri(PARAMETERS, 1 - LEVEL) / (2 * math.log(2))
    expected = _measure_expected_gains()[region]
    gain = max(0.0, TOTAL + float(likelihood.max()) * seeds / len(ranks))  # without rounding errors
    fraction = len(ranks) / len(values)
    low, high = min(gain, float(expected.min())), max(gain, float(expected.max()))
    return Interval(fraction * gain, fraction * low, fraction * high, photographs)


def measure_reciprocal(reciprocals: ArrayLike) -> Interval:
    """Return the mean reciprocal rank, with Student's interval within the range of the metric. It is infinite for one value.

    A constant image counts as its expectation if its tie is broken at random. The reciprocal of its mean rank is less than that
    of a random order on average, so that random images would seem better than constant ones.

    Raises
    ------
    ValueError
        if there is no value.
    UserError
        if a value is no reciprocal rank among 256.
    """
    mean = interval(replace_ties(reciprocals))
    if math.isinf(mean.low):
        return mean
    return Interval(mean.mean, max(1 / PHOTOGRAPHS, mean.low), min(1.0, mean.high), mean.count)


def replace_ties(reciprocals: ArrayLike) -> Doubles:
    """Return (n,) reciprocal ranks, where those of constant images are the mean of a random order.

    Raises
    ------
    ValueError
        if there is no value.
    UserError
        if a value is no reciprocal rank among 256.
    """
    values = _validate(reciprocals)
    return np.where(_is_tied(values), RECIPROCAL_RANK, values)


def _evaluate_codes(ranks: Doubles) -> Doubles:
    """Return the probability of each rank under each code. A rank between integers has the power of its own value.

    (n,) -> (codes, n)
    """
    totals = (np.arange(1.0, PHOTOGRAPHS + 1) ** -EXPONENTS[:, None]).sum(axis=1)  # (exponents,)
    powers = ranks ** -EXPONENTS[:, None] / totals[:, None]  # (exponents, n)
    uniform = UNIFORM_FRACTIONS[:, None, None]
    return ((1 - uniform) * powers + uniform / PHOTOGRAPHS).reshape(-1, len(ranks))


@functools.cache
def _measure_expected_gains() -> Doubles:
    """Return 8 minus the entropy of each code, in bits. -> (codes,)"""
    probabilities = _evaluate_codes(np.arange(1.0, PHOTOGRAPHS + 1))  # (codes, 256), positive
    gains = TOTAL + (probabilities * np.log2(probabilities)).sum(axis=1)
    return np.clip(gains, 0.0, TOTAL)  # without rounding errors


def _is_tied(values: Doubles) -> NDArray[np.bool_]:
    return np.asarray(np.isclose(1 / values, TIED_RANK, rtol=0, atol=1e-6))


def _validate(reciprocals: ArrayLike) -> Doubles:
    values = np.asarray(reciprocals, dtype=np.float64)
    if values.ndim != 1 or len(values) == 0:
        raise ValueError(f"expected (n,) reciprocal ranks, n at least 1, got {values.shape}")
    wrong = values[~((values >= (1 - 1e-12) / PHOTOGRAPHS) & (values <= 1))]  # NaN too
    if len(wrong):
        raise UserError(
            f"a record has the reciprocal rank {wrong[0]:g}; reciprocal ranks are from 1/{PHOTOGRAPHS} to 1: run it anew"
        )
    return values
