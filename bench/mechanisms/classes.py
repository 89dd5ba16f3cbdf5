"""Classes drawn with chances whose ratios are integers times powers of e, exactly: no step is rounded.

Pr(class j) = n_j e^(a_j) / Σ_i n_i e^(a_i) for integers n_j ≥ 0 and fractions a_j. A uniform number in [0, 1) falls between two
of the cumulated chances; both are read bit by bit, as many bits as it takes. A cumulated chance is rational if the classes that
are not empty have one power, or one lies between none and all of them; else it is irrational, as e to distinct algebraic powers
are linearly independent over the algebraic numbers (Lindemann and Weierstrass), so that a finite precision tells its digits.
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

WIDTH = 64  # bits that are compared in one step


def draw_classes(
    profiles: Sequence[Sequence[int]], powers: Sequence[Fraction], which: Indices, rng: np.random.Generator
) -> Indices:
    """Draw a class for each row.

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
    chosen = (first < drawn[:, None]).sum(axis=1)
    for row in np.flatnonzero((first == drawn[:, None]).any(axis=1)):
        chosen[row] = _drawn_on(profiles[which[row]], powers, int(drawn[row]), rng)
    return chosen


def _drawn_on(counts: Sequence[int], powers: Sequence[Fraction], number: int, rng: np.random.Generator) -> int:
    """The class of a number whose first bits may be those of an edge."""
    bits = WIDTH
    while number in (found := edges(counts, powers, bits)):
        number = number << WIDTH | int(rng.integers(2**WIDTH - 1, dtype=np.uint64, endpoint=True))
        bits += WIDTH
    return sum(edge < number for edge in found)


def edges(counts: Sequence[int], powers: Sequence[Fraction], bits: int) -> list[int]:
    """floor(2^bits · Pr(one of the first j classes)) for j = 1, ..., J − 1, exactly."""
    filled = [power for count, power in zip(counts, powers, strict=True) if count]
    if len(set(filled)) == 1:
        return [(below << bits) // sum(counts) for below in list(accumulate(counts))[:-1]]
    top, places = max(filled), bits + 2 * WIDTH
    relative = tuple(min(power - top, Fraction(0)) for power in powers)  # those above are of empty classes
    while True:
        found = _enclosed(counts, exponentials(relative, places), bits)
        if found is not None:
            return found
        places *= 2


def _enclosed(counts: Sequence[int], weights: Sequence[tuple[int, int]], bits: int) -> list[int] | None:
    """The edges, if these bounds of the classes' weights tell them."""
    low = list(accumulate(count * least for count, (least, _) in zip(counts, weights, strict=True)))
    high = list(accumulate(count * most for count, (_, most) in zip(counts, weights, strict=True)))
    left = list(accumulate(counts))
    found = []
    for place in range(len(counts) - 1):
        if left[place] in (0, left[-1]):
            found.append((1 << bits) if left[place] else 0)
            continue
        floor = (low[place] << bits) // (low[place] + high[-1] - high[place])
        ceiling = (high[place] << bits) // (high[place] + low[-1] - low[place])
        if floor != min(ceiling, (1 << bits) - 1):  # below 1, though the classes that follow may weigh less than can be seen
            return None
        found.append(floor)
    return found


@lru_cache(maxsize=256)
def exponentials(powers: tuple[Fraction, ...], places: int) -> list[tuple[int, int]]:
    """Integers below and above 2^places · e^a, for each a ≤ 0."""
    return [_exponential(power, places) for power in powers]


def _exponential(power: Fraction, places: int) -> tuple[int, int]:
    """`decimal` rounds each operation correctly: with so many digits the product errs by less than 1."""
    if power == 0:
        return 1 << places, 1 << places
    if -power > places:
        return 0, 1  # e^-places < 2^-places
    context = Context(prec=places // 3 + len(str(places)) + 10, Emax=MAX_EMAX, Emin=MIN_EMIN)
    argument = context.divide(Decimal(power.numerator), Decimal(power.denominator))
    scaled = int(context.multiply(context.exp(argument), context.power(2, places)))
    return max(0, scaled - 1), scaled + 2


def chances(counts: NDArray[np.integer], powers: Sequence[float]) -> NDArray[np.float64]:
    """The same chances to a double's precision. (..., J), J -> (..., J)"""
    with np.errstate(divide="ignore"):
        logs = np.log(counts) + np.array(powers, dtype=float)
    return np.exp(logs - np.logaddexp.reduce(logs, axis=-1, keepdims=True))
