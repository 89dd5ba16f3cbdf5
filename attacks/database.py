"""The database attack (the paper's Sec. 4.1): whoever knows W finds the words that a subspace was led through, and what is left.

Step 1 sorts the words by their distance to D. Step 2 takes the first for the adversarial descriptors â, as many as the defense's
configuration says: they lie in D but for the float32 of the release, about 1e-7. Step 3 takes the next |V| words. They lie near D
where D meets real descriptors, at an â or at d; so the |U| of them that are farthest from every â tell of d, by the paper's
equation for d̂: their mean, weighted by 1 / dist(D, u), projected onto D. Then d̂ is scaled to unit norm, as every descriptor is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import Defense, DescriptorAttack, Extractor, View, explain_no_words, require_subspaces
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.estimates import estimate
from bench.geometry.subspaces import nearest_to_subspaces
from bench.types import Floats, Knowledge, Subspaces


@dataclass(frozen=True, kw_only=True)
class Database(DescriptorAttack):
    """Finds the database's words in a subspace, and the descriptor near those that lie almost in it."""

    accepts = (Subspaces,)
    needs = frozenset({Knowledge.DATABASE})

    neighbours: int = 4000  # |V|: words next nearest to the subspace
    estimators: int = 3  # |U|: those of them that the estimate is made of

    def __post_init__(self) -> None:
        if not 1 <= self.estimators <= self.neighbours:
            raise UserError(f"database: estimators must be from 1 to neighbours, {self.neighbours}, got {self.estimators}")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        return explain_no_words(defense)

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release, adversarial = require_subspaces(view)
        words = view.know(Knowledge.DATABASE).words  # (K, D)
        if len(words) <= adversarial:
            raise UserError(f"database: {len(words)} words leave none beside the {adversarial} in each subspace")
        found, distances = nearest_to_subspaces(release, words, adversarial + self.neighbours)
        return estimate(release, words, found, distances, adversarial, self.estimators)


PLUGIN = Database
