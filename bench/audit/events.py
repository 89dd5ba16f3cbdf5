"""The events that an audit counts: of one keypoint's answer, and of two answers together.

A word here is whatever is released for a keypoint: a row of the dictionary, a pattern, a descriptor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import singledispatch

import numpy as np
from numpy.typing import NDArray

from bench.geometry.row_keys import row_keys
from bench.types import Descriptors, Floats, Release, Subspaces, WordSets

Flags = NDArray[np.bool_]
Keys = NDArray[np.int64]

TELLING = 8  # words that events are about
QUANTILES = 32  # of projections


@dataclass(frozen=True, eq=False)
class Answers:
    """What was released for N keypoints."""

    words: Keys  # (N, m) numbers by which words are told apart, in the order of the release
    descriptors: Floats  # (N, D), or (N, 0) where it was not one descriptor a keypoint

    def take(self, rows: slice) -> Answers:
        return Answers(self.words[rows], self.descriptors[rows])


@singledispatch
def answers(release: Release) -> Answers:
    """The answers that a release consists of.

    Raises
    ------
    TypeError
        if this kind of release is not known.
    """
    raise TypeError(f"no events are defined for {type(release).__name__}")


@answers.register
def _(release: WordSets) -> Answers:
    words = release.words if release.words is not None else _keys(release.candidates)
    return Answers(words, np.empty((len(words), 0), dtype=np.float32))


@answers.register
def _(release: Descriptors) -> Answers:
    return Answers(_keys(release.descriptors[:, None]), release.descriptors)


@answers.register
def _(release: Subspaces) -> Answers:
    parts = np.concatenate([release.origins[:, None], release.bases], axis=1)  # (N, 1 + dim, D)
    return Answers(_keys(parts.reshape(len(parts), 1, -1)), np.empty((len(parts), 0), dtype=np.float32))


def _keys(rows: Floats) -> Keys:
    return row_keys(rows).view(np.int64)


@dataclass(frozen=True, eq=False)
class Watched:
    """What to look for in single answers, as a first few of them tell."""

    words: Keys  # (T,) whose rates differ most
    direction: Floats  # (D,) from the second descriptor to the first, or (0,)
    thresholds: Floats  # (Q,) of projections onto it, or (0,)

    def membership(self, seen: Answers) -> Flags:
        """Whether a word is in Z; whether it is, and another is not; whether it is not. -> (N, E)"""
        inside = (seen.words[:, :, None] == self.words).any(axis=1)  # (N, T)
        return _with_absence(inside, inside)

    def position(self, seen: Answers) -> Flags:
        """The same of a word at one place of its row. -> (N, E)"""
        there = seen.words[:, :, None] == self.words  # (N, m, T)
        return _with_absence(there.reshape(len(there), -1), there.any(axis=1))

    def projection(self, seen: Answers) -> Flags:
        """Whether a descriptor lies far in the direction, and whether not. -> (N, E)"""
        far = (seen.descriptors @ self.direction)[:, None] >= self.thresholds  # (N, Q)
        return np.concatenate([far, ~far], axis=1)

    def families(self) -> dict[str, Callable[[Answers], Flags]]:
        """Those that there are events of."""
        found: dict[str, Callable[[Answers], Flags]] = {"membership": self.membership, "position": self.position}
        return found | {"projection": self.projection} if len(self.thresholds) else found

    def names(self, places: int) -> dict[str, list[str]]:
        """What the events of each family are, in their order, where so many words are released for a keypoint."""
        known = [f"word {word}" if 0 <= word < 2**31 else f"answer {number}" for number, word in enumerate(self.words)]
        placed = [f"{word} in place {place + 1}" for place in range(places) for word in known]
        shared = [*(f"{count} or more words in common" for count in range(1, places + 1)), "equal"]
        shared += [f"not {name}" for name in shared]
        return {
            "membership": _absence_names([f"{word} in Z" for word in known], known),
            "position": _absence_names(placed, known),
            "projection": [f"projection {sign} {value:.3g}" for sign in ("≥", "<") for value in self.thresholds],
            "keypoints": shared,
            "calls": shared,
        }


def watch(first: Sequence[Answers], second: Sequence[Answers], direction: Floats) -> Watched:
    """Choose what to look for, from answers to the first descriptor and to the second."""
    ones, others = (np.concatenate([seen.words.ravel() for seen in given]) for given in (first, second))
    words, counts = np.unique(np.concatenate([ones, others]), return_counts=True)
    of_first = np.bincount(np.searchsorted(words, ones), minlength=len(words))
    telling = np.abs(2 * of_first - counts) / np.sqrt(counts)
    kept = words[np.argsort(-telling, kind="stable")[:TELLING]]
    released = np.concatenate([seen.descriptors for seen in (*first, *second)])
    if released.shape[1] == 0:
        return Watched(kept, np.empty(0, dtype=np.float32), np.empty(0, dtype=np.float32))
    quantiles = np.quantile(released @ direction, np.linspace(0, 1, QUANTILES + 2)[1:-1])
    return Watched(kept, direction, np.unique(quantiles.astype(np.float32)))


def common(one: Answers, other: Answers) -> Flags:
    """Whether two answers have at least 1, ..., m words in common, or are equal; and whether not. -> (N, E)"""
    shared = (one.words[:, :, None] == other.words[:, None, :]).sum(axis=(1, 2))  # (N,)
    enough = shared[:, None] >= np.arange(1, one.words.shape[1] + 1)
    found = np.concatenate([enough, (one.words == other.words).all(axis=1, keepdims=True)], axis=1)
    return np.concatenate([found, ~found], axis=1)


def _with_absence(events: Flags, inside: Flags) -> Flags:
    """Each event; each with one of the words absent; each not happening. (N, A), (N, T) -> (N, A + A T + A)"""
    absent = events[:, :, None] & ~inside[:, None, :]  # (N, A, T)
    return np.concatenate([events, absent.reshape(len(events), -1), ~events], axis=1)


def _absence_names(events: Sequence[str], known: Sequence[str]) -> list[str]:
    return [*events, *(f"{event}, {word} not" for event in events for word in known), *(f"not {event}" for event in events)]
