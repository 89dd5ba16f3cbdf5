"""The intersection attack: with releases of other photographs alone, and neither W nor a database of the attacker's own.

Two subspaces that go through one word meet in it, and W's words are 8-bit vectors: so where subspaces of releases that share a
sub-database meet, its words are found to the last bit. Whatever two or more subspaces go through is collected into a database,
and the database attack's steps follow (the paper's Sec. 4.1): a subspace's adversarial words are those in it, and the words next
nearest to it that are farthest from these estimate the descriptor. In no paper; the paper's clustering attack needs Z as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import Defense, DescriptorAttack, Extractor, View, explain_no_words, require_subspaces
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.database_reconstruction import rebuilt
from bench.geometry.estimates import estimate
from bench.geometry.intersections import meetings_within
from bench.geometry.nearest_words import unit_rows
from bench.geometry.shared_sub_database import company
from bench.geometry.subspaces import feet_and_frames, nearest_to_subspaces
from bench.types import Bytes, Floats, Knowledge, Subspaces


@dataclass(frozen=True, kw_only=True)
class Intersection(DescriptorAttack):
    """Rebuilds the words of the photograph's sub-database from where subspaces meet, and attacks with these."""

    accepts = (Subspaces,)
    needs = frozenset({Knowledge.OTHER_RELEASES})

    neighbours: int = 1024  # |V|: rebuilt words next nearest to the subspace
    estimators: int = 2  # |U|: those of them that the estimate is made of
    coverage: float = 0.95  # releases are asked for until this share of the photograph's words is met
    others: int = 800  # c: releases of other photographs that there are to ask for

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
        shared = company(release, view.know(Knowledge.OTHER_RELEASES)(self.others), adversarial, self.coverage)
        words = rebuilt(meetings_within(shared.subspaces))
        view.notes.append(f"{shared.summary()}; {len(words)} words rebuilt")
        return described(release, words, adversarial, self.neighbours, self.estimators)


def described(release: Subspaces, words: Bytes, adversarial: int, neighbours: int, estimators: int) -> Floats:
    """The estimates that these words allow; without any, the directions of the subspaces' points nearest to zero. -> (N, D)"""
    if len(words) == 0:
        return unit_rows(feet_and_frames(release)[0].astype(np.float32))
    found, distances = nearest_to_subspaces(release, words, adversarial + neighbours)
    return estimate(release, words, found, distances, adversarial, estimators)


PLUGIN = Intersection
