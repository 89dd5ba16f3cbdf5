"""Numbers that store the decimal or fraction as written, beside the nearest double."""

from __future__ import annotations

from decimal import Decimal
from fractions import Fraction

INFINITE = ("inf", "infinity")


class Exact(float):
    """A float with its exact value in `fraction`, such as `Exact("0.1")`, `Exact("1/3")` or `Exact("inf")`.

    Raises
    ------
    ValueError
        if the text is not a number, or too large for a double.
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
        if `value` is not a finite number.
    """
    if isinstance(value, Exact):
        if value.fraction is None:
            raise OverflowError("infinity is not a fraction")
        return value.fraction
    return Fraction(repr(float(value)) if isinstance(value, float) else value)
