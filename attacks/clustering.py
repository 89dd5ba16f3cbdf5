"""The clustering attack (the paper's Sec. 4.2): without W, but with other releases that use it.

Step 1 computes the distances of the words of Z, the attacker's own database, to D. Step 2 selects the |V| nearest. Step 3
clusters them: they lie near D where D contains real descriptors, its words or d, so there is one cluster more than D has words.
The mean of each, weighted by 1 / dist(D, v) and projected onto D, is a candidate d̂_i. Step 4 selects d: a subspace Q' that
meets D does so at a word of D. Words have distance zero from some Q', so the candidate with the largest min_j dist(d̂_i, Q'_j)
is d.

Choices that the paper leaves open. Clusters: farthest-first traversal from the word nearest to D (Gonzalez 1985); each word
joins the nearest centre. Lloyd's iterations from there are worse, since they move the centres to where most words are. Q: the
other subspaces of the photograph, and those of other releases that share its sub-database. If no Q' meets D, the candidate of
least L1 norm is selected: a descriptor has zeros, and words that are means of many descriptors have none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import Defense, DescriptorAttack, Extractor, View, explain_no_words, require_subspaces
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.nearest_words import unit_rows
from bench.geometry.shared_sub_database import SharedSubDatabase, compute_intersection_distances, find_shared_sub_database
from bench.geometry.subspaces import Doubles, feet_and_frames, find_nearest_to_subspaces
from bench.settings import Asset
from bench.threat_model import OtherReleases, PublicDatabase
from bench.types import Bytes, Floats, Indices, Subspaces

BATCH = 64  # subspaces per batch
TOUCHING = 1e-12  # lower limit of the distance of a word to D


@dataclass(frozen=True, kw_only=True)
class Clustering(DescriptorAttack):
    """Clusters public words near a subspace, and selects the cluster that no intersecting subspace explains."""

    accepts = (Subspaces,)
    needs = frozenset({PublicDatabase, OtherReleases})

    database: Asset = Asset("shipped-public")
    neighbours: int = 512  # |V|: public words nearest to the subspace
    coverage: float = 0.95  # stop reading releases once this fraction of the photograph's words is covered
    others: int = 800  # c: number of other releases that can be read

    def __post_init__(self) -> None:
        if self.neighbours < 2:
            raise UserError(f"clustering: neighbours must be at least 2, got {self.neighbours}")
        if not 0 <= self.coverage <= 1:
            raise UserError(f"clustering: coverage must be from 0 to 1, got {self.coverage:g}")
        if self.others < 0:
            raise UserError(f"clustering: others must be at least 0, got {self.others}")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        return explain_no_words(defense)

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release, words = require_subspaces(view)
        clusters = words + 1
        if self.neighbours < clusters:
            raise UserError(f"clustering: {clusters} clusters need at least as many neighbours, got {self.neighbours}")
        z = view.know(PublicDatabase).words  # (K, D)
        nearest, distances = find_nearest_to_subspaces(release, z, self.neighbours)
        candidates = build_candidates(release, z, nearest, distances, clusters)  # (N, k, D)
        shared = find_shared_sub_database(release, view.know(OtherReleases).draw(self.others), words, self.coverage)
        view.notes.append(shared.summary())
        return select_candidates(candidates, shared)


def build_candidates(release: Subspaces, words: Bytes, nearest: Indices, distances: Doubles, clusters: int) -> Doubles:
    """Build the d̂_i of each subspace from its nearest words, nearest first. (K, D) words, (N, |V|) twice -> (N, k, D)"""
    feet, frames = feet_and_frames(release)
    means = np.empty((len(release), clusters, words.shape[1]))
    for start in range(0, len(release), BATCH):
        batch = slice(start, start + BATCH)
        v = unit_rows(words[nearest[batch]])  # (n, |V|, D)
        member = cluster(v, clusters)[:, None] == np.arange(clusters)[:, None]  # (n, k, |V|)
        weights = member / np.maximum(distances[batch], TOUCHING)[:, None]
        means[batch] = (weights / weights.sum(axis=2, keepdims=True)) @ v
    offsets = means - feet[:, None]
    return feet[:, None] + (offsets @ frames.transpose(0, 2, 1)) @ frames


def select_candidates(candidates: Doubles, shared: SharedSubDatabase) -> Floats:
    """Select the candidate of each subspace that is farthest from all subspaces that meet it (Step 4). (N, k, D) -> (N, D)"""
    distances = compute_intersection_distances(candidates, shared)  # (N, k)
    met = np.isfinite(distances).all(axis=1)  # (N,)
    best = np.where(met, distances.argmax(axis=1), np.abs(candidates).sum(axis=2).argmin(axis=1))
    return unit_rows(candidates[np.arange(len(candidates)), best].astype(np.float32))


def cluster(rows: Floats, clusters: int) -> Indices:
    """Return the cluster of each row, by farthest-first traversal from the first row. (n, V, D) unit norm -> (n, V)

    Rows are compared by their cosines. If all rows differ, no cluster is empty.
    """
    every = np.arange(len(rows))
    closeness = np.empty((*rows.shape[:2], clusters), dtype=np.float32)  # (n, V, k) to the centres
    centre = np.zeros(len(rows), dtype=np.int64)
    for number in range(clusters):
        closeness[:, :, number] = (rows @ rows[every, centre][:, :, None])[:, :, 0]
        closeness[every, centre, number] = np.inf  # rounding must not assign a centre to another cluster
        centre = closeness[:, :, : number + 1].max(axis=2).argmin(axis=1)
    return closeness.argmax(axis=2)


PLUGIN = Clustering
