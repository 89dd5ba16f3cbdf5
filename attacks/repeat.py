"""Repeat: the attacker sees the same features released several times, as by a video, or a client that tries again.

Two liftings of one descriptor are subspaces that meet in it, so two suffice. In word sets the true word recurs: of T sets, the
word that stands in most has the greatest likelihood, and T releases are T ε-LDP and no more. In no paper that we follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.api import DescriptorAttack, View
from bench.core.errors import UserError
from bench.geometry.metric_inputs import directions
from bench.mechanisms.multi_release import common_points, likeliest
from bench.types import Floats, Indices, Knowledge, Release, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Repeat(DescriptorAttack):
    """Takes the point where the subspaces of a keypoint meet, or the word that its sets repeat."""

    accepts = (Subspaces, WordSets)
    needs = frozenset({Knowledge.REPEATED_RELEASES})

    releases: int = 2  # of the same features, the one that every attack sees included

    def __post_init__(self) -> None:
        if self.releases < 1:
            raise UserError(f"repeat: releases must be at least 1, got {self.releases}")

    def repeats(self) -> int:
        return self.releases - 1

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        seen: list[Release] = [view.release, *view.know(Knowledge.REPEATED_RELEASES)]
        subspaces = [release for release in seen if isinstance(release, Subspaces)]
        if len(subspaces) == len(seen):
            return directions(common_points(subspaces)).astype(np.float32)
        sets = [release for release in seen if isinstance(release, WordSets)]
        if len(sets) < len(seen):
            raise TypeError(f"repeat attacks Subspaces or WordSets, got {type(view.release).__name__}")
        candidates = np.concatenate([release.candidates for release in sets], axis=1)  # (N, T m, D)
        return candidates[np.arange(len(candidates)), likeliest(names(sets), rng)]


def names(sets: Sequence[WordSets]) -> Indices:
    """Numbers that tell candidates apart: their words, or, where there is no dictionary, one for each pattern. -> (N, T m)"""
    words = [release.words for release in sets if release.words is not None]
    if len(words) == len(sets):
        return np.concatenate(words, axis=1)
    candidates = np.concatenate([release.candidates for release in sets], axis=1)  # (N, T m, D)
    patterns = candidates.reshape(-1, candidates.shape[2])
    return np.unique(patterns, axis=0, return_inverse=True)[1].reshape(candidates.shape[:2])


PLUGIN = Repeat
