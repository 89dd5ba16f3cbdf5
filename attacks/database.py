"""The database attack (the paper's Sec. 4.1): whoever knows W finds the words that a subspace was led through, and what is left.

Step 1 sorts the words by their distance to D. Step 2 takes the first for the adversarial descriptors â, as many as the defense's
configuration says: they lie in D but for the float32 of the release, about 1e-7. Step 3 takes the next |V| words. They lie near D
where D meets real descriptors, at an â or at d; so the |U| of them that are farthest from every â tell of d, by the paper's
equation for d̂: their mean, weighted by 1 / dist(D, u), projected onto D. Then d̂ is scaled to unit norm, as every descriptor is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.errors import UserError
from bench.kernels.search import unit_rows
from bench.kernels.subspaces import Doubles, nearest_to_subspaces, project
from bench.plugin import Defense, DescriptorAttack, Extractor, Lifting, View
from bench.public import Public
from bench.types import Bytes, Floats, Indices, Knowledge, Subspaces

GATHERED = 2**15  # words that are compared with adversarial ones at a time
TOUCHING = 1e-12  # a word that is nearer to D than this counts as so near, and outweighs every other


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

    def unsuited(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        if not isinstance(defense, Lifting):
            return f"{defense.name()} does not say how many words its subspaces go through"
        if defense.adversarial == 0:
            return f"{defense.name()} as configured leads its subspaces through no word"
        return None

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release, defense = view.release, view.defense
        if not isinstance(release, Subspaces) or not isinstance(defense, Lifting):
            raise TypeError(
                f"database attacks the Subspaces of a Lifting, got {type(release).__name__} of {type(defense).__name__}"
            )
        words = view.know(Knowledge.DATABASE).words  # (K, D)
        adversarial = defense.adversarial
        if len(words) <= adversarial:
            raise UserError(f"database: {len(words)} words leave none beside the {adversarial} in each subspace")
        found, distances = nearest_to_subspaces(release, words, adversarial + self.neighbours)
        a, v = found[:, :adversarial], found[:, adversarial:]
        return estimate(release, words, v, distances[:, adversarial:], closeness(words, v, a), self.estimators)


def closeness(words: Bytes, v: Indices, a: Indices) -> Floats:
    """The greatest cosine of each v and any a: the greater, the shorter min_j |â_j − v|. (K, D), (N, |V|), (N, A) -> (N, |V|)"""
    greatest = np.empty(v.shape, dtype=np.float32)
    step = max(1, GATHERED // v.shape[1])
    for start in range(0, len(v), step):
        batch = slice(start, start + step)
        adversaries = unit_rows(words[a[batch]])  # (n, A, D)
        greatest[batch] = (unit_rows(words[v[batch]]) @ adversaries.transpose(0, 2, 1)).max(axis=2)
    return greatest


def estimate(release: Subspaces, words: Bytes, v: Indices, distances: Doubles, close: Floats, estimators: int) -> Floats:
    """d̂ of each subspace from the words near it, their distances and their closeness. (K, D), (N, |V|) thrice -> (N, D)"""
    chosen = np.argsort(close, axis=1, kind="stable")[:, :estimators]  # (N, |U|)
    u = unit_rows(words[np.take_along_axis(v, chosen, axis=1)])  # (N, |U|, D)
    weights = 1 / np.maximum(np.take_along_axis(distances, chosen, axis=1), TOUCHING)
    means = np.einsum("nu,nud->nd", weights / weights.sum(axis=1, keepdims=True), u)
    return unit_rows(project(release, means).astype(np.float32))


PLUGIN = Database
