"""Smaller dictionaries at the same probability of the true word: each |K| is multiplied by s, and ln s is added to each ε.

The probability that the true word is in its set is m e^ε / (m e^ε + |K| − m). Apart from the term − m, it depends on |K| and
ε through |K| e^-ε alone. s |K| and ε + ln s have the same value of it. The guarantee changes, since the smaller table has a
smaller ε.
"""

from __future__ import annotations

import math


def words(paper: int, factor: float) -> int:
    """Return our |K| for the paper's |K|."""
    return round(paper * factor)


def epsilon(paper: float, factor: float) -> float:
    """Return our ε for the paper's ε."""
    return paper + math.log(factor)
