"""Counts of events in many calls, and what they show: the event is chosen on one half of the calls and measured on the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

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
        chosen_by, trials = hits[:half].sum(axis=0), half * places
        bounds = log_ratio(chosen_by, trials, chosen_by[::-1], trials, CONFIDENCE)  # (2, E)
        way, event = divmod(int(bounds.argmax()), bounds.shape[1])
        order = [way, 1 - way]
        alike = any(more_alike_than_independent(hits[:half, given, event], places) for given in order)
        counted = np.stack(self.first) if alike else hits
        measured = counted[half:, order, event].sum(axis=0)  # (2,)
        trials = half if alike else half * places
        epsilon, certain = (
            max(0.0, float(log_ratio(measured[0], trials, measured[1], trials, confidence)))
            for confidence in (CONFIDENCE, 1 - (1 - CERTAINTY) / families)
        )
        rates = (float(measured[0]) / trials, float(measured[1]) / trials)
        return Finding(family, names[event], rates, trials, epsilon, certain, float(bounds[way, event]), alike)
