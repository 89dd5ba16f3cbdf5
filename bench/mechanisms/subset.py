"""The ω-subset mechanism, sampled exactly: no step is rounded, so the released sets have the very distribution of the theorem.

Theorem. Let K be a finite set, v in K, 1 ≤ m ≤ |K| and ε ≥ 0. Draw u = 1 with probability

    p = m e^ε / (m e^ε + |K| − m)                                                                        Eq. (5)

draw m − u elements without replacement from K − {v}, and add v if u = 1. The set Z that results has

    Pr(Z | v) = |K| e^ε / (m e^ε + |K| − m) / C(|K|, m)   if v is in Z,
    Pr(Z | v) = |K|     / (m e^ε + |K| − m) / C(|K|, m)   if it is not,

which sums to 1 over all Z, and Pr(Z | v1) ≤ e^ε Pr(Z | v2) for all Z, v1, v2: the mechanism is ε-LDP. (The paper's Definition 2
prints m in place of the first |K|, and then sums to m / |K|; its Eq. (5) and the ratio are right.)

A set has no order, so rows come out sorted. ε is the decimal or the fraction that it was written as (`bench.core.exact`): 0.1 is one
tenth.
"""

from __future__ import annotations

import math
from decimal import MAX_EMAX, MIN_EMIN, ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Context, Decimal
from fractions import Fraction
from functools import lru_cache
from itertools import count

import numpy as np
from numpy.typing import NDArray

from bench.core.exact import exact
from bench.types import Bytes, Indices

WIDTH = 64  # bits of p that are compared in one step
STEP = 2**15  # words that are drawn at a time: they stay in the cache


def chance_digits(epsilon: float, domain: int, size: int, bits: int) -> int:
    """The first `bits` binary digits of p: floor(2^bits · p), exactly.

    p is 1 for ε = ∞ and for |K| = m. For any other ε but 0, e^ε is transcendental (Lindemann), so p lies on no multiple
    of 2^-bits, and a finite precision tells on which side it is.
    """
    return 1 << bits if _is_certain(epsilon, domain, size) else _digits(exact(epsilon), domain, size, bits)


@lru_cache(maxsize=1024)
def _digits(power: Fraction, domain: int, size: int, bits: int) -> int:
    rest = domain - size
    if power == 0:
        return (size << bits) // domain
    if power >= bits + rest.bit_length():
        return (1 << bits) - 1  # as 1 − p < rest · e^-ε < 2^-bits; and e^ε need not be a number that fits anywhere
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
    """Bounds of p from `precision` decimal digits: from ε rounded down, and from ε rounded up."""
    low, high = (
        Context(prec=precision, rounding=rounding, Emax=MAX_EMAX, Emin=MIN_EMIN).divide(
            Decimal(power.numerator), Decimal(power.denominator)
        )
        for rounding in (ROUND_FLOOR, ROUND_CEILING)
    )
    return _chance_about(low, rest, size, precision)[0], _chance_about(high, rest, size, precision)[1]


def _chance_about(power: Decimal, rest: int, size: int, precision: int) -> tuple[Fraction, Fraction]:
    """Bounds of p at a decimal ε.

    Each operation of `decimal`, exp among them, is correctly rounded, and so errs by a factor within 1 ± 5 · 10^-precision.
    The numerator has two such factors, the denominator three and the quotient one: below 1 ± 4 · 10^(1 - precision).
    """
    context = Context(prec=precision, rounding=ROUND_HALF_EVEN, Emax=MAX_EMAX, Emin=MIN_EMIN)
    weight = context.multiply(Decimal(size), context.exp(power))
    chance = Fraction(context.divide(weight, context.add(weight, Decimal(rest))))
    error = chance * Fraction(4, 10 ** (precision - 1))
    return chance - error, chance + error


def log10_chance(epsilon: float, domain: int, size: int) -> float:
    """log10 p to a double's precision, for domains of any size."""
    if _is_certain(epsilon, domain, size):
        return 0.0
    odds_against = math.log(domain - size) - math.log(size) - epsilon  # ln((1 − p) / p); math.log takes integers of any size
    return -float(np.logaddexp(0.0, odds_against)) / math.log(10)


def information(epsilon: float, domain: int, sizes: Indices) -> NDArray[np.float64]:
    """What a released set tells of a uniform true word, for each size m: their mutual information in nats. (S,) -> (S,)

    I = p ε + ln(|K| / (m e^ε + |K| − m)), as a set holds the true word with probability p and all sets are equally likely.
    """
    m = sizes.astype(np.float64)
    with np.errstate(divide="ignore"):
        total = np.logaddexp(np.log(m) + epsilon, np.log(domain - m))
    return np.exp(np.log(m) + epsilon - total) * epsilon + math.log(domain) - total


def most_informative_size(epsilon: float, domain: int) -> int:
    """The size m < |K| at which a set tells most of the true word.

    It is about |K| (ε e^ε − e^ε + 1) / (e^ε − 1)², where I has no slope (Wang et al., arXiv:1607.08025).
    """
    sizes = np.arange(1, domain)
    return 1 if math.isinf(epsilon) else int(sizes[information(epsilon, domain, sizes).argmax()])


def most_accurate_size(epsilon: float, domain: int) -> int:
    """The size at which sets of many people tell the frequencies of words best: |K| / (e^ε + 1) (Ye and Barg, arXiv:1702.00610).

    A set then holds the true word with a chance of about one half. Both sizes tend to |K| / 2 for small ε, and part for large.
    """
    share = math.exp(-epsilon) / (1 + math.exp(-epsilon))
    return min(domain - 1, max(1, round(domain * share)))


def draw_told(rows: int, epsilon: float, domain: int, size: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw u for each row: whether a uniform number in [0, 1) is below p, both read bit by bit. -> (N,)

    Two numbers compare as their first 64 bits do, unless these are equal (chance 2^-64): then as the next 64, and so on.
    """
    if _is_certain(epsilon, domain, size):
        return np.ones(rows, dtype=bool)
    told = np.zeros(rows, dtype=bool)
    undecided = np.arange(rows)
    for bits in count(WIDTH, WIDTH):
        if len(undecided) == 0:
            break
        digits = np.uint64(chance_digits(epsilon, domain, size, bits) % 2**WIDTH)
        drawn = rng.integers(2**WIDTH - 1, size=len(undecided), dtype=np.uint64, endpoint=True)
        told[undecided] = drawn < digits
        undecided = undecided[drawn == digits]
    return told


def draw_distinct(rows: int, domain: int, size: int, rng: np.random.Generator) -> Indices:
    """Draw for each row `size` distinct numbers below `domain`, every subset equally likely. -> (N, size), in no order

    Floyd's algorithm (Bentley and Floyd, CACM 1987): whatever the domain, one draw an element and no rejection.
    The order of a row is not uniform; sort it where order shows.
    """
    if size > domain:
        raise ValueError(f"{size} distinct numbers were asked for, but there are {domain}")
    chosen = np.empty((rows, size), dtype=np.int64)
    for step in range(size):
        last = domain - size + step
        drawn = rng.integers(last, size=rows, endpoint=True)  # (N,)
        taken = (chosen[:, :step] == drawn[:, None]).any(axis=1)
        chosen[:, step] = np.where(taken, last, drawn)  # `last` was out of reach until now
    return chosen


def word_subsets(true: Indices, domain: int, epsilon: float, size: int, rng: np.random.Generator) -> Indices:
    """The ω-subset mechanism on K = {0, ..., domain − 1}. true: (N,) -> (N, m), rows ascending

    Where repetitions are rare, words are drawn one by one, and only the sets that repeat one are drawn anew, without. Sets of
    distinct words are equally likely to pass, so that both kinds have the law of the theorem; the cost does not depend on |K|.
    """
    told = draw_told(len(true), epsilon, domain, size, rng)
    if size * size > domain or domain == 1:
        return _without_repetition(true, told, domain, size, rng)
    words = _one_by_one(true, told, domain, size, rng)
    again = _repeating(words)
    words[again] = _without_repetition(true[again], told[again], domain, size, rng)
    return words


def _one_by_one(true: Indices, told: NDArray[np.bool_], domain: int, size: int, rng: np.random.Generator) -> Indices:
    """Words other than v, and v in the place of the first where u = 1. (N,), (N,) -> (N, m), rows ascending"""
    words = np.empty((len(true), size), dtype=np.int64)
    step = max(1, STEP // size)
    for start in range(0, len(true), step):
        rows = slice(start, start + step)
        drawn = rng.integers(domain - 1, size=(size, len(true[rows])))  # (m, n) of the |K| − 1 that remain
        drawn += drawn >= true[rows]
        np.copyto(drawn[0], true[rows], where=told[rows])
        words[rows] = _ascending(drawn)
    return words


def _ascending(columns: Indices) -> Indices:
    """The sorted rows of a matrix that is given by its columns. (m, n) -> (n, m)"""
    if len(columns) > 4:
        rows = columns.T.copy()
        rows.sort(axis=1)
        return rows
    for last in range(len(columns) - 1, 0, -1):  # bubble sort: to sort rows so short one by one takes up to ten times as long
        for place in range(last):
            low, high = columns[place], columns[place + 1]
            columns[place], columns[place + 1] = np.minimum(low, high), np.maximum(low, high)
    return columns.T


def _repeating(rows: Indices) -> Indices:
    """The numbers of those ascending rows in which a word stands twice. (n, m) -> (r,)"""
    flat, length = rows.ravel(), rows.shape[1]
    equal = np.flatnonzero(flat[1:] == flat[:-1])
    return np.unique(equal[equal % length < length - 1] // length)  # not from the end of a row to the next


def _without_repetition(true: Indices, told: NDArray[np.bool_], domain: int, size: int, rng: np.random.Generator) -> Indices:
    """The sets of the mechanism once u is drawn, for any m up to |K|. (N,), (N,) -> (N, m), rows ascending"""
    words = np.empty((len(true), size), dtype=np.int64)
    for u in (0, 1):
        rows = np.flatnonzero(told == u)
        if len(rows) == 0:
            continue  # |K| = m has no set without the true word
        others = draw_distinct(len(rows), domain - 1, size - u, rng)  # (rows, m − u) of the |K| − 1 that remain
        words[rows, u:] = others + (others >= true[rows, None])
    words[told, 0] = true[told]
    return np.sort(words, axis=1)


def pattern_subsets(true: Bytes, epsilon: float, size: int, rng: np.random.Generator) -> Bytes:
    """The ω-subset mechanism on all 256^B patterns of B bytes, for m < 256^B. true: (N, B) -> (N, m, B), rows in byte order"""
    rows, length = true.shape
    told = draw_told(rows, epsilon, 256**length, size, rng)
    patterns = np.empty((rows, size, length), dtype=np.uint8)
    waiting = np.arange(rows)
    while len(waiting):
        others = rng.integers(256, size=(len(waiting), size, length), dtype=np.uint8)
        patterns[waiting] = others
        # m others that differ from each other and from the true one; where that one is told, it replaces one of them.
        whole = _byte_order(np.concatenate([others, true[waiting, None]], axis=1))  # (waiting, m + 1, B)
        waiting = waiting[(whole[:, 1:] == whole[:, :-1]).all(axis=2).any(axis=1)]
    patterns[told, 0] = true[told]
    return _byte_order(patterns)


def _byte_order(patterns: Bytes) -> Bytes:
    """Sort each row's patterns as strings of bytes. (N, m, B) -> (N, m, B)"""
    opaque = np.ascontiguousarray(patterns).view(np.dtype((np.void, patterns.shape[2])))[..., 0]  # (N, m), compared by memcmp
    return np.sort(opaque, axis=1)[..., None].view(np.uint8)
