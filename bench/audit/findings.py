"""Counts of events in many calls, and what they show: the event is chosen on one half of the calls and measured on the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bench.audit.bounds import log_ratio, more_alike_than_independent
from bench.audit.events import Flags

CONFIDENCE = 0.95  # of bounds
CERTAINTY = 1 - 1e-6  # of the verdict `violated`, over all families together


@dataclass(frozen=True)
class Finding:
    """What one family of events shows."""

    family: str
    event: str  # in words
    rates: tuple[float, float]  # given the input under which the event is likelier, and given the other one
    trials: int  # of each input
    epsilon: float  # at least, with CONFIDENCE
    certain: float  # at least, with CERTAINTY
    expected: float  # the bound on the half of the calls by which the event was chosen
    alike: bool  # whether answers of one call were too much alike, so that one of each call was counted

    def per(self, distance: float) -> Finding:
        """The same, with bounds per unit of the distance that the two inputs are apart."""
        return replace(self, epsilon=self.epsilon / distance, certain=self.certain / distance, expected=self.expected / distance)


@dataclass(eq=False)
class Tally:
    """Counts of one family's events under two inputs, call by call."""

    hits: list[NDArray[np.int32]] = field(default_factory=list)  # of (2, E), over the places of a call
    first: list[Flags] = field(default_factory=list)  # of (2, E), at the first place alone

    def add(self, one: Flags, other: Flags) -> None:
        """Count a call in which events happened, or not, at each place. (P, E), (P, E)"""
        self.hits.append(np.stack([one.sum(axis=0), other.sum(axis=0)]).astype(np.int32))
        self.first.append(np.stack([one[0], other[0]]))

    def finding(self, family: str, names: Sequence[str], places: int, families: int) -> Finding:
        """Choose the event, and the input under which it is likelier, and measure it.

        Parameters
        ----------
        names : of the events
        places : of a call
        families : that are asked, each of which may be wrong
        """
        hits = np.stack(self.hits)  # (C, 2, E)
        half = len(hits) // 2
        given, event, expected = _most_telling(hits[:half], half * places)
        alike = any(more_alike_than_independent(hits[:half, either, event], places) for either in (0, 1))
        if alike:
            hits, places = np.stack(self.first).astype(np.int32), 1
            given, event, expected = _most_telling(hits[:half], half)
        trials = half * places
        one, other = (int(hits[half:, either, event].sum()) for either in (given, 1 - given))
        epsilon, certain = (
            max(0.0, float(log_ratio(one, trials, other, trials, confidence)))
            for confidence in (CONFIDENCE, 1 - (1 - CERTAINTY) / families)
        )
        return Finding(family, names[event], (one / trials, other / trials), trials, epsilon, certain, expected, alike)


def _most_telling(hits: NDArray[np.int32], trials: int) -> tuple[int, int, float]:
    """The input under which, and the event of which, the bound is greatest; and that. hits: (C, 2, E)"""
    counts = hits.sum(axis=0)  # (2, E)
    bounds = log_ratio(counts, trials, counts[::-1], trials, CONFIDENCE)
    given, event = divmod(int(bounds.argmax()), bounds.shape[1])
    return given, event, float(bounds[given, event])
