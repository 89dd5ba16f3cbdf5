"""Repeat attack: combines several releases of the same features, as from a video or from a client that sends again.

Source: not in the paper.

Method:

- Subspaces: two liftings of one descriptor intersect in it. The estimate is that point, so two releases are enough.
- Word sets: the true word recurs. The word in most of the T sets has the greatest likelihood.

Knowledge: `releases` - 1 further releases of the same photograph.

Limits: T releases of an ε-LDP defense are T ε-LDP, so the attack on word sets is bounded by T ε. The attack does not apply to
defenses that hide positions, because they hide the order of the keypoints, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.api import Defense, DescriptorAttack, Extractor, View
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.metric_inputs import normalize_rows
from bench.mechanisms.multi_release import find_common_points, select_likeliest
from bench.threat_model import RepeatedReleases
from bench.types import Floats, Indices, Positions, Release, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Repeat(DescriptorAttack):
    """Estimates the descriptor by the intersection of a keypoint's subspaces, or by the word in most of its sets."""

    accepts = (Subspaces, WordSets)
    accepts_positions = (Positions,)
    needs = frozenset({RepeatedReleases})

    releases: int = 2  # number of releases of the same features, including the first

    def __post_init__(self) -> None:
        if self.releases < 1:
            raise UserError(f"repeat: releases must be at least 1, got {self.releases}")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        if defense.hides_positions():
            return f"repeat needs the keypoints of all releases in one order; each release of {defense.name()} has a random order"
        return None

    def repeats(self) -> int:
        return self.releases - 1

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        releases: list[Release] = [view.release, *view.know(RepeatedReleases).releases]
        subspaces = [release for release in releases if isinstance(release, Subspaces)]
        if len(subspaces) == len(releases):
            return normalize_rows(find_common_points(subspaces)).astype(np.float32)
        sets = [release for release in releases if isinstance(release, WordSets)]
        if len(sets) < len(releases):
            raise TypeError(f"repeat attacks Subspaces or WordSets, got {type(view.release).__name__}")
        candidates = np.concatenate([release.candidates for release in sets], axis=1)  # (N, T m, D)
        return candidates[np.arange(len(candidates)), select_likeliest(label_candidates(sets), rng)]


def label_candidates(sets: Sequence[WordSets]) -> Indices:
    """Return the word of each candidate, or without a dictionary one number per distinct pattern. -> (N, T m)"""
    words = [release.words for release in sets if release.words is not None]
    if len(words) == len(sets):
        return np.concatenate(words, axis=1)
    candidates = np.concatenate([release.candidates for release in sets], axis=1)  # (N, T m, D)
    patterns = candidates.reshape(-1, candidates.shape[2])
    return np.unique(patterns, axis=0, return_inverse=True)[1].reshape(candidates.shape[:2])


PLUGIN = Repeat
