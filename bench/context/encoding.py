"""Encoding of releases as graphs: candidates, their prior odds, and the neighbours of each keypoint."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bench.api import Defense
from bench.codebook.public import Public
from bench.context.network import KeypointGraph
from bench.types import Floats, Indices, WordSets

MAX_LOG_ODDS = 20.0  # limit of the log odds in both directions
EXACT_TREE = 4  # FLANN_INDEX_KDTREE_SINGLE, which OpenCV does not export


def log_odds(log10_true: float, size: int) -> float:
    """Return ln(p / q): p is the chance that a given candidate is the true word, q that none of the `size` candidates is.

    `log10_true` is log10 of the chance that the true word is among the candidates.
    """
    log_true = log10_true * math.log(10)
    if log_true == 0:
        return MAX_LOG_ODDS
    return min(MAX_LOG_ODDS, max(-MAX_LOG_ODDS, log_true - math.log(size) - math.log(-math.expm1(log_true))))


def prior_odds(defense: Defense, public: Public, size: int) -> float:
    """Return the log odds of a defense's candidates, from its configuration.

    Raises
    ------
    TypeError
        if the defense does not declare the chance of the true word.
    """
    log10_true = defense.privacy(public).log10_true
    if log10_true is None:
        raise TypeError(f"{defense.name()} does not declare the chance of the true word")
    return log_odds(log10_true, size)


def build_graph(releases: Sequence[WordSets], odds: Sequence[float], neighbours: int) -> KeypointGraph:
    """Return one graph of several releases with equally many candidates per keypoint. No edge connects two releases."""
    import torch

    neighbour_indices, offsets, present, positions, spacing = [], [], [], [], []
    start = 0
    for release in releases:
        nearest, exists = find_nearest_keypoints(release.keypoints, neighbours)  # (N, k) twice
        neighbour_indices.append(nearest + start)
        present.append(exists)
        offsets.append((release.keypoints[nearest] - release.keypoints[:, None]) * exists[:, :, None])
        spacing.append(np.log1p(np.linalg.norm(offsets[-1], axis=2).max(axis=1)))
        positions.append(2 * release.keypoints / np.array(release.size, dtype=np.float32) - 1)
        start += len(release)
    indices, edges = np.concatenate(neighbour_indices), np.concatenate(present)
    return KeypointGraph(
        candidates=torch.from_numpy(np.concatenate([release.candidates for release in releases])),
        odds=torch.from_numpy(np.repeat(np.array(odds, dtype=np.float32), [len(release) for release in releases])),
        positions=torch.from_numpy(np.concatenate(positions).astype(np.float32)),
        spacing=torch.from_numpy(np.concatenate(spacing).astype(np.float32)),
        neighbours=torch.from_numpy(indices),
        offsets=torch.from_numpy(np.concatenate(offsets)),
        present=torch.from_numpy(edges),
        reverse=torch.from_numpy(find_reverse_edges(indices, edges)),
    )


def find_reverse_edges(neighbours: Indices, present: Floats) -> Indices:
    """Return the flat index of the edge from each neighbour back to the keypoint; P k if there is none. (P, k) twice -> (P, k)"""
    count, k = neighbours.shape
    forward = np.where(present > 0, np.arange(count)[:, None] * count + neighbours, -1).ravel()
    backward = (neighbours * count + np.arange(count)[:, None]).ravel()
    order = np.argsort(forward, kind="stable")
    found = order[np.minimum(np.searchsorted(forward[order], backward), len(order) - 1)]
    return np.where((forward[found] == backward) & (present.ravel() > 0), found, count * k).reshape(count, k)


def find_nearest_keypoints(keypoints: Floats, neighbours: int) -> tuple[Indices, Floats]:
    """Return the k nearest other keypoints of each, and 1 for those that exist, else 0. (N, 2) -> (N, k), (N, k) float32

    Ties are in any order.

    Raises
    ------
    ValueError
        if a keypoint is not finite.
    """
    import cv2

    if not np.isfinite(keypoints).all():
        raise ValueError("keypoints must be finite")
    count = len(keypoints)
    available = min(neighbours, count - 1)
    nearest = np.zeros((count, neighbours), dtype=np.int64)
    if available > 0:
        points = np.ascontiguousarray(keypoints, dtype=np.float32)
        tree = cv2.flann.Index(points, {"algorithm": EXACT_TREE})
        indices = tree.knnSearch(points, available + 1, params={"checks": -1})[0]
        own = indices == np.arange(count)[:, None]
        own[~own.any(axis=1), -1] = True  # among more coincident keypoints than neighbours, its own may be missing
        nearest[:, :available] = indices[~own].reshape(count, available)
    return nearest, np.repeat((np.arange(neighbours) < available)[None], count, axis=0).astype(np.float32)
