"""Neighbours of keypoints, predicted from what a release shows of their descriptors."""

from __future__ import annotations

from bench.api import Defense
from bench.codebook.public import Public
from bench.positions import neighbour_model
from bench.types import Descriptors, Floats, Indices, Release, WordSets


def predict_neighbours(release: Release, defense: Defense, public: Public, count: int) -> tuple[Indices, Floats]:
    """Return the likeliest neighbours of each keypoint and their weights by the shipped model. -> (N, k) twice

    Raises
    ------
    TypeError
        if the release holds neither descriptors nor word sets.
    """
    model = neighbour_model.load()
    if isinstance(release, Descriptors):
        log_ratios = model.log_ratios(release.descriptors[:, None])
    elif isinstance(release, WordSets):
        from bench.context.encoding import prior_odds  # it imports PyTorch

        log_ratios = model.log_ratios(release.candidates, prior_odds(defense, public, release.subset_size))
    else:
        raise TypeError(f"expected Descriptors or WordSets, got {type(release).__name__}")
    near, logs = neighbour_model.select_neighbours(log_ratios, count)
    return near, neighbour_model.weigh(logs)
