"""Numbers with their exact value."""

import math
import pickle
from decimal import Decimal
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.core.exact import Exact, to_fraction


@pytest.mark.parametrize(
    ("text", "fraction", "written"),
    [
        ("0.1", Fraction(1, 10), "0.1"),
        ("21/2", Fraction(21, 2), "10.5"),
        ("1/3", Fraction(1, 3), "1/3"),
        ("1e-3", Fraction(1, 1000), "0.001"),
        ("0.1000000000000000000001", Fraction(10**21 + 1, 10**22), str(Fraction(10**21 + 1, 10**22))),
        (" -2 ", Fraction(-2), "-2.0"),
    ],
)
def test_text_is_exact(text: str, fraction: Fraction, written: str) -> None:
    number = Exact(text)
    assert number.fraction == fraction == to_fraction(number)
    assert number == float(fraction)
    assert str(number) == repr(number) == written
    assert Exact(written).fraction == fraction


@given(st.fractions() | st.decimals(allow_nan=False, allow_infinity=False, min_value=-(10**9), max_value=10**9))
def test_fractions_and_decimals_are_exact(value: Fraction | Decimal) -> None:
    assert to_fraction(Exact(value)) == Fraction(value)
    assert to_fraction(Exact(str(Exact(value)))) == Fraction(value)


def test_float_stands_for_its_printed_decimal() -> None:
    assert to_fraction(0.1) == Fraction(1, 10) != Fraction(0.1)
    assert to_fraction(Exact(0.1)) == Fraction(1, 10)
    assert to_fraction(3) == 3


def test_infinity() -> None:
    for text in ("inf", "Infinity", "-inf", math.inf):
        assert math.isinf(Exact(text))
        assert Exact(text).fraction is None
    assert str(Exact("inf")) == "inf"
    with pytest.raises(OverflowError):
        to_fraction(Exact("inf"))


def test_exponents_at_the_limits_of_doubles() -> None:
    assert to_fraction("1e308") == 10**308
    assert to_fraction("5e-324") == Fraction(5, 10**324)
    assert Exact("0." + "0" * 4000 + "1E4000") == 0.1
    assert Exact("0E400000").fraction == 0


# Written out, the first three have a thousand times fewer digits than those that take hours, so that a missing bound fails the
# tests and does not block them.
HUGE = ["1E400000", "-1E400000", "1E-400000", "1E99999999999999999999", "1" * 5000, "1e-400"]


@pytest.mark.parametrize("text", [*HUGE, "", "nan", "much", "1/0", "1e400", "1/2/3", "1E400000000/3", "sNaN"])
def test_invalid_text(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        Exact(text)


@pytest.mark.parametrize("text", HUGE)
def test_exponents_are_bounded_before_the_number_is_built(text: str) -> None:
    with pytest.raises((ValueError, OverflowError)):
        to_fraction(text)


@pytest.mark.parametrize("text", HUGE[:3])
def test_exponents_of_decimals_are_bounded(text: str) -> None:
    with pytest.raises(OverflowError):
        to_fraction(Decimal(text))


def test_copy_is_exact() -> None:
    assert to_fraction(pickle.loads(pickle.dumps(Exact("1/3")))) == Fraction(1, 3)
