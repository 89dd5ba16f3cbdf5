"""The database attack (the paper's Sec. 4.1): with W, finds the adversarial words of a subspace, then the descriptor.

Step 1 sorts the words by their distance to D. Step 2 takes the nearest as the adversarial descriptors â; their number is in the
configuration of the defense. They lie in D up to the float32 precision of the release, about 1e-7. Step 3 takes the next |V|
words. They lie near D where D contains real descriptors, an â or d, so the |U| of them that are farthest from every â are near
d. The estimate is the paper's d̂: their mean, weighted by 1 / dist(D, u), projected onto D. Then d̂ is scaled to unit norm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import Defense, DescriptorAttack, Extractor, View, explain_no_words, require_subspaces
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.estimates import estimate
from bench.geometry.subspaces import find_nearest_to_subspaces
from bench.threat_model import DefenseDatabase
from bench.types import Floats, Subspaces


@dataclass(frozen=True, kw_only=True)
class Database(DescriptorAttack):
    """Finds the words of the database in a subspace, and estimates the descriptor from the words next nearest to it."""

    accepts = (Subspaces,)
    needs = frozenset({DefenseDatabase})

    neighbours: int = 4000  # |V|: words next nearest to the subspace
    estimators: int = 3  # |U|: those of them that form the estimate

    def __post_init__(self) -> None:
        if not 1 <= self.estimators <= self.neighbours:
            raise UserError(f"database: estimators must be from 1 to neighbours, {self.neighbours}, got {self.estimators}")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        return explain_no_words(defense)

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release, adversarial = require_subspaces(view)
        words = view.know(DefenseDatabase).words  # (K, D)
        if len(words) <= adversarial:
            raise UserError(f"database: {len(words)} words are too few for {adversarial} in each subspace")
        nearest, distances = find_nearest_to_subspaces(release, words, adversarial + self.neighbours)
        return estimate(release, words, nearest, distances, adversarial, self.estimators)


PLUGIN = Database
