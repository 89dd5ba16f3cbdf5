"""Smaller dictionaries at the same chance of the truth: every |K| times s, every ε plus ln s.

The chance that the true word is in its set, m e^ε / (m e^ε + |K| − m), depends on |K| and ε through |K| e^-ε alone (but for the
− m), which s |K| and ε + ln s leave as it is. The guarantee does not stay: the smaller table's ε is a smaller ε.
"""

from __future__ import annotations

import math


def words(paper: int, factor: float) -> int:
    """Our |K| for the paper's."""
    return round(paper * factor)


def epsilon(paper: float, factor: float) -> float:
    """Our ε for the paper's."""
    return paper + math.log(factor)
