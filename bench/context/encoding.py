"""A release as the network sees it: candidates, their prior odds, and who is near whom."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from bench.api import Defense
from bench.codebook.public import Public
from bench.context.network import Scene
from bench.types import Floats, Indices, WordSets

CERTAIN = 20.0  # the log odds at most, either way


def log_odds(log10_true: float, size: int) -> float:
    """Log of the chance that a candidate is the true word over that of none being it. `log10_true` is that one of m is."""
    told = log10_true * math.log(10)
    if told == 0:
        return CERTAIN
    return min(CERTAIN, max(-CERTAIN, told - math.log(size) - math.log(-math.expm1(told))))


def prior_odds(defense: Defense, public: Public, size: int) -> float:
    """The same of a defense's release, from its configuration.

    Raises
    ------
    TypeError
        if the defense does not say how likely the true word is released.
    """
    told = defense.privacy(public).log10_true
    if told is None:
        raise TypeError(f"{defense.name()} does not say how likely the true word is released")
    return log_odds(told, size)


def scene(releases: Sequence[WordSets], odds: Sequence[float], neighbours: int) -> Scene:
    """Lay releases that have equally many candidates a keypoint side by side; none sees another's keypoints."""
    around, offsets, present, places = [], [], [], []
    start = 0
    for release in releases:
        near, there = nearest_keypoints(release.keypoints, neighbours)  # (N, k) twice
        around.append(near + start)
        present.append(there)
        offsets.append(release.keypoints[near] - release.keypoints[:, None])
        places.append(2 * release.keypoints / np.array(release.size, dtype=np.float32) - 1)
        start += len(release)
    return Scene(
        candidates=torch.from_numpy(np.concatenate([release.candidates for release in releases])),
        odds=torch.from_numpy(np.repeat(np.array(odds, dtype=np.float32), [len(release) for release in releases])),
        places=torch.from_numpy(np.concatenate(places).astype(np.float32)),
        around=torch.from_numpy(np.concatenate(around)),
        offsets=torch.from_numpy(np.concatenate(offsets)),
        present=torch.from_numpy(np.concatenate(present)),
    )


def nearest_keypoints(keypoints: Floats, neighbours: int) -> tuple[Indices, Floats]:
    """The nearest other keypoints of each, and 0 where there is none left, else 1. (N, 2) -> (N, k), (N, k) float32"""
    from sklearn.neighbors import NearestNeighbors

    count = len(keypoints)
    found = min(neighbours, count - 1)
    near = np.zeros((count, neighbours), dtype=np.int64)
    if found > 0:
        near[:, :found] = NearestNeighbors(n_neighbors=found).fit(keypoints).kneighbors(return_distance=False)
    return near, np.repeat((np.arange(neighbours) < found)[None], count, axis=0).astype(np.float32)
