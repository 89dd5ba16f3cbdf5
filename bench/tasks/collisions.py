"""Collisions: whether other releases that meet a subspace come near its descriptor, too (the paper's Table S4).

The clustering attack tells d from the adversarial a_i by the subspaces Q' of other releases that meet D: they go through some a_i
and should stay far from d. The paper leaves the test open; here a descriptor has no collision if

    min_j dist(d, Q'_j) > max_i min_j dist(a_i, Q'_j) + τ

An a_i that no other release goes through makes the right side large and counts as a collision, as does a descriptor without Q'.
`coverage` is the share of the a_i that are met, and `no_collision_covered` the share among the descriptors of which all a_i are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench import fields
from bench.errors import UnitError, UserError
from bench.kernels.meetings import MEETS, meetings
from bench.kernels.search import unit_rows
from bench.plugin import Attack, Defense, Extractor, Lifted, Lifting, Outcome, Task, Trial
from bench.public import Public
from bench.types import Floats, Subspaces

Doubles = NDArray[np.float64]

# Pairs of subspaces by which a release of the same sub-database is told from others, times a² for a words a subspace. Two that
# drew them from the same 16,000 words meet with chance a² / 16,000: 7.5 of these do, and one release in 1,800 is overlooked.
SAMPLE = 120_000
PAIRS = 1024  # meetings that are measured at a time


@dataclass(frozen=True, kw_only=True)
class Collisions(Task):
    """How often no other release that meets a subspace comes near its descriptor. Made by the owner, who knows what it hides."""

    attacked = False

    others: int = 200  # releases of other photographs
    tolerance: float = 0.1  # τ, a distance of unit descriptors

    def __post_init__(self) -> None:
        if self.others < 1:
            raise UserError(f"collisions: others must be at least 1, got {self.others}")
        if not self.tolerance >= 0:
            raise UserError(f"collisions: tolerance must be at least 0, got {self.tolerance}")

    def inapplicable(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> str | None:
        if not isinstance(defense, Lifting) or "database" not in fields.asset_fields(defense):
            return f"{defense.name()} does not lift descriptors to subspaces through words of a database"
        return None if defense.adversarial else f"{defense.name()} as configured leads its subspaces through no word"

    def resolved(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> Mapping[str, Any]:
        return {}

    def judge(self, trial: Trial) -> Outcome:
        defense = trial.defense
        if not isinstance(defense, Lifting):
            raise UnitError("collisions needs subspaces through words of a database")
        lifted = defense.lifted(trial.secret, trial.public, trial.rng)
        words = unit_rows(trial.public.dictionary(fields.asset_fields(defense)["database"]).words)  # (K, D)
        points = np.concatenate([trial.secret.descriptors[:, None], words[lifted.words]], axis=1)  # (N, 1 + a, D) d, a_i
        nearest = np.full(points.shape[:2], np.inf)  # (N, 1 + a) min_j dist(point, Q'_j)
        shared = 0
        for other in trial.others(self.others):
            if not isinstance(other, Subspaces):
                raise UnitError(f"collisions needs subspaces, got {type(other).__name__}")
            if _meet(lifted, other, trial.rng):
                shared += 1
                nearest = np.minimum(nearest, nearest_meeting(lifted.release, points, other))
        clear = no_collision(nearest, self.tolerance)
        met = nearest[:, 1:] < MEETS  # (N, a)
        covered = met.all(axis=1)
        return Outcome(
            metrics={
                "no_collision": float(clear.mean()),
                "no_collision_covered": float(clear[covered].mean()) if covered.any() else None,
                "coverage": float(met.mean()),
                "covered": float(covered.mean()),
                "same_sub_database": float(shared),
            }
        )


def nearest_meeting(release: Subspaces, points: Floats, other: Subspaces) -> Doubles:
    """From each point of a subspace of `release` to the nearest subspace of `other` that meets that subspace; ∞ where none does.

    `points` are (N, p, D). -> (N, p)
    """
    met = meetings(release, other)
    nearest = np.full(points.shape[:2], np.inf)
    for start in range(0, len(met), PAIRS):
        first, second = met.first[start : start + PAIRS], met.second[start : start + PAIRS]
        np.minimum.at(nearest, first, _distances(points[first], other.origins[second], other.bases[second]))
    return nearest


def no_collision(nearest: Doubles, tolerance: float) -> NDArray[np.bool_]:
    """Whether d, the first point, is further from what meets D than the others by more than `tolerance`. (N, 1 + a) -> (N,)"""
    own, adversarial = nearest[:, 0], nearest[:, 1:].max(axis=1)
    return np.isfinite(own) & (own > adversarial + tolerance)


def _meet(lifted: Lifted, other: Subspaces, rng: np.random.Generator) -> bool:
    """Whether some of a sample of the subspaces meet some of the others, as they do where both drew words of one sub-database."""
    release, a = lifted.release, lifted.words.shape[1]
    count = min(len(release), -(-SAMPLE // (a * a * len(other))))
    chosen = np.sort(rng.permutation(len(release))[:count])
    sample = replace(release, keypoints=release.keypoints[chosen], origins=release.origins[chosen], bases=release.bases[chosen])
    return len(meetings(sample, other)) > 0


def _distances(points: Floats, origins: Floats, bases: Floats) -> Doubles:
    """dist(point, subspace) in float64. (P, p, D), (P, D), (P, dim, D) -> (P, p)"""
    offsets = points.astype(np.float64) - origins[:, None]  # (P, p, D)
    frames = bases.astype(np.float64)
    return np.linalg.norm(offsets - offsets @ frames.transpose(0, 2, 1) @ frames, axis=2)


PLUGIN = Collisions
