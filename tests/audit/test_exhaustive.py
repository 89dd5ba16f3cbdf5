"""Distributions from the enumeration of all sequences of draws, against known distributions."""

import itertools
import math
from collections import Counter
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from bench.audit.exhaustive import Law, NotEnumerableError, bound_greatest_ratio, compute_law
from bench.mechanisms.subset import chance_digits, draw_word_subsets

EDGE = Fraction(1, 2**58)


def test_dice() -> None:
    found = compute_law(lambda rng: int(rng.integers(1, 6, endpoint=True) + rng.integers(1, 7)))
    expected = Counter(a + b for a in range(1, 7) for b in range(1, 7))
    assert found.chances == {total: Fraction(count, 36) for total, count in expected.items()}
    assert found.left_open == 0


def test_arrays_choices_and_permutations() -> None:
    assert compute_law(lambda rng: tuple(rng.integers(2, size=(2, 2)).ravel().tolist())).chances == dict.fromkeys(
        itertools.product((0, 1), repeat=4), Fraction(1, 16)
    )
    assert compute_law(lambda rng: tuple(rng.permutation(4).tolist())).chances == dict.fromkeys(
        itertools.permutations(range(4)), Fraction(1, 24)
    )
    pairs = compute_law(lambda rng: tuple(rng.choice(np.array([5, 6, 7]), size=2, replace=False).tolist())).chances
    assert pairs == dict.fromkeys(itertools.permutations((5, 6, 7), 2), Fraction(1, 6))


def test_draws_from_several_ranges() -> None:
    found = compute_law(lambda rng: tuple(rng.integers(np.array([2, 3])).tolist())).chances
    assert found == dict.fromkeys(itertools.product(range(2), range(3)), Fraction(1, 6))
    dice = compute_law(lambda rng: tuple(rng.integers(1, np.array([[2], [2]]), endpoint=True).ravel().tolist())).chances
    assert dice == dict.fromkeys(itertools.product((1, 2), repeat=2), Fraction(1, 4))


def test_doubles_are_exact() -> None:
    """0.3 is not a multiple of 2^-53, but the probability of rng.random() < 0.3 is such a multiple."""
    found = compute_law(lambda rng: bool(rng.random() < 0.3))
    assert found.left_open == 0
    assert found.chances[True] == Fraction(math.ceil(Fraction(0.3) * 2**53), 2**53)
    assert sum(found.chances.values()) == 1


def test_several_thresholds_and_further_draws() -> None:
    def mechanism(rng: np.random.Generator) -> Any:
        x = rng.random()
        return "low" if x < 0.25 else int(rng.integers(3)) if x < 0.75 else "high"

    assert compute_law(mechanism).chances == {
        "low": Fraction(1, 4),
        "high": Fraction(1, 4),
        **dict.fromkeys(range(3), Fraction(1, 6)),
    }


@pytest.mark.slow
@pytest.mark.parametrize(("domain", "size", "epsilon"), [(4, 2, 2.0), (3, 1, 1.0), (4, 3, 0.5), (4, 2, 0.0)])
def test_the_sampler_has_the_law_of_the_theorem(domain: int, size: int, epsilon: float) -> None:
    """Both kinds of draws agree to within 2^-58, the precision of p."""
    p = Fraction(chance_digits(epsilon, domain, size, 128), 2**128)
    for true in range(domain):
        found = compute_law(
            lambda rng, true=true: tuple(draw_word_subsets(np.array([true]), domain, epsilon, size, rng)[0].tolist())
        )
        assert found.left_open < EDGE
        for Z in itertools.combinations(range(domain), size):
            expected = p / math.comb(domain - 1, size - 1) if true in Z else (1 - p) / math.comb(domain - 1, size)
            assert found.chances[Z] <= expected + Fraction(1, 2**120)
            assert expected <= found.at_most(Z) + Fraction(1, 2**120)


def test_greatest_ratio() -> None:
    laws = [Law({"a": Fraction(1, 2), "b": Fraction(1, 2)}), Law({"a": Fraction(1, 8), "b": Fraction(7, 8)})]
    assert bound_greatest_ratio(laws) == (4, 4)
    open_laws = [Law({"a": Fraction(3, 4)}, Fraction(1, 4)), Law({"a": Fraction(1, 2), "b": Fraction(1, 2)})]
    assert bound_greatest_ratio(open_laws) == (2, None)  # b has between 0 and 1/4 under the first
    certain = [Law({"a": Fraction(1)}), Law({"b": Fraction(1)})]
    assert bound_greatest_ratio(certain) == (None, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mechanism", "reason"),
    [
        (lambda rng: rng.normal(), r"rng\.normal"),
        (lambda rng: rng.choice(2, p=[0.2, 0.8]), "weights"),
        (lambda rng: rng.integers(np.array([2, 3]), size=2), "many ranges"),
        (lambda rng: tuple(rng.integers(10, size=9).tolist()), "too many sequences"),
        (lambda rng: int(rng.integers(2**40)) % 2, "thresholds"),
        (
            lambda rng: 0.2 < rng.random() < 0.8,
            "thresholds",
        ),  # its range has the same law at both ends and another in the middle
    ],
)
def test_unsupported_functions_are_refused(mechanism: Any, reason: str) -> None:
    with pytest.raises(NotEnumerableError, match=reason):
        compute_law(mechanism, 5000)


def test_a_function_that_catches_all_exceptions() -> None:
    def careless(rng: np.random.Generator) -> int:
        try:
            return int(rng.integers(4))
        except Exception:
            return -1

    assert compute_law(careless).chances == dict.fromkeys(range(4), Fraction(1, 4))
