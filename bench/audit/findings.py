"""Counts of events over many calls. An event is selected on one half of the calls and measured on the other half."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bench.audit.bounds import is_overdispersed, log_ratio
from bench.audit.events import Flags

CONFIDENCE = 0.95  # of bounds
CERTAINTY = 1 - 1e-6  # of the verdict `violated`, for all families together


@dataclass(frozen=True)
class Finding:
    """Lower bounds of ε from one family of events."""

    family: str
    event: str  # its description
    rates: tuple[float, float]  # for the input with the greater rate, and for the other input
    trials: int  # of each input
    epsilon: float  # lower bound at CONFIDENCE
    certain_epsilon: float  # lower bound at CERTAINTY
    selection_epsilon: float  # lower bound on the half of the calls that selects the event
    overdispersed: bool  # whether answers of one call vary more than independent ones; then one answer of each call counts

    def divide_by(self, distance: float) -> Finding:
        """Return the finding with bounds per unit of distance."""
        return replace(
            self,
            epsilon=self.epsilon / distance,
            certain_epsilon=self.certain_epsilon / distance,
            selection_epsilon=self.selection_epsilon / distance,
        )


@dataclass(eq=False)
class Tally:
    """Counts of one family's events under two inputs, call by call."""

    hits: list[NDArray[np.int32]] = field(default_factory=list)  # of (2, E), over the pairs of a call
    first: list[Flags] = field(default_factory=list)  # of (2, E), of the first pair of a call only

    def add(self, one: Flags, other: Flags) -> None:
        """Count the events of a call's pairs under the two inputs. (P, E), (P, E)"""
        self.hits.append(np.stack([one.sum(axis=0), other.sum(axis=0)]).astype(np.int32))
        self.first.append(np.stack([one[0], other[0]]))

    def measure(self, family: str, names: Sequence[str], pairs: int, families: int) -> Finding:
        """Select the event and the input of the greater rate, and return the finding.

        Parameters
        ----------
        names : of the events
        pairs : per call
        families : number of families, for the correction of CERTAINTY
        """
        hits = np.stack(self.hits)  # (C, 2, E)
        half = len(hits) // 2
        given, event, selection = _select_event(hits[:half], half * pairs)
        overdispersed = any(is_overdispersed(hits[:half, either, event], pairs) for either in (0, 1))
        if overdispersed:
            hits, pairs = np.stack(self.first).astype(np.int32), 1
            given, event, selection = _select_event(hits[:half], half)
        trials = half * pairs
        one, other = (int(hits[half:, either, event].sum()) for either in (given, 1 - given))
        epsilon, certain = (
            max(0.0, float(log_ratio(one, trials, other, trials, confidence)))
            for confidence in (CONFIDENCE, 1 - (1 - CERTAINTY) / families)
        )
        return Finding(family, names[event], (one / trials, other / trials), trials, epsilon, certain, selection, overdispersed)


def _select_event(hits: NDArray[np.int32], trials: int) -> tuple[int, int, float]:
    """Return the input and the event of the greatest bound, and the bound. hits: (C, 2, E)"""
    counts = hits.sum(axis=0)  # (2, E)
    bounds = log_ratio(counts, trials, counts[::-1], trials, CONFIDENCE)
    given, event = divmod(int(bounds.argmax()), bounds.shape[1])
    return given, event, float(bounds[given, event])
