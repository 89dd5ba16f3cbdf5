"""Matches between two images of which something was released: by words, by descriptors, or by the distance of subspaces.

Sets of words match where they have a word in common. All else matches where it is mutually nearest: descriptors, a descriptor
and a subspace, or two subspaces (Dusmanu et al., CVPR 2021). The candidates of a set without a dictionary count as if each
had been seen.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bench.api import Defense
from bench.codebook.public import Public
from bench.core.device import pick_device
from bench.geometry.distances import mutual, points_to_points, subspaces_to_points, subspaces_to_subspaces
from bench.geometry.shared_words import sharing
from bench.registry import fields
from bench.types import Descriptors, Features, Indices, Release, Subspaces, WordSets


def unprotected(features: Features, defense: Defense, public: Public) -> Release:
    """Raw features, made ready to be matched with a release of that defense: quantised where it releases words."""
    if defense.dictionary_field is None:
        return Descriptors(keypoints=features.keypoints, size=features.size, descriptors=features.descriptors)
    asset = fields.asset_fields(defense)[defense.dictionary_field]
    count = 0 if defense.word_count_field is None else int(getattr(defense, defense.word_count_field))
    nearest = public.nearest_words(asset, features, count)[:, None]  # (N, 1)
    return WordSets(keypoints=features.keypoints, size=features.size, candidates=features.descriptors[:, None], words=nearest)


def matches(first: Release, second: Release, ratio: float = 1.0, unique: bool = False) -> Indices:
    """Pairs (i, j) of a keypoint of the first and one of the second, each once, ascending. -> (M, 2)

    Parameters
    ----------
    ratio : of Lowe's test, for what is mutually nearest; 1 asks for nothing
    unique : whether, of words, only those count that one keypoint alone has in each image

    Raises
    ------
    TypeError
        if it is a release of another kind.
    """
    if isinstance(first, WordSets) and isinstance(second, WordSets) and first.words is not None and second.words is not None:
        return sharing(first.words, second.words, unique)
    rows, columns = mutual(_squared(first, second), ratio)
    pairs = np.stack([rows // _each(first), columns // _each(second)], axis=1)
    return np.unique(pairs, axis=0)


def _squared(first: Release, second: Release) -> Tensor:
    """Squared distances of all that was seen of the one from all that was seen of the other."""
    if isinstance(first, Subspaces) and isinstance(second, Subspaces):
        return subspaces_to_subspaces(first, second)
    if isinstance(first, Subspaces):
        return subspaces_to_points(first, _points(second))
    if isinstance(second, Subspaces):
        return subspaces_to_points(second, _points(first)).T
    return points_to_points(_points(first), _points(second))


def _points(release: Release) -> Tensor:
    """(N each, D)"""
    if isinstance(release, Descriptors):
        rows = release.descriptors
    elif isinstance(release, WordSets):
        rows = release.candidates.reshape(-1, release.candidates.shape[2])
    else:
        raise TypeError(f"nothing matches {type(release).__name__}")
    return torch.from_numpy(np.ascontiguousarray(rows)).to(pick_device())


def _each(release: Release) -> int:
    """How many descriptors of a keypoint are seen."""
    return release.subset_size if isinstance(release, WordSets) else 1
