"""Numbers that store the decimal or fraction as written, beside the nearest double."""

from __future__ import annotations

from decimal import Decimal, DecimalException
from fractions import Fraction

INFINITE = ("inf", "infinity")
# Decimal exponents of the least and the greatest double. They are tested first: a fraction beyond them may not fit into memory.
LEAST, GREATEST = -324, 308


class Exact(float):
    """A float with its exact value in `fraction`, such as `Exact("0.1")`, `Exact("1/3")` or `Exact("inf")`.

    Raises
    ------
    ValueError
        if the text is not a number, or too large or too small for a double.
    """

    fraction: Fraction | None  # None if infinite

    def __new__(cls, value: str | float | Decimal | Fraction) -> Exact:
        infinite = str(value).strip().lstrip("+-").lower() in INFINITE
        try:
            fraction = None if infinite else to_fraction(value)
            number = super().__new__(cls, value if fraction is None else fraction)
        except (ZeroDivisionError, OverflowError) as error:
            raise ValueError(f"{value!r}: {error}") from None
        number.fraction = fraction
        return number

    def __str__(self) -> str:
        """Return the shortest decimal if it is exact, else the fraction. `Exact` reads both."""
        short = float.__repr__(self)
        return short if self.fraction is None or self.fraction == Fraction(short) else str(self.fraction)

    __repr__ = __str__


def to_fraction(value: str | float | Decimal | Fraction) -> Fraction:
    """Return a finite number as a fraction. A float that is not `Exact` stands for the decimal that `repr` prints.

    Raises
    ------
    ValueError, OverflowError
        if `value` is not a finite number, or outside the exponents of doubles.
    """
    if isinstance(value, Exact):
        if value.fraction is None:
            raise OverflowError("infinity is not a fraction")
        return value.fraction
    if isinstance(value, (str, Decimal)) and "/" not in str(value):
        return _from_decimal(value)
    return Fraction(repr(float(value)) if isinstance(value, float) else value)


def _from_decimal(value: str | Decimal) -> Fraction:
    try:
        decimal = Decimal(value)
    except DecimalException as error:  # such as an exponent of 20 digits
        raise ValueError(f"{value!r} is not a number of this range") from error
    if decimal.is_finite() and decimal == 0:
        return Fraction(0)
    if decimal.is_finite() and not LEAST <= decimal.adjusted() <= GREATEST:
        raise OverflowError("its exponent is outside the range of a double")
    return Fraction(value)
