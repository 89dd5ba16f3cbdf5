"""The ω-subset mechanism, sampled exactly: no step is rounded, so released sets have exactly the distribution of the theorem.

Theorem. Let K be a finite set, v in K, 1 ≤ m ≤ |K| and ε ≥ 0. Draw u = 1 with probability

    p = m e^ε / (m e^ε + |K| − m)                                                                        Eq. (5)

draw m − u elements without replacement from K − {v}, and add v if u = 1. The resulting set Z has

    Pr(Z | v) = |K| e^ε / (m e^ε + |K| − m) / C(|K|, m)   if v is in Z,
    Pr(Z | v) = |K|     / (m e^ε + |K| − m) / C(|K|, m)   if it is not,

which sums to 1 over all Z. Pr(Z | v1) ≤ e^ε Pr(Z | v2) for all Z, v1, v2, so the mechanism is ε-LDP. The paper's Definition 2 has
m in place of the first |K|, and then sums to m / |K|. Its Eq. (5) and the ratio are right.

A set has no order, so rows are sorted. ε is the decimal or fraction as written (`bench.core.exact`): 0.1 is one tenth.
"""

from __future__ import annotations

import math
from decimal import MAX_EMAX, MIN_EMIN, ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Context, Decimal
from fractions import Fraction
from functools import lru_cache
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.core.exact import to_fraction
from bench.types import Bytes, Indices

WIDTH = 64  # bits of p compared in one step
STEP = 2**15  # words drawn at a time, which fit into the cache
NETWORK = 8  # greatest length of rows that are sorted by comparisons of columns


def chance_digits(epsilon: float, domain: int, size: int, bits: int) -> int:
    """Return the first `bits` binary digits of p: floor(2^bits · p), exactly.

    p is 1 for ε = ∞ and for |K| = m. For any other ε except 0, e^ε is transcendental (Lindemann). So p is no multiple of 2^-bits,
    and a finite precision determines the digits.
    """
    return 1 << bits if _is_certain(epsilon, domain, size) else _compute_digits(to_fraction(epsilon), domain, size, bits)


@lru_cache(maxsize=1024)
def _compute_digits(power: Fraction, domain: int, size: int, bits: int) -> int:
    rest = domain - size
    if power == 0:
        return (size << bits) // domain
    if power >= bits + rest.bit_length():
        return (1 << bits) - 1  # as 1 − p < rest · e^-ε < 2^-bits; e^ε may overflow
    precision = bits // 3 + 30  # decimal digits, more than `bits` binary ones
    while True:
        low, high = _enclose_chance(power, rest, size, precision)
        floor = math.floor(low * 2**bits)
        if floor == math.floor(high * 2**bits):
            return floor
        precision *= 2


def _is_certain(epsilon: float, domain: int, size: int) -> bool:
    return domain == size or math.isinf(epsilon)


def _enclose_chance(power: Fraction, rest: int, size: int, precision: int) -> tuple[Fraction, Fraction]:
    """Return bounds of p, computed with `precision` decimal digits from ε rounded down and from ε rounded up."""
    low, high = (
        Context(prec=precision, rounding=rounding, Emax=MAX_EMAX, Emin=MIN_EMIN).divide(
            Decimal(power.numerator), Decimal(power.denominator)
        )
        for rounding in (ROUND_FLOOR, ROUND_CEILING)
    )
    return _bound_chance(low, rest, size, precision)[0], _bound_chance(high, rest, size, precision)[1]


def _bound_chance(power: Decimal, rest: int, size: int, precision: int) -> tuple[Fraction, Fraction]:
    """Return bounds of p at a decimal ε.

    Each operation of `decimal`, including exp, is correctly rounded, so it errs by a factor within 1 ± 5 · 10^-precision. The
    numerator has two such factors, the denominator three and the quotient one: together within 1 ± 4 · 10^(1 - precision).
    """
    context = Context(prec=precision, rounding=ROUND_HALF_EVEN, Emax=MAX_EMAX, Emin=MIN_EMIN)
    weight = context.multiply(Decimal(size), context.exp(power))
    chance = Fraction(context.divide(weight, context.add(weight, Decimal(rest))))
    error = chance * Fraction(4, 10 ** (precision - 1))
    return chance - error, chance + error


def log10_chance(epsilon: float, domain: int, size: int) -> float:
    """Return log10 p to the precision of a double, for domains of any size."""
    if _is_certain(epsilon, domain, size):
        return 0.0
    odds_against = math.log(domain - size) - math.log(size) - epsilon  # ln((1 − p) / p); math.log takes integers of any size
    return -float(np.logaddexp(0.0, odds_against)) / math.log(10)


def mutual_information(epsilon: float, domain: int, sizes: Indices) -> NDArray[np.float64]:
    """Return the mutual information, in nats, of a released set and a uniform true word, for each size m. (S,) -> (S,)

    I = p ε + ln(|K| / (m e^ε + |K| − m)), as a set contains the true word with probability p and all sets are equally likely.
    """
    m = sizes.astype(np.float64)
    with np.errstate(divide="ignore"):
        total = np.logaddexp(np.log(m) + epsilon, np.log(domain - m))
    return np.exp(np.log(m) + epsilon - total) * epsilon + math.log(domain) - total


def most_informative_size(epsilon: float, domain: int) -> int:
    """Return the size m < |K| with the greatest mutual information of a set and the true word.

    It is about |K| (ε e^ε − e^ε + 1) / (e^ε − 1)², where the derivative of I is zero (Wang et al., arXiv:1607.08025).
    """
    sizes = np.arange(1, domain)
    return 1 if math.isinf(epsilon) else int(sizes[mutual_information(epsilon, domain, sizes).argmax()])


def most_accurate_size(epsilon: float, domain: int) -> int:
    """Return the size for which sets of many users give the best estimate of word frequencies.

    It is |K| / (e^ε + 1) (Ye and Barg, arXiv:1702.00610). A set then contains the true word with a chance of about one half. Both
    sizes tend to |K| / 2 for small ε and differ for large ε.
    """
    fraction = math.exp(-epsilon) / (1 + math.exp(-epsilon))
    return min(domain - 1, max(1, round(domain * fraction)))


def draw_inclusion(rows: int, epsilon: float, domain: int, size: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return random u, whether the set of a row contains the true word: whether a uniform number is below p. -> (N,)

    The number and p are compared bit by bit. The first 64 bits decide, unless they are equal (chance 2^-64). Then the next 64
    bits decide, and so on.
    """
    if _is_certain(epsilon, domain, size):
        return np.ones(rows, dtype=bool)
    included, undecided = _compare_bits(rows, epsilon, domain, size, WIDTH, rng)
    for bits in count(2 * WIDTH, WIDTH):
        if len(undecided) == 0:
            break
        included[undecided], equal = _compare_bits(len(undecided), epsilon, domain, size, bits, rng)
        undecided = undecided[equal]
    return included


def _compare_bits(
    rows: int, epsilon: float, domain: int, size: int, bits: int, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], Indices]:
    """Compare random numbers with the last 64 of the first `bits` of p. -> which are less (N,), the indices of equal ones"""
    digits = np.uint64(chance_digits(epsilon, domain, size, bits) % 2**WIDTH)
    drawn = rng.integers(2**WIDTH - 1, size=rows, dtype=np.uint64, endpoint=True)
    return drawn < digits, np.flatnonzero(drawn == digits)


def draw_distinct(rows: int, domain: int, size: int, rng: np.random.Generator) -> Indices:
    """Return for each row `size` random distinct numbers below `domain`, with all subsets equally likely. -> (N, size), unordered

    Floyd's algorithm (Bentley and Floyd, CACM 1987) takes one draw per element without rejection, for any domain. The order of a
    row is not uniform; sort it before a release.
    """
    if size > domain:
        raise ValueError(f"cannot draw {size} distinct numbers from {domain}")
    numbers = np.empty((rows, size), dtype=np.int64)
    for step in range(size):
        last = domain - size + step
        drawn = rng.integers(last, size=rows, endpoint=True)  # (N,)
        taken = (numbers[:, :step] == drawn[:, None]).any(axis=1)
        numbers[:, step] = np.where(taken, last, drawn)  # earlier steps cannot draw `last`
    return numbers


def draw_word_subsets(true: Indices, domain: int, epsilon: float, size: int, rng: np.random.Generator) -> Indices:
    """Return random sets of the ω-subset mechanism on K = {0, ..., domain − 1}. true: (N,) -> (N, m), rows ascending

    If repetitions are rare, words are drawn independently. Only sets with a repetition are drawn again, without replacement. All
    sets of distinct words are equally likely to be accepted, so both kinds have the distribution of the theorem. The cost does
    not depend on |K|.
    """
    included = draw_inclusion(len(true), epsilon, domain, size, rng)
    if size * size > domain or domain == 1:
        return _draw_without_repetition(true, included, domain, size, rng)
    words = _draw_one_by_one(true, included, domain, size, rng)
    again = _find_repeating(words)
    words[again] = _draw_without_repetition(true[again], included[again], domain, size, rng)
    return words


def _draw_one_by_one(true: Indices, included: NDArray[np.bool_], domain: int, size: int, rng: np.random.Generator) -> Indices:
    """Return words other than v, drawn independently; v replaces the first if u = 1. (N,), (N,) -> (N, m), rows ascending"""
    words = np.empty((len(true), size), dtype=np.int64)
    dtype = np.int32 if domain < 2**31 else np.int64  # the random numbers are the same
    step = max(1, STEP // size)
    for start in range(0, len(true), step):
        rows = slice(start, start + step)
        own: NDArray[Any] = true[rows].astype(dtype)
        drawn = rng.integers(domain - 1, size=(size, len(own)), dtype=dtype)  # (m, n) of the remaining |K| − 1
        drawn += drawn >= own
        drawn[0] += (own - drawn[0]) * included[rows]  # half the time of a masked copy
        _sort_rows(drawn, words[rows])
    return words


def _sort_rows(columns: NDArray[Any], rows: Indices) -> None:
    """Write the sorted rows of a matrix that is given by its columns, which are overwritten. (m, n), (n, m)"""
    if len(columns) > NETWORK:
        rows[:] = columns.T
        rows.sort(axis=1)
        return
    sorted_columns = list(columns)
    for last in range(len(columns) - 1, 0, -1):  # bubble sort of whole columns, which np.sort of short rows cannot vectorize
        for low in range(last):
            least = np.minimum(sorted_columns[low], sorted_columns[low + 1])
            np.maximum(sorted_columns[low], sorted_columns[low + 1], out=sorted_columns[low + 1])
            sorted_columns[low] = least
    for number, column in enumerate(sorted_columns):
        rows[:, number] = column


def _find_repeating(rows: Indices) -> Indices:
    """Return the indices of rows with a repeated word; rows must be ascending. (n, m) -> (r,)"""
    flat, length = rows.ravel(), rows.shape[1]
    equal = np.flatnonzero(flat[1:] == flat[:-1])
    return np.unique(equal[equal % length < length - 1] // length)  # a pair across the end of a row does not count


def _draw_without_repetition(
    true: Indices, included: NDArray[np.bool_], domain: int, size: int, rng: np.random.Generator
) -> Indices:
    """Return random sets of the mechanism given u, for any m up to |K|. (N,), (N,) -> (N, m), rows ascending"""
    words = np.empty((len(true), size), dtype=np.int64)
    for u in (0, 1):
        rows = np.flatnonzero(included == u)
        if len(rows) == 0:
            continue  # |K| = m has no set without the true word
        others = draw_distinct(len(rows), domain - 1, size - u, rng)  # (rows, m − u) of the remaining |K| − 1
        words[rows, u:] = others + (others >= true[rows, None])
    words[included, 0] = true[included]
    return np.sort(words, axis=1)


def draw_pattern_subsets(true: Bytes, epsilon: float, size: int, rng: np.random.Generator) -> Bytes:
    """Return random sets of the ω-subset mechanism on all 256^B patterns of B bytes, for m < 256^B.

    true: (N, B) -> (N, m, B), rows in byte order
    """
    rows, length = true.shape
    included = draw_inclusion(rows, epsilon, 256**length, size, rng)
    patterns = np.empty((rows, size, length), dtype=np.uint8)
    waiting = np.arange(rows)
    while len(waiting):
        others = rng.integers(256, size=(len(waiting), size, length), dtype=np.uint8)
        patterns[waiting] = others
        # m other patterns, all distinct and different from the true one, which replaces one of them if it is included.
        whole = _sort_patterns(np.concatenate([others, true[waiting, None]], axis=1))  # (waiting, m + 1, B)
        waiting = waiting[(whole[:, 1:] == whole[:, :-1]).all(axis=2).any(axis=1)]
    patterns[included, 0] = true[included]
    return _sort_patterns(patterns)


def _sort_patterns(patterns: Bytes) -> Bytes:
    """Return the patterns of each row sorted as strings of bytes. (N, m, B) -> (N, m, B)"""
    opaque = np.ascontiguousarray(patterns).view(np.dtype((np.void, patterns.shape[2])))[..., 0]  # (N, m), compared by memcmp
    return np.sort(opaque, axis=1)[..., None].view(np.uint8)
