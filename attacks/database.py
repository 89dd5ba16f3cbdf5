"""Database attack: estimates the descriptors in affine subspaces with the defense's database W.

Source: the paper's Sec. 4.1.

Method, for a subspace D that contains the descriptor d and a words of W:

1. Sort the words of W by their distance to D.
2. The a nearest words are the adversarial descriptors â. They lie in D up to the float32 precision of the release, about 1e-7.
3. The next |V| words lie near the real descriptors in D: an â or d. Those |U| of them that are farthest from every â are near d.
4. The estimate is the paper's d̂, the mean of U, weighted by 1 / dist(D, u) and projected onto D. It is then scaled to unit norm.

Knowledge: W. The number a follows from the public configuration of the defense.

Limits: the paper does not state |V| and |U|. The defaults are tuned on photographs that no result is reported on.
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
    """Finds the database words in a subspace, and estimates the descriptor from the words next nearest to the subspace."""

    accepts = (Subspaces,)
    needs = frozenset({DefenseDatabase})

    neighbours: int = 4000  # |V|, words next nearest to the subspace
    estimators: int = 3  # |U|, those of them whose mean is the estimate

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
