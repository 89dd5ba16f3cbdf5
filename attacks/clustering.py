"""The clustering attack (the paper's Sec. 4.2): without W, but with releases of other photographs that were made with it.

Step 1 takes distances of the words of Z, the attacker's own database, to D. Step 2 takes the |V| nearest. Step 3 clusters them:
they lie near D where D meets real descriptors, at its words or at d, which makes one cluster more than D has words. The mean of
each, weighted by 1 / dist(D, v) and projected onto D, is a candidate d̂_i. Step 4 tells which is d: subspaces Q' that meet D do so
at a word of D's, so words have distance zero from one of them, and the candidate with the largest min_j dist(d̂_i, Q'_j) is taken.

Choices that the paper leaves open. Clusters: farthest-first traversal from the word nearest to D (Gonzalez 1985), each word going
to the nearest centre; Lloyd's iterations from there make it worse, as they draw the centres to where most words are. Q: the
photograph's own other subspaces and, of the other releases, those that share its sub-database. Where no Q' meets D, the candidate
of least L1 norm is taken: a descriptor has zeros, and the words of a database that are means of many have none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import Asset, Defense, DescriptorAttack, Extractor, View, explain_no_words, require_subspaces
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.nearest_words import unit_rows
from bench.geometry.shared_sub_database import Company, company, nearest_that_meet
from bench.geometry.subspaces import Doubles, feet_and_frames, nearest_to_subspaces
from bench.types import Bytes, Floats, Indices, Knowledge, Subspaces

BATCH = 64  # subspaces whose words are gathered at a time
TOUCHING = 1e-12  # a word that is nearer to D than this counts as so near


@dataclass(frozen=True, kw_only=True)
class Clustering(DescriptorAttack):
    """Clusters public words near a subspace, and takes the cluster that no intersecting subspace explains."""

    accepts = (Subspaces,)
    needs = frozenset({Knowledge.PUBLIC_DATABASE, Knowledge.OTHER_RELEASES})

    database: Asset = Asset("shipped-public")
    neighbours: int = 512  # |V|: public words nearest to the subspace
    coverage: float = 0.95  # releases are asked for until this share of the photograph's words is met
    others: int = 800  # c: releases of other photographs that there are to ask for

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
            raise UserError(f"clustering: {clusters} clusters need as many neighbours, got {self.neighbours}")
        z = view.know(Knowledge.PUBLIC_DATABASE).words  # (K, D)
        found, distances = nearest_to_subspaces(release, z, self.neighbours)
        d = candidates(release, z, found, distances, clusters)  # (N, k, D)
        shared = company(release, view.know(Knowledge.OTHER_RELEASES)(self.others), words, self.coverage)
        view.notes.append(shared.summary())
        return chosen(d, shared)


def candidates(release: Subspaces, words: Bytes, found: Indices, distances: Doubles, clusters: int) -> Doubles:
    """The d̂_i of each subspace from its nearest words, nearest first. (K, D) words, (N, |V|) twice -> (N, k, D)"""
    feet, frames = feet_and_frames(release)
    means = np.empty((len(release), clusters, words.shape[1]))
    for start in range(0, len(release), BATCH):
        batch = slice(start, start + BATCH)
        v = unit_rows(words[found[batch]])  # (n, |V|, D)
        member = clustered(v, clusters)[:, None] == np.arange(clusters)[:, None]  # (n, k, |V|)
        weights = member / np.maximum(distances[batch], TOUCHING)[:, None]
        means[batch] = (weights / weights.sum(axis=2, keepdims=True)) @ v
    offsets = means - feet[:, None]
    return feet[:, None] + (offsets @ frames.transpose(0, 2, 1)) @ frames


def chosen(d: Doubles, shared: Company) -> Floats:
    """Of the candidates of each subspace, that which no subspace that meets it comes near (Step 4). (N, k, D) -> (N, D)"""
    far = nearest_that_meet(d, shared)  # (N, k)
    met = np.isfinite(far).all(axis=1)  # (N,)
    best = np.where(met, far.argmax(axis=1), np.abs(d).sum(axis=2).argmin(axis=1))
    return unit_rows(d[np.arange(len(d)), best].astype(np.float32))


def clustered(rows: Floats, clusters: int) -> Indices:
    """The cluster of each row, by farthest-first traversal from the first. (n, V, D) unit norm -> (n, V)

    Rows are compared by their cosines. Of V different rows each cluster gets one or more.
    """
    every = np.arange(len(rows))
    closeness = np.empty((*rows.shape[:2], clusters), dtype=np.float32)  # (n, V, k) to the centres
    centre = np.zeros(len(rows), dtype=np.int64)
    for number in range(clusters):
        closeness[:, :, number] = (rows @ rows[every, centre][:, :, None])[:, :, 0]
        closeness[every, centre, number] = np.inf  # however rounding has it, no row is nearer to another centre than to itself
        centre = closeness[:, :, : number + 1].max(axis=2).argmin(axis=1)
    return closeness.argmax(axis=2)


PLUGIN = Clustering
