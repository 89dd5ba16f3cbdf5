"""Estimates of the descriptor in a subspace from the words near it (the paper's Sec. 4.1, Step 3, and its equation for d̂)."""

from __future__ import annotations

import numpy as np

from bench.geometry.intersections import estimate_tolerances
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import Doubles, project
from bench.types import Floats, Indices, Subspaces, Words

BATCH_WORDS = 65_536  # words per batch
MIN_DISTANCE = 1e-12  # replaces smaller distances to D; such a word outweighs all others


def estimate(
    release: Subspaces, words: Words | Floats, found: Indices, distances: Doubles, adversarial: int, estimators: int
) -> Floats:
    """Return d̂ of each subspace: the mean of words near it and far from its adversarial ones, projected onto it.

    The adversarial words are the first words that lie in D, at most `adversarial`. If some of them are not among `words`, the
    others represent them. Of the remaining words, the `estimators` words farthest from the adversarial ones are averaged with
    weights 1 / dist(D, u).

    Parameters
    ----------
    words : (K, D)
    found, distances : (N, adversarial + |V|) the nearest words of each subspace, nearest first

    Returns
    -------
    (N, D) unit rows
    """
    means = np.empty((len(release), words.shape[1]))
    tolerances = estimate_tolerances(release)[:, None]
    step = max(1, BATCH_WORDS // found.shape[1])
    for start in range(0, len(release), step):
        batch = slice(start, start + step)
        rows = unit_rows(words[found[batch]])  # (n, adversarial + |V|, D)
        inside = distances[batch, :adversarial] < tolerances[batch]  # (n, adversarial)
        cosines = rows @ rows[:, :adversarial].transpose(0, 2, 1)  # (n, adversarial + |V|, adversarial)
        # A greater cosine means a smaller min_j |â_j − v|. The â themselves come last.
        closeness = np.where(inside[:, None], cosines, -np.inf).max(axis=2)
        closeness[:, :adversarial][inside] = np.inf
        selection = np.argsort(closeness, axis=1, kind="stable")[:, :estimators]  # (n, |U|)
        u = np.take_along_axis(rows, selection[:, :, None], axis=1)  # (n, |U|, D)
        weights = 1 / np.maximum(np.take_along_axis(distances[batch], selection, axis=1), MIN_DISTANCE)
        means[batch] = np.einsum("nu,nud->nd", weights / weights.sum(axis=1, keepdims=True), u)
    return unit_rows(project(release, means).astype(np.float32))
