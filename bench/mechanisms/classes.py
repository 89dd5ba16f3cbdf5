"""Exact draws of classes whose chances have ratios of integers times powers of e: no step is rounded.

Pr(class j) = n_j e^(a_j) / Σ_i n_i e^(a_i) for integers n_j ≥ 0 and fractions a_j. A uniform number in [0, 1) falls between two
of the cumulated chances. The number and the chances are compared bit by bit, with as many bits as necessary. A cumulated chance
is rational if all non-empty classes have one power, or if it covers none or all of them. Otherwise it is irrational, because e to
distinct algebraic powers are linearly independent over the algebraic numbers (Lindemann and Weierstrass). A finite precision then
determines its digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import MAX_EMAX, MIN_EMIN, Context, Decimal
from fractions import Fraction
from functools import lru_cache
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from bench.types import Indices

WIDTH = 64  # bits compared in one step


def draw_classes(
    profiles: Sequence[Sequence[int]], powers: Sequence[Fraction], which: Indices, rng: np.random.Generator
) -> Indices:
    """Return a random class for each row.

    Parameters
    ----------
    profiles : P times J numbers n_j, some of them positive; they may be too large for 64 bits
    powers : J numbers a_j
    which : (N,) the profile of each row

    Returns
    -------
    (N,) classes
    """
    if len(set(powers)) == 1 and max(map(sum, profiles)) < 2**62:
        totals = np.array([list(accumulate(counts)) for counts in profiles], dtype=np.int64)[which]  # (N, J)
        return (totals <= rng.integers(totals[:, -1])[:, None]).sum(axis=1)
    last = 2**WIDTH - 1
    table = [[min(edge, last) for edge in edges(counts, powers, WIDTH)] for counts in profiles]
    first = np.array(table, dtype=np.uint64).reshape(len(profiles), len(powers) - 1)[which]  # (N, J − 1)
    drawn = rng.integers(last, size=len(which), dtype=np.uint64, endpoint=True)
    classes = (first < drawn[:, None]).sum(axis=1)
    for row in np.flatnonzero((first == drawn[:, None]).any(axis=1)):
        classes[row] = _refine_draw(profiles[which[row]], powers, int(drawn[row]), rng)
    return classes


def _refine_draw(counts: Sequence[int], powers: Sequence[Fraction], number: int, rng: np.random.Generator) -> int:
    """Draw further bits of a number until it differs from all edges, and return its class."""
    bits = WIDTH
    while number in (limits := edges(counts, powers, bits)):
        number = number << WIDTH | int(rng.integers(2**WIDTH - 1, dtype=np.uint64, endpoint=True))
        bits += WIDTH
    return sum(edge < number for edge in limits)


def edges(counts: Sequence[int], powers: Sequence[Fraction], bits: int) -> list[int]:
    """Return floor(2^bits · Pr(one of the first j classes)) for j = 1, ..., J − 1, exactly."""
    filled = [power for count, power in zip(counts, powers, strict=True) if count]
    if len(set(filled)) == 1:
        return [(below << bits) // sum(counts) for below in list(accumulate(counts))[:-1]]
    top, precision = max(filled), bits + 2 * WIDTH
    relative = tuple(min(power - top, Fraction(0)) for power in powers)  # greater powers belong to empty classes
    while True:
        limits = _enclose_edges(counts, exponentials(relative, precision), bits)
        if limits is not None:
            return limits
        precision *= 2


def _enclose_edges(counts: Sequence[int], weights: Sequence[tuple[int, int]], bits: int) -> list[int] | None:
    """Return the edges; None if these bounds of the classes' weights do not determine them."""
    low = list(accumulate(count * least for count, (least, _) in zip(counts, weights, strict=True)))
    high = list(accumulate(count * most for count, (_, most) in zip(counts, weights, strict=True)))
    left = list(accumulate(counts))
    limits = []
    for index in range(len(counts) - 1):
        if left[index] in (0, left[-1]):
            limits.append((1 << bits) if left[index] else 0)
            continue
        floor = (low[index] << bits) // (low[index] + high[-1] - high[index])
        ceiling = (high[index] << bits) // (high[index] + low[-1] - low[index])
        if floor != min(ceiling, (1 << bits) - 1):  # below 1, even if the weight of the next classes is below the precision
            return None
        limits.append(floor)
    return limits


@lru_cache(maxsize=256)
def exponentials(powers: tuple[Fraction, ...], precision: int) -> list[tuple[int, int]]:
    """Return integers below and above 2^precision · e^a, for each a ≤ 0."""
    return [_exponential(power, precision) for power in powers]


def _exponential(power: Fraction, precision: int) -> tuple[int, int]:
    """Return integers below and above 2^precision · e^power. `decimal` rounds correctly, so the product errs by less than 1."""
    if power == 0:
        return 1 << precision, 1 << precision
    if -power > precision:
        return 0, 1  # e^-precision < 2^-precision
    context = Context(prec=precision // 3 + len(str(precision)) + 10, Emax=MAX_EMAX, Emin=MIN_EMIN)
    argument = context.divide(Decimal(power.numerator), Decimal(power.denominator))
    scaled = int(context.multiply(context.exp(argument), context.power(2, precision)))
    return max(0, scaled - 1), scaled + 2


def chances(counts: NDArray[np.integer], powers: Sequence[float]) -> NDArray[np.float64]:
    """Return the chances to the precision of a double. (..., J), J -> (..., J)"""
    with np.errstate(divide="ignore"):
        logs = np.log(counts) + np.array(powers, dtype=float)
    return np.exp(logs - np.logaddexp.reduce(logs, axis=-1, keepdims=True))
