"""What a subspace hides, estimated from words that lie near it (the paper's Sec. 4.1, Step 3, and its equation for d̂)."""

from __future__ import annotations

import numpy as np

from bench.geometry.intersections import MEETS
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import Doubles, project
from bench.types import Bytes, Floats, Indices, Subspaces

GATHERED = 65_536  # words that are gathered at a time
TOUCHING = 1e-12  # a word that is nearer to D than this counts as so near, and outweighs every other


def estimate(release: Subspaces, words: Bytes, found: Indices, distances: Doubles, adversarial: int, estimators: int) -> Floats:
    """d̂ of each subspace: the mean of words that are near it and far from its adversarial ones, projected onto it.

    Adversarial are the first words that lie in D, at most as many as it was led through; where some of them are not among the
    words, the others stand for all. Of the rest the `estimators` that are farthest from each of these count, by 1 / dist(D, u).

    Parameters
    ----------
    words : (K, D)
    found, distances : (N, adversarial + |V|) the nearest words of each subspace, nearest first

    Returns
    -------
    (N, D) unit rows
    """
    means = np.empty((len(release), words.shape[1]))
    step = max(1, GATHERED // found.shape[1])
    for start in range(0, len(release), step):
        batch = slice(start, start + step)
        rows = unit_rows(words[found[batch]])  # (n, adversarial + |V|, D)
        known = distances[batch, :adversarial] < MEETS  # (n, adversarial)
        cosines = rows @ rows[:, :adversarial].transpose(0, 2, 1)  # (n, adversarial + |V|, adversarial)
        # The greater the cosine, the shorter min_j |â_j − v|. An â itself comes last.
        closeness = np.where(known[:, None], cosines, -np.inf).max(axis=2)
        closeness[:, :adversarial][known] = np.inf
        chosen = np.argsort(closeness, axis=1, kind="stable")[:, :estimators]  # (n, |U|)
        u = np.take_along_axis(rows, chosen[:, :, None], axis=1)  # (n, |U|, D)
        weights = 1 / np.maximum(np.take_along_axis(distances[batch], chosen, axis=1), TOUCHING)
        means[batch] = np.einsum("nu,nud->nd", weights / weights.sum(axis=1, keepdims=True), u)
    return unit_rows(project(release, means).astype(np.float32))
