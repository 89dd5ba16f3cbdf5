"""Matches between the releases of two images: by words, by descriptors, or by the distance of subspaces.

Word sets match if they have a common word. All other releases match if they are mutually nearest: two descriptors, a descriptor
and a subspace, or two subspaces (Dusmanu et al., CVPR 2021). Each candidate of a word set without a dictionary counts as a
descriptor. `map_matching` matches a release with the points of a map.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.api import Defense
from bench.codebook.public import Public
from bench.core.device import pick_device
from bench.geometry.distances import (
    find_mutual_nearest,
    find_mutual_nearest_points,
    points_to_points,
    subspaces_to_points,
    subspaces_to_subspaces,
)
from bench.geometry.shared_words import find_shared_words
from bench.registry import fields
from bench.types import Descriptors, Features, Indices, Points, Release, Subspaces, WordSets

if TYPE_CHECKING:
    from torch import Tensor


def prepare_unprotected(features: Features, defense: Defense, public: Public) -> Release:
    """Return raw features as a release to match with one of that defense. They are quantised if it releases words."""
    if defense.dictionary_field is None:
        return Descriptors(positions=Points(keypoints=features.keypoints), size=features.size, descriptors=features.descriptors)
    asset = fields.list_assets(defense)[defense.dictionary_field]
    count = 0 if defense.word_count_field is None else int(getattr(defense, defense.word_count_field))
    nearest = public.nearest_words(asset, features, count)[:, None]  # (N, 1)
    return WordSets(
        positions=Points(keypoints=features.keypoints),
        size=features.size,
        candidates=features.descriptors[:, None],
        words=nearest,
    )


def match_releases(first: Release, second: Release, ratio: float = 1.0, unique: bool = False) -> Indices:
    """Return matches of keypoints i of the first release and j of the second. -> (M, 2) distinct pairs, ascending

    Parameters
    ----------
    ratio : of Lowe's test, for mutually nearest pairs; 1 disables it
    unique : whether to ignore words that occur more than once in an image

    Raises
    ------
    TypeError
        if a release is of another type.
    """
    if isinstance(first, WordSets) and isinstance(second, WordSets) and first.words is not None and second.words is not None:
        return find_shared_words(first.words, second.words, unique)
    rows, columns = find_mutual_nearest(_compute_squared_distances(first, second), ratio)
    pairs = np.stack([rows // _count_descriptors(first), columns // _count_descriptors(second)], axis=1)
    return np.unique(pairs, axis=0)


def match_by_word_descriptors(first: WordSets, second: WordSets, ratio: float = 1.0) -> Indices:
    """Return matches of keypoints whose sets have a pair of mutually nearest words. -> (M, 2) distinct pairs, ascending

    Distances are those of the words' descriptors. A word that both images release is nearest to itself. Each word counts once,
    however many keypoints have it, so the ratio test compares different words, and all keypoints with a pair of words match.

    Parameters
    ----------
    ratio : of Lowe's test; 1 disables it

    Raises
    ------
    TypeError
        if a release has no words of a dictionary.
    """
    rows, inverse = _list_words(first)
    other_rows, other_inverse = _list_words(second)
    one, other = find_mutual_nearest_points(rows, other_rows, ratio)
    # Both words of a pair get the pair's number, and all others a number of their own. The sets then match by equal numbers.
    numbers, other_numbers = np.arange(len(rows)), len(rows) + np.arange(len(other_rows))
    other_numbers[other] = one
    return find_shared_words(numbers[inverse], other_numbers[other_inverse])


def _list_words(release: WordSets) -> tuple[Tensor, Indices]:
    """Return the descriptors of the distinct words of a release, and the number of each word. -> (W, D), (N, m)"""
    import torch

    if release.words is None:
        raise TypeError("matching by the descriptors of words needs words of a dictionary")
    _, first, inverse = np.unique(release.words, return_index=True, return_inverse=True)
    rows = release.candidates.reshape(-1, release.candidates.shape[2])[first]
    return torch.from_numpy(np.ascontiguousarray(rows)).to(pick_device()), inverse.reshape(release.words.shape)


def _compute_squared_distances(first: Release, second: Release) -> Tensor:
    """Return squared distances between all descriptors or subspaces of one release and those of the other."""
    if isinstance(first, Subspaces) and isinstance(second, Subspaces):
        return subspaces_to_subspaces(first, second)
    if isinstance(first, Subspaces):
        return subspaces_to_points(first, _load_descriptors(second))
    if isinstance(second, Subspaces):
        return subspaces_to_points(second, _load_descriptors(first)).T
    return points_to_points(_load_descriptors(first), _load_descriptors(second))


def _load_descriptors(release: Release) -> Tensor:
    """Return descriptors or candidates. -> (N or N m, D)"""
    import torch

    if isinstance(release, Descriptors):
        rows = release.descriptors
    elif isinstance(release, WordSets):
        rows = release.candidates.reshape(-1, release.candidates.shape[2])
    else:
        raise TypeError(f"nothing matches {type(release).__name__}")
    return torch.from_numpy(np.ascontiguousarray(rows)).to(pick_device())


def _count_descriptors(release: Release) -> int:
    """Return the number of descriptors per keypoint."""
    return release.subset_size if isinstance(release, WordSets) else 1
