"""The exact law of what a randomised function returns, by running it once for each course that its random draws can take.

The function is handed a generator that does not draw, but plays one course after another. A draw from more than `SMALL` numbers
(64 random bits, a double in [0, 1)) is not played number by number: where two numbers lead to one law, all between them are taken
to do so, and where they do not, bisection finds the border. That is exact for a function which compares such a draw with one
threshold, as samplers do; numbers at `PROBES` more places tell where that is not so. What lies nearer to a border than
`NEGLIGIBLE` is left open, and accounted for.
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
    """Outcomes with their probabilities. Together with what was left open they make 1."""

    chances: Mapping[Hashable, Fraction]
    left_open: Fraction = Fraction(0)

    def at_most(self, outcome: Hashable) -> Fraction:
        return self.chances.get(outcome, Fraction(0)) + self.left_open


OPEN = Law({}, Fraction(1))


class NotEnumerableError(UserError):
    """The function has too many courses, or draws in a way that cannot be played."""


def law(function: Randomised, runs: int = 200_000) -> Law:
    """The law of `function(rng)`.

    Parameters
    ----------
    function : draws by `rng.integers`, `random`, `permutation` or `choice` (without weights), and by nothing else
    runs : of it, at most

    Raises
    ------
    NotEnumerableError
        if they are not enough, or the function draws in another way.
    """
    return _Explorer(function, runs).after(())


def greatest_ratio(laws: Sequence[Law]) -> tuple[Fraction | None, Fraction | None]:
    """Bounds, from below and above, of the greatest quotient of two laws' probabilities of one outcome. None is infinite."""
    outcomes = {outcome for each in laws for outcome in each.chances}
    least = [[each.chances.get(outcome, Fraction(0)) for each in laws] for outcome in outcomes]
    most = [[each.at_most(outcome) for each in laws] for outcome in outcomes]
    return _greatest(least, most), _greatest(most, least)


def _greatest(over: list[list[Fraction]], under: list[list[Fraction]]) -> Fraction | None:
    """The greatest quotient of one outcome's probabilities; those that are nowhere positive have none."""
    pairs = [(max(top), min(bottom)) for top, bottom in zip(over, under, strict=True) if max(top) > 0]
    return None if any(bottom == 0 for _, bottom in pairs) else max(top / bottom for top, bottom in pairs)


class _Explorer:
    """Counts the runs of one function."""

    def __init__(self, function: Randomised, runs: int) -> None:
        self._function, self._runs = function, runs

    def after(self, course: tuple[int, ...]) -> Law:
        """The law once the first draws came out as in `course`."""
        self._runs -= 1
        if self._runs < 0:
            raise NotEnumerableError("its draws can take too many courses")
        try:
            return Law({self._function(_Player(course)): Fraction(1)})  # type: ignore[arg-type]
        except _Unplayed as draw:
            outcomes = draw.outcomes
        if outcomes <= SMALL:
            return _mixture((self.after((*course, k)), Fraction(1, outcomes)) for k in range(outcomes))
        return self._by_thresholds(course, outcomes)

    def _by_thresholds(self, course: tuple[int, ...], outcomes: int) -> Law:
        """The law where the next draw is from many numbers."""
        known: dict[int, Law] = {}

        def at(k: int) -> Law:
            if k not in known:
                known[k] = self.after((*course, k))
            return known[k]

        def between(low: int, high: int) -> list[tuple[int, int, Law]]:
            """Ranges that cover low, ..., high − 1, and the law of each."""
            if high - low == 1 or at(low) == at(high):
                return [(low, high, at(low))]
            if Fraction(high - low, outcomes) < NEGLIGIBLE:
                return [(low, high, OPEN)]
            # Not the very middle, which may be a threshold; a draw that equals one may lead to more draws without end.
            middle = low + max(1, (high - low) * 13 // 21)
            return between(low, middle) + between(middle, high)

        edge = int(outcomes * NEGLIGIBLE / 2)
        last = outcomes - 1 - edge
        ranges = [*between(edge, last), (last, last + 1, at(last)), (0, edge, OPEN), (last + 1, outcomes, OPEN)]
        for probe in np.random.default_rng(0).random(PROBES):
            k = edge + int(probe * (last - edge))
            if any(low <= k < high and expected not in (at(k), OPEN) for low, high, expected in ranges):
                raise NotEnumerableError("it does not compare random bits with thresholds alone")
        return _mixture((each, Fraction(high - low, outcomes)) for low, high, each in ranges)


def _mixture(parts: Iterable[tuple[Law, Fraction]]) -> Law:
    chances: dict[Hashable, Fraction] = {}
    left_open = Fraction(0)
    for part, weight in parts:
        left_open += weight * part.left_open
        for outcome, chance in part.chances.items():
            chances[outcome] = chances.get(outcome, Fraction(0)) + weight * chance
    return Law(chances, left_open)


class _Unplayed(BaseException):  # not an Exception, which the function may catch
    """The course ends at a draw from so many numbers."""

    def __init__(self, outcomes: int) -> None:
        self.outcomes = outcomes


class _Player:
    """Stands in for a generator, and plays one course."""

    def __init__(self, course: tuple[int, ...]) -> None:
        self._course = iter(course)

    def __getattr__(self, name: str) -> Any:
        raise NotEnumerableError(f"it draws by rng.{name}, which is not played")

    def _number(self, outcomes: int) -> int:
        if outcomes == 1:
            return 0
        for number in self._course:
            return number
        raise _Unplayed(outcomes)

    def _array(self, draw: Callable[[], Any], size: Any, dtype: Any) -> Any:
        if size is None:
            return draw()
        numbers = np.empty(size, dtype=dtype)
        for place in range(numbers.size):
            numbers.flat[place] = draw()
        return numbers

    def integers(self, low: Any, high: Any = None, size: Any = None, dtype: Any = np.int64, endpoint: bool = False) -> Any:
        if np.ndim(low) or np.ndim(high):
            if size is not None:
                raise NotEnumerableError("it draws by rng.integers from many ranges in a given shape, which is not played")
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
            raise NotEnumerableError("it draws by rng.choice with weights, which is not played")
        left = list(range(a)) if np.ndim(a) == 0 else list(a)

        def draw() -> Any:
            place = self._number(len(left))
            return left[place] if replace else left.pop(place)

        return self._array(draw, size, np.asarray(a).dtype)
