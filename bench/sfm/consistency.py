"""Matches whose neighbours move alike: how true ones are found among many that are due to chance.

Where sets of words are released, most matches of two images are accidents: with N keypoints of m words each, of |K| words, some

    |K| (λ e^-λ)²,    λ = N m / |K|,

words are unique in both images by chance. They scatter; true matches lie in a field of displacements that changes little from
one place to the next. So the support of a match is counted, as the matches nearby that are displaced like it (grid-based motion
statistics: Bian et al., CVPR 2017), and the half that has least of it is dropped, again and again: chance fades as their number
does, and the support that true matches give each other stays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bench.types import Indices

Doubles = NDArray[np.float64]

NEAR = 0.1  # half the side of the neighbourhood, as a share of the image's longer side
ALIKE = 0.025  # of the displacement, likewise
TELLING = 0.05  # chance of what counts as more support than chance gives
CLEAN = 0.8  # share of matches with such support at which no more are dropped
MANY = 2000  # matches, of which most are accidents in any case: as many as an image has keypoints


def support(first: Doubles, second: Doubles, near: float, alike: float) -> Indices:
    """For each match the number of other matches near it that are displaced alike. (M, 2), (M, 2) pixels -> (M,)

    Parameters
    ----------
    near, alike : how far apart two positions in the first image, and two displacements, may be along each axis, in pixels
    """
    places = _places(first, second, near, alike)
    return np.asarray(cKDTree(places).query_ball_point(places, 1.0, p=np.inf, return_length=True), np.int64) - 1


def consistent(first: Doubles, second: Doubles, longer: float, fewest: int, rng: np.random.Generator) -> Indices:
    """Rows of the matches that support each other, ascending. (M, 2), (M, 2) pixels -> (M',)

    Stops when four in five of those left have more support than nineteen in twenty of as many matches between the same
    positions that are shuffled, or when `fewest` are left.

    Parameters
    ----------
    longer : of the image's sides, in pixels
    """
    left = np.arange(len(first))
    near, alike = NEAR * longer, ALIKE * longer
    while len(left) > fewest:
        a, b = first[left], second[left]
        found = support(a, b, near, alike)
        if len(left) <= MANY and _clean(found, support(a, rng.permutation(b), near, alike)):
            break
        kept = np.argsort(-found, kind="stable")[: max(fewest, len(left) // 2)]
        left = left[np.sort(kept)]
    return left


def _clean(found: Indices, chance: Indices) -> bool:
    return bool((found > np.quantile(chance, 1 - TELLING)).mean() >= CLEAN)


def supported(first: Doubles, second: Doubles, trusted: Indices, longer: float) -> Indices:
    """Rows of the matches near a trusted one, other than themselves, that are displaced like it, ascending. -> (M',)"""
    places = _places(first, second, NEAR * longer, ALIKE * longer)
    counts = np.asarray(cKDTree(places[trusted]).query_ball_point(places, 1.0, p=np.inf, return_length=True))
    counts[trusted] -= 1
    return np.flatnonzero(counts > 0)


def _places(first: Doubles, second: Doubles, near: float, alike: float) -> Doubles:
    """Points that are at most 1 apart along each axis where matches are near and displaced alike. -> (M, 4)"""
    return np.concatenate([first / near, (second - first) / alike], axis=1)
