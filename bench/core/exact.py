"""Numbers kept as they were written, as a decimal or a fraction, beside the double that is nearest to them."""

from __future__ import annotations

from decimal import Decimal
from fractions import Fraction

INFINITE = ("inf", "infinity")


class Exact(float):
    """A number such as `Exact("0.1")`, `Exact("1/3")` or `Exact("inf")`: a float where floats are used, exact in `fraction`.

    Raises
    ------
    ValueError
        if the text is no number, or one too large for a double.
    """

    fraction: Fraction | None  # None if infinite

    def __new__(cls, value: str | float | Decimal | Fraction) -> Exact:
        infinite = str(value).strip().lstrip("+-").lower() in INFINITE
        try:
            fraction = None if infinite else exact(value)
            found = super().__new__(cls, value if fraction is None else fraction)
        except (ZeroDivisionError, OverflowError) as error:
            raise ValueError(f"{value!r}: {error}") from None
        found.fraction = fraction
        return found

    def __str__(self) -> str:
        """As a decimal where a double's shortest one says it all, else as a fraction; `Exact` reads back either."""
        short = float.__repr__(self)
        return short if self.fraction is None or self.fraction == Fraction(short) else str(self.fraction)

    __repr__ = __str__


def exact(value: str | float | Decimal | Fraction) -> Fraction:
    """The finite number that is meant: of an `Exact` its fraction, of another float the decimal that `repr` prints.

    Raises
    ------
    ValueError, OverflowError
        if it is none.
    """
    if isinstance(value, Exact):
        if value.fraction is None:
            raise OverflowError("infinity is no fraction")
        return value.fraction
    return Fraction(repr(float(value)) if isinstance(value, float) else value)
