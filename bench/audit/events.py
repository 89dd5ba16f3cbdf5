"""Events that an audit counts: of the answer to one keypoint, and of two answers together.

Here a word is any part of a keypoint's release: a row of the dictionary, a pattern, or a descriptor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import singledispatch

import numpy as np
from numpy.typing import NDArray

from bench.geometry.row_keys import hash_rows
from bench.types import Descriptors, Floats, Release, Subspaces, WordSets

Flags = NDArray[np.bool_]
Keys = NDArray[np.int64]

EVENT_WORDS = 8  # number of words for which events are defined
QUANTILES = 32  # number of quantiles of projections


@dataclass(frozen=True, eq=False)
class Answers:
    """The release of N keypoints."""

    words: Keys  # (N, m) numbers that identify words, in the order of the release
    descriptors: Floats  # (N, D), or (N, 0) if the release is not one descriptor per keypoint

    def take(self, rows: slice) -> Answers:
        return Answers(self.words[rows], self.descriptors[rows])


@singledispatch
def extract_answers(release: Release) -> Answers:
    """Return the answers of a release.

    Raises
    ------
    TypeError
        if this kind of release is unknown.
    """
    raise TypeError(f"no events are defined for {type(release).__name__}")


@extract_answers.register
def _(release: WordSets) -> Answers:
    words = release.words if release.words is not None else _hash_words(release.candidates)
    return Answers(words, np.empty((len(words), 0), dtype=np.float32))


@extract_answers.register
def _(release: Descriptors) -> Answers:
    return Answers(_hash_words(release.descriptors[:, None]), release.descriptors)


@extract_answers.register
def _(release: Subspaces) -> Answers:
    parts = np.concatenate([release.origins[:, None], release.bases], axis=1)  # (N, 1 + dim, D)
    return Answers(_hash_words(parts.reshape(len(parts), 1, -1)), np.empty((len(parts), 0), dtype=np.float32))


def _hash_words(rows: Floats) -> Keys:
    return hash_rows(rows).view(np.int64)


@dataclass(frozen=True, eq=False)
class EventFamilies:
    """Events of single answers, selected by pilot calls."""

    words: Keys  # (T,) words whose rates differ most
    direction: Floats  # (D,) from the second descriptor to the first, or (0,)
    thresholds: Floats  # (Q,) of projections onto the direction, or (0,)

    def membership(self, answers: Answers) -> Flags:
        """Return whether a word is in Z; whether it is and another is not; whether it is not in Z. -> (N, E)"""
        inside = (answers.words[:, :, None] == self.words).any(axis=1)  # (N, T)
        return _add_absences(inside, inside)

    def position(self, answers: Answers) -> Flags:
        """Return the events of `membership` for a word at one position of its row. -> (N, E)"""
        there = answers.words[:, :, None] == self.words  # (N, m, T)
        return _add_absences(there.reshape(len(there), -1), there.any(axis=1))

    def projection(self, answers: Answers) -> Flags:
        """Return whether the projection of a descriptor reaches each threshold, and the negations. -> (N, E)"""
        far = (answers.descriptors @ self.direction)[:, None] >= self.thresholds  # (N, Q)
        return np.concatenate([far, ~far], axis=1)

    def families(self) -> dict[str, Callable[[Answers], Flags]]:
        """Return the families that apply to the release, by name."""
        families: dict[str, Callable[[Answers], Flags]] = {"membership": self.membership, "position": self.position}
        return families | {"projection": self.projection} if len(self.thresholds) else families

    def names(self, size: int) -> dict[str, list[str]]:
        """Return the names of the events of each family, in their order, for `size` words per keypoint."""
        words = [f"word {word}" if 0 <= word < 2**31 else f"answer {number}" for number, word in enumerate(self.words)]
        positions = [f"{word} at position {position + 1}" for position in range(size) for word in words]
        shared = [*(f"{count} or more words in common" for count in range(1, size + 1)), "equal"]
        shared += [f"not {name}" for name in shared]
        return {
            "membership": _name_absences([f"{word} in Z" for word in words], words),
            "position": _name_absences(positions, words),
            "projection": [f"projection {sign} {value:.3g}" for sign in ("≥", "<") for value in self.thresholds],
            "keypoints": shared,
            "calls": shared,
        }


def select_events(first: Sequence[Answers], second: Sequence[Answers], direction: Floats) -> EventFamilies:
    """Return the events with the greatest differences between answers to the first descriptor and to the second."""
    one, other = (np.concatenate([answers.words.ravel() for answers in part]) for part in (first, second))
    words, counts = np.unique(np.concatenate([one, other]), return_counts=True)
    first_counts = np.bincount(np.searchsorted(words, one), minlength=len(words))
    contrast = np.abs(2 * first_counts - counts) / np.sqrt(counts)
    selection = words[np.argsort(-contrast, kind="stable")[:EVENT_WORDS]]
    descriptors = np.concatenate([answers.descriptors for answers in (*first, *second)])
    if descriptors.shape[1] == 0:
        return EventFamilies(selection, np.empty(0, dtype=np.float32), np.empty(0, dtype=np.float32))
    quantiles = np.quantile(descriptors @ direction, np.linspace(0, 1, QUANTILES + 2)[1:-1])
    return EventFamilies(selection, direction, np.unique(quantiles.astype(np.float32)))


def compare_answers(one: Answers, other: Answers) -> Flags:
    """Return whether two answers have at least 1, ..., m common words; whether they are equal; the negations. -> (N, E)"""
    shared = (one.words[:, :, None] == other.words[:, None, :]).sum(axis=(1, 2))  # (N,)
    enough = shared[:, None] >= np.arange(1, one.words.shape[1] + 1)
    events = np.concatenate([enough, (one.words == other.words).all(axis=1, keepdims=True)], axis=1)
    return np.concatenate([events, ~events], axis=1)


def _add_absences(events: Flags, inside: Flags) -> Flags:
    """Return each event, each event with one of the words absent, and each negation. (N, A), (N, T) -> (N, A + A T + A)"""
    absent = events[:, :, None] & ~inside[:, None, :]  # (N, A, T)
    return np.concatenate([events, absent.reshape(len(events), -1), ~events], axis=1)


def _name_absences(events: Sequence[str], words: Sequence[str]) -> list[str]:
    return [*events, *(f"{event}, {word} not" for event in events for word in words), *(f"not {event}" for event in events)]
