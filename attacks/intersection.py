"""Intersection attack: reconstructs the database of affine subspaces from their intersections, then attacks with it.

Source: not in the paper. Its clustering attack needs a database Z as well.

Method:

1. Find the other releases that share the photograph's sub-database, and all intersections of their subspaces.
2. Two subspaces that contain the same word intersect in it. The points of unit norm in two or more subspaces form the
   reconstructed database. If the words of W are 8-bit vectors, as for SIFT, the intersections give them to the last bit.
3. Continue as the database attack (the paper's Sec. 4.1). The adversarial words of a subspace are the reconstructed words in it.
   Of the |V| words next nearest to it, the |U| that are farthest from the adversarial words estimate the descriptor.

Knowledge: other releases of the same defense with the same database. The attacker has no database.

Limits: a word in only one of the subspaces is not reconstructed. Without any word, the estimate is the direction of the point of
the subspace nearest to zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import Defense, DescriptorAttack, Extractor, View, explain_no_words, require_subspaces
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.database_reconstruction import reconstruct_database
from bench.geometry.estimates import estimate
from bench.geometry.intersections import find_intersections_within
from bench.geometry.nearest_words import unit_rows
from bench.geometry.shared_sub_database import find_shared_sub_database
from bench.geometry.subspaces import feet_and_frames, find_nearest_to_subspaces
from bench.threat_model import OtherReleases
from bench.types import Floats, Subspaces, Words


@dataclass(frozen=True, kw_only=True)
class Intersection(DescriptorAttack):
    """Reconstructs the photograph's sub-database from subspace intersections, and attacks with its words."""

    accepts = (Subspaces,)
    needs = frozenset({OtherReleases})

    neighbours: int = 1024  # |V|, reconstructed words next nearest to the subspace
    estimators: int = 2  # |U|, those of them whose mean is the estimate
    coverage: float = 0.95  # fraction of the photograph's words, from 0 to 1, at which no further releases are read
    others: int = 800  # c, the maximum number of other releases that are read

    def __post_init__(self) -> None:
        if not 1 <= self.estimators <= self.neighbours:
            raise UserError(f"intersection: estimators must be from 1 to neighbours, {self.neighbours}, got {self.estimators}")
        if not 0 <= self.coverage <= 1:
            raise UserError(f"intersection: coverage must be from 0 to 1, got {self.coverage:g}")
        if self.others < 0:
            raise UserError(f"intersection: others must be at least 0, got {self.others}")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        return explain_no_words(defense)

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release, adversarial = require_subspaces(view)
        shared = find_shared_sub_database(release, view.know(OtherReleases).draw(self.others), adversarial, self.coverage)
        words = reconstruct_database(find_intersections_within(shared.subspaces))
        summary, *others = shared.list_notes(self.coverage)
        view.notes.extend([f"{summary}; {len(words)} words reconstructed", *others])
        return estimate_descriptors(release, words, adversarial, self.neighbours, self.estimators)


def estimate_descriptors(release: Subspaces, words: Words | Floats, adversarial: int, neighbours: int, estimators: int) -> Floats:
    """Estimate descriptors from the reconstructed words (K, D). -> (N, D)

    Without words, return the direction of the point of each subspace nearest to zero.
    """
    if len(words) == 0:
        return unit_rows(feet_and_frames(release)[0].astype(np.float32))
    nearest, distances = find_nearest_to_subspaces(release, words, adversarial + neighbours)
    return estimate(release, words, nearest, distances, adversarial, estimators)


PLUGIN = Intersection
