"""Smaller dictionaries at the same probability of the true word: every |K| is multiplied by s, every ε is increased by ln s.

The probability that the true word is in its set is m e^ε / (m e^ε + |K| − m). Apart from the − m it depends on |K| and ε through
|K| e^-ε alone, which s |K| and ε + ln s leave unchanged. The guarantee changes: the smaller table has a smaller ε.
"""

from __future__ import annotations

import math


def words(paper: int, factor: float) -> int:
    """Return our |K| for the paper's."""
    return round(paper * factor)


def epsilon(paper: float, factor: float) -> float:
    """Return our ε for the paper's."""
    return paper + math.log(factor)
