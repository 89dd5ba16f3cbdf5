"""Collisions: whether subspaces that intersect a subspace also come near its descriptor (the paper's Table S4).

The clustering attack separates d from the adversarial a_i by the subspaces Q' that intersect D. The Q' belong to the same release
and to other releases. They contain some a_i and should be far from d. The paper does not state its test. Here a descriptor has no
collision if

    min_j dist(d, Q'_j) > max_i min_j dist(a_i, Q'_j) + τ

An a_i that no other subspace contains makes the right side large and counts as a collision. A descriptor without any Q' counts
as a collision, too. `coverage` is the fraction of the a_i in other subspaces. `no_collision_covered` is the fraction without
collision among the descriptors whose a_i are all in other subspaces.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.api import Attack, Dataset, Defense, Extractor, Lifting, explain_no_words
from bench.codebook.public import Public
from bench.core.errors import SampleError, UserError
from bench.geometry.intersections import Doubles, estimate_tolerances
from bench.geometry.nearest_words import unit_rows
from bench.geometry.shared_sub_database import compute_intersection_distances, find_shared_sub_database
from bench.images.samples import Collection, Images, collect_only_photographs
from bench.registry import fields
from bench.task_api import Outcome, Task, Trial


@dataclass(frozen=True, kw_only=True)
class Collisions(Task):
    """Fraction of descriptors that no intersecting subspace comes near (no collision). Computed by the owner."""

    judges_attacks = False

    coverage: float = 0.95  # other releases are drawn until this fraction of the photograph's words is covered
    others: int = 800  # largest number of releases of other photographs
    tolerance: float = 0.3  # τ, a distance of unit descriptors

    def __post_init__(self) -> None:
        if not 0 <= self.coverage <= 1:
            raise UserError(f"collisions: coverage must be from 0 to 1, got {self.coverage}")
        if self.others < 0:
            raise UserError(f"collisions: others must be at least 0, got {self.others}")
        if not self.tolerance >= 0:
            raise UserError(f"collisions: tolerance must be at least 0, got {self.tolerance}")

    def collect(self, images: Images, dataset: Dataset | None) -> Collection:
        return collect_only_photographs(self, images, dataset)

    def explain_not_applicable(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> str | None:
        return explain_no_words(defense)

    def resolve(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> Mapping[str, Any]:
        return {}

    def evaluate(self, trial: Trial) -> Outcome:
        defense = trial.defense
        if not isinstance(defense, Lifting):
            raise SampleError("collisions needs subspaces through words of a database")
        lifting = defense.lift(trial.secret, trial.public, trial.rng)
        words = trial.public.dictionary(fields.list_assets(defense)["database"]).words  # (K, D)
        points = np.concatenate(
            [trial.secret.descriptors[:, None], unit_rows(words[lifting.words])], axis=1
        )  # (N, 1 + a, D) d, a_i
        shared = find_shared_sub_database(lifting.release, trial.others(self.others), defense.adversarial, self.coverage)
        nearest = compute_intersection_distances(points.astype(np.float64), shared)  # (N, 1 + a)
        clear = is_collision_free(nearest, self.tolerance)
        intersected = nearest[:, 1:] < estimate_tolerances(shared.subspaces).max()  # (N, a)
        covered = intersected.all(axis=1)
        return Outcome(
            metrics={
                "no_collision": float(clear.mean()),
                "no_collision_covered": float(clear[covered].mean()) if covered.any() else None,
                "coverage": float(intersected.mean()),
                "covered": float(covered.mean()),
                "releases_asked": float(shared.searched),
                "releases_kept": float(shared.sharing),
            }
        )


def is_collision_free(nearest: Doubles, tolerance: float) -> NDArray[np.bool_]:
    """Return whether the distance of d, the first point, exceeds those of all a_i by more than `tolerance`. (N, 1 + a) -> (N,)"""
    own, adversarial = nearest[:, 0], nearest[:, 1:].max(axis=1)
    return np.isfinite(own) & (own > adversarial + tolerance)


PLUGIN = Collisions
