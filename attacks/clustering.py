"""Clustering attack: estimates the descriptors in affine subspaces without the defense's database W.

Source: the paper's Sec. 4.2.

Method, for a subspace D that contains the descriptor d and a words of W:

1. Compute the distance of each word of Z to D.
2. Select the |V| nearest words. They lie near the real descriptors in D, which are its a words and d.
3. Cluster them into a + 1 clusters. Each cluster gives a candidate d̂_i: the mean of its words v, weighted by 1 / dist(D, v)
   and projected onto D.
4. Find the subspaces Q'_j that intersect D. Each intersects D at a word of D, so these words have distance zero from some Q'_j.
   The estimate is the candidate with the largest min_j dist(d̂_i, Q'_j), scaled to unit norm.

Knowledge: Z, a public database of the attacker's own, and other releases of the same defense with the same W.

Choices that the paper leaves open:

- Clusters come from a farthest-first traversal that starts at the word nearest to D (Gonzalez 1985). Each word joins the nearest
  centre. Lloyd's iterations from there are worse, because they move the centres to the regions with most words.
- The subspaces Q are the others of the photograph, and those of other releases that share its sub-database.
- If no Q'_j intersects D, the estimate is the candidate of least L1 norm. A descriptor has zeros, and words that are means of
  many descriptors have none.

Limits: step 4 does not exclude a word of D that no Q'_j contains. Records note the fraction of words that are covered.
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
from bench.types import Floats, Indices, Subspaces, Words

BATCH = 64  # subspaces per batch
TOUCHING = 1e-12  # lower limit of the distance of a word to D


@dataclass(frozen=True, kw_only=True)
class Clustering(DescriptorAttack):
    """Clusters the public words near a subspace, and selects the cluster that is farthest from all intersecting subspaces."""

    accepts = (Subspaces,)
    needs = frozenset({PublicDatabase, OtherReleases})

    database: Asset = Asset("shipped-public")
    neighbours: int = 512  # |V|, public words nearest to the subspace
    coverage: float = 0.95  # fraction of the photograph's words, from 0 to 1, at which no further releases are read
    others: int = 800  # c, the maximum number of other releases that are read

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
        view.notes.extend(shared.list_notes(self.coverage))
        return select_candidates(candidates, shared)


def build_candidates(release: Subspaces, words: Words, nearest: Indices, distances: Doubles, clusters: int) -> Doubles:
    """Build the candidates d̂_i of each subspace from its nearest words (Step 3).

    Parameters
    ----------
    words : (K, D)
    nearest, distances : (N, |V|) indices of the words, nearest first, and their distances to the subspace
    clusters : k

    Returns
    -------
    (N, k, D)
    """
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
    """Select the candidate of each subspace that is farthest from all intersecting subspaces (Step 4). (N, k, D) -> (N, D)"""
    distances = compute_intersection_distances(candidates, shared)  # (N, k)
    met = np.isfinite(distances).all(axis=1)  # (N,)
    best = np.where(met, distances.argmax(axis=1), np.abs(candidates).sum(axis=2).argmin(axis=1))
    return unit_rows(candidates[np.arange(len(candidates)), best].astype(np.float32))


def cluster(rows: Floats, clusters: int) -> Indices:
    """Assign each row to a cluster by a farthest-first traversal from the first row. (n, V, D) unit norm -> (n, V)

    The distance of two rows is compared by their cosine. If all rows differ, no cluster is empty.
    """
    every = np.arange(len(rows))
    closeness = np.empty((*rows.shape[:2], clusters), dtype=np.float32)  # (n, V, k) cosines with the centres
    centre = np.zeros(len(rows), dtype=np.int64)
    for number in range(clusters):
        closeness[:, :, number] = (rows @ rows[every, centre][:, :, None])[:, :, 0]
        closeness[every, centre, number] = np.inf  # despite rounding, a centre belongs to its own cluster
        centre = closeness[:, :, : number + 1].max(axis=2).argmin(axis=1)
    return closeness.argmax(axis=2)


PLUGIN = Clustering
