"""Exact law of a randomised function's result, by one run for each possible sequence of its random draws.

The function receives a generator that replays given sequences instead of drawing. A draw from more than `SMALL` numbers (64
random bits, a double in [0, 1)) is not enumerated. If two numbers lead to the same law, all numbers between them are assumed to
lead to it. Otherwise bisection finds the threshold. This is exact for a function that compares such a draw with one threshold, as
samplers do. `PROBES` further numbers detect other functions. Numbers nearer to a threshold than `NEGLIGIBLE` are left open. Their
probability is part of the bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from bench.core.errors import UserError

SMALL = 1024  # outcomes
PROBES = 12
NEGLIGIBLE = Fraction(1, 2**60)
DOUBLE = 2**53  # outcomes of a double in [0, 1)

Randomised = Callable[[np.random.Generator], Hashable]


@dataclass(frozen=True)
class Law:
    """Outcomes with their probabilities, which sum to 1 together with the probability left open."""

    chances: Mapping[Hashable, Fraction]
    left_open: Fraction = Fraction(0)

    def at_most(self, outcome: Hashable) -> Fraction:
        return self.chances.get(outcome, Fraction(0)) + self.left_open


OPEN = Law({}, Fraction(1))


class NotEnumerableError(UserError):
    """The function has too many sequences of draws, or uses an unsupported kind of draw."""


def compute_law(function: Randomised, runs: int = 200_000) -> Law:
    """Return the law of `function(rng)`.

    Parameters
    ----------
    function : function that draws only by `rng.integers`, `random`, `permutation` or `choice` (without weights)
    runs : greatest number of calls

    Raises
    ------
    NotEnumerableError
        if more runs are needed, or the function uses another kind of draw.
    """
    return _Explorer(function, runs).explore(())


def bound_greatest_ratio(laws: Sequence[Law]) -> tuple[Fraction | None, Fraction | None]:
    """Return a lower and an upper bound of the greatest quotient of two laws' probabilities of one outcome; None: infinite."""
    outcomes = {outcome for each in laws for outcome in each.chances}
    least = [[each.chances.get(outcome, Fraction(0)) for each in laws] for outcome in outcomes]
    most = [[each.at_most(outcome) for each in laws] for outcome in outcomes]
    return _find_greatest_quotient(least, most), _find_greatest_quotient(most, least)


def _find_greatest_quotient(over: list[list[Fraction]], under: list[list[Fraction]]) -> Fraction | None:
    """Return the greatest quotient of one outcome's probabilities; outcomes of probability zero are skipped."""
    pairs = [(max(top), min(bottom)) for top, bottom in zip(over, under, strict=True) if max(top) > 0]
    return None if any(bottom == 0 for _, bottom in pairs) else max(top / bottom for top, bottom in pairs)


class _Explorer:
    """Explores the sequences of draws of one function, with a limit on its runs."""

    def __init__(self, function: Randomised, runs: int) -> None:
        self._function, self._runs = function, runs

    def explore(self, draws: tuple[int, ...]) -> Law:
        """Return the law given the first draws."""
        self._runs -= 1
        if self._runs < 0:
            raise NotEnumerableError("its draws have too many sequences")
        try:
            return Law({self._function(_ReplayGenerator(draws)): Fraction(1)})  # type: ignore[arg-type]
        except _PendingDraw as pending:
            outcomes = pending.outcomes
        if outcomes <= SMALL:
            return _mix_laws((self.explore((*draws, k)), Fraction(1, outcomes)) for k in range(outcomes))
        return self._explore_thresholds(draws, outcomes)

    def _explore_thresholds(self, draws: tuple[int, ...], outcomes: int) -> Law:
        """Return the law for a next draw from many numbers."""
        laws: dict[int, Law] = {}

        def evaluate(k: int) -> Law:
            if k not in laws:
                laws[k] = self.explore((*draws, k))
            return laws[k]

        def split(low: int, high: int) -> list[tuple[int, int, Law]]:
            """Return ranges that cover low, ..., high − 1, and the law of each."""
            if high - low == 1 or evaluate(low) == evaluate(high):
                return [(low, high, evaluate(low))]
            if Fraction(high - low, outcomes) < NEGLIGIBLE:
                return [(low, high, OPEN)]
            # Not the exact middle, which may be a threshold. A draw equal to a threshold may lead to endless further draws.
            middle = low + max(1, (high - low) * 13 // 21)
            return split(low, middle) + split(middle, high)

        edge = int(outcomes * NEGLIGIBLE / 2)
        last = outcomes - 1 - edge
        ranges = [*split(edge, last), (last, last + 1, evaluate(last)), (0, edge, OPEN), (last + 1, outcomes, OPEN)]
        for probe in np.random.default_rng(0).random(PROBES):
            k = edge + int(probe * (last - edge))
            if any(low <= k < high and expected not in (evaluate(k), OPEN) for low, high, expected in ranges):
                raise NotEnumerableError("it does more than compare random bits with thresholds")
        return _mix_laws((each, Fraction(high - low, outcomes)) for low, high, each in ranges)


def _mix_laws(parts: Iterable[tuple[Law, Fraction]]) -> Law:
    chances: dict[Hashable, Fraction] = {}
    left_open = Fraction(0)
    for part, weight in parts:
        left_open += weight * part.left_open
        for outcome, chance in part.chances.items():
            chances[outcome] = chances.get(outcome, Fraction(0)) + weight * chance
    return Law(chances, left_open)


class _PendingDraw(BaseException):  # not an Exception, which the function may catch
    """Raised if the sequence ends before a draw from `outcomes` numbers."""

    def __init__(self, outcomes: int) -> None:
        self.outcomes = outcomes


class _ReplayGenerator:
    """A substitute of a generator that replays one sequence of draws."""

    def __init__(self, draws: tuple[int, ...]) -> None:
        self._draws = iter(draws)

    def __getattr__(self, name: str) -> Any:
        raise NotEnumerableError(f"it draws by rng.{name}, which is not supported")

    def _number(self, outcomes: int) -> int:
        if outcomes == 1:
            return 0
        for number in self._draws:
            return number
        raise _PendingDraw(outcomes)

    def _array(self, draw: Callable[[], Any], size: Any, dtype: Any) -> Any:
        if size is None:
            return draw()
        numbers = np.empty(size, dtype=dtype)
        for i in range(numbers.size):
            numbers.flat[i] = draw()
        return numbers

    def integers(self, low: Any, high: Any = None, size: Any = None, dtype: Any = np.int64, endpoint: bool = False) -> Any:
        if np.ndim(low) or np.ndim(high):
            if size is not None:
                raise NotEnumerableError("it draws by rng.integers from many ranges in a given shape, which is not supported")
            ranges = np.broadcast(low, low if high is None else high)
            each = [self.integers(0 if high is None else one, other, endpoint=endpoint) for one, other in ranges]
            return np.array(each, dtype=dtype).reshape(ranges.shape)
        first, end = (0, int(low)) if high is None else (int(low), int(high))
        return self._array(lambda: first + self._number(end - first + endpoint), size, dtype)

    def random(self, size: Any = None, dtype: Any = np.float64) -> Any:
        return self._array(lambda: self._number(DOUBLE) / DOUBLE, size, dtype)

    def permutation(self, x: Any) -> Any:
        return self.choice(x, size=x if np.ndim(x) == 0 else len(x), replace=False)

    def choice(self, a: Any, size: Any = None, replace: bool = True, p: Any = None) -> Any:
        if p is not None:
            raise NotEnumerableError("it draws by rng.choice with weights, which is not supported")
        left = list(range(a)) if np.ndim(a) == 0 else list(a)

        def draw() -> Any:
            index = self._number(len(left))
            return left[index] if replace else left.pop(index)

        return self._array(draw, size, np.asarray(a).dtype)
