"""Composition against the definition, sixty digits and Google's accountant."""

import itertools
import math
from fractions import Fraction

import mpmath
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.mechanisms.composition import DELTA, compose, compose_basic, compose_optimal, solve_epsilon


def least_epsilon(epsilon: float, answers: int, delta: float) -> float:
    """Return the least ε' at which no event of N randomised responses exceeds e^ε' times its other probability by more than δ."""
    truth = math.exp(epsilon) / (1 + math.exp(epsilon))
    pairs = []
    for lies in itertools.product((0, 1), repeat=answers):
        count = sum(lies)
        pairs.append((truth ** (answers - count) * (1 - truth) ** count, truth**count * (1 - truth) ** (answers - count)))

    def excess(total: float) -> float:
        return math.fsum(max(0.0, p - math.exp(total) * q) for p, q in pairs)

    low, high = 0.0, answers * epsilon
    if excess(0.0) <= delta:
        return 0.0
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (low, middle) if excess(middle) <= delta else (middle, high)
    return high


@pytest.mark.parametrize("delta", [1e-6, 1e-2, 0.3])
@pytest.mark.parametrize("answers", [1, 2, 5, 10])
@pytest.mark.parametrize("epsilon", [0.01, 0.5, 2.0, 6.0])
def test_against_the_definition(epsilon: float, answers: int, delta: float) -> None:
    assert compose_optimal(epsilon, answers, delta) == pytest.approx(least_epsilon(epsilon, answers, delta), rel=1e-9, abs=1e-12)


def test_control_other_values_of_delta_differ() -> None:
    assert compose_optimal(0.5, 10, 0.01) > 1.01 * least_epsilon(0.5, 10, 0.02)
    assert compose_optimal(0.5, 10, 0.01) < 0.99 * least_epsilon(0.5, 10, 0.005)


def compute_with_sixty_digits(epsilon: float, answers: int, delta: float) -> mpmath.mpf:
    with mpmath.workdps(60):
        lie = mpmath.exp(-epsilon) / (1 + mpmath.exp(-epsilon))
        A = B = best = mpmath.mpf(0)
        for lies in range(answers + 1):
            ways = mpmath.binomial(answers, lies)
            A += ways * (1 - lie) ** (answers - lies) * lie**lies
            B += ways * (1 - lie) ** lies * lie ** (answers - lies)
            if delta < A:
                best = max(best, mpmath.log((A - delta) / B))
        return best


@pytest.mark.slow
@pytest.mark.parametrize(
    ("epsilon", "answers"),
    [(1e-4, 10), (0.001, 3000), (0.06, 1000), (0.5, 2000), (10.0, 565), (10.0, 2000), (100.0, 30), (1000.0, 20)],
)
def test_against_sixty_digits(epsilon: float, answers: int) -> None:
    assert compose_optimal(epsilon, answers) == pytest.approx(
        float(compute_with_sixty_digits(epsilon, answers, DELTA)), rel=1e-11
    )


@pytest.mark.slow
@pytest.mark.parametrize(("epsilon", "answers"), [(1.0, 50), (0.5, 200), (0.02, 3000)])
def test_against_googles_accountant(epsilon: float, answers: int) -> None:
    """For randomised responses. The accountant rounds each loss up to a multiple of a step."""
    from dp_accounting.pld import privacy_loss_distribution

    step = epsilon / 1000
    one = privacy_loss_distribution.from_randomized_response(2 / (1 + math.exp(epsilon)), 2, value_discretization_interval=step)
    theirs = one.self_compose(answers).get_epsilon_for_delta(DELTA)
    assert compose_optimal(epsilon, answers) <= theirs <= compose_optimal(epsilon, answers) + answers * step
    assert theirs < 0.97 * compose_basic(epsilon, answers)


def test_large_numbers_neither_overflow_nor_lose_digits() -> None:
    for epsilon in (100.0, 1000.0):
        for answers in (1, 1000, 10_000):
            assert compose_optimal(epsilon, answers) == pytest.approx(
                compose_basic(epsilon, answers) + math.log1p(-DELTA), rel=1e-13
            )
    assert 0 < compose_optimal(1e-5, 10_000) < compose_basic(1e-5, 10_000)


@settings(max_examples=80, deadline=None)
@given(st.floats(0, 50), st.integers(0, 500), st.sampled_from([1e-9, 1e-6, 0.1]))
def test_never_more_than_basic(epsilon: float, answers: int, delta: float) -> None:
    cost = compose_optimal(epsilon, answers, delta)
    assert 0 <= cost <= compose_basic(epsilon, answers) * (1 + 1e-12)
    assert compose(epsilon, answers, delta) == min(cost, compose_basic(epsilon, answers))
    assert compose_optimal(epsilon, answers + 1, delta) >= cost * (1 - 1e-12)
    assert compose_optimal(epsilon, answers, delta / 2) >= cost * (1 - 1e-12)


def test_special_cases() -> None:
    assert compose_optimal(3.0, 7, 0.0) == compose_basic(3.0, 7) == 21.0
    assert compose_optimal(3.0, 0) == compose_basic(math.inf, 0) == 0.0
    assert math.isinf(compose_optimal(math.inf, 3))
    assert math.isinf(compose_basic(math.inf, 3))
    assert compose_optimal(1e-7, 1) == 0.0  # δ pays for all of it


@pytest.mark.parametrize("answers", [1, 565, 10_000])
@pytest.mark.parametrize("total", [1e-3, 10.0, 5650.0, 1e6])
def test_solved_epsilon_composes_to_the_total(total: float, answers: int) -> None:
    for cost in (compose_basic, compose_optimal, compose):
        assert cost(solve_epsilon(total, answers, cost), answers) == pytest.approx(total, rel=1e-6)
    assert solve_epsilon(total, answers) >= float(Fraction(total) / answers) * (1 - 1e-9)


def test_zero_and_infinite_totals() -> None:
    assert solve_epsilon(0.0, 10) == 0.0
    assert math.isinf(solve_epsilon(math.inf, 10))
