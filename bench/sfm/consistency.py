"""Selection of true matches among many accidental ones: true matches have neighbours with similar displacements.

Between two releases of word sets most matches are accidental. With N keypoints of m words each, of |K| words, about

    |K| (λ e^-λ)²,    λ = N m / |K|,

words are unique in both images by chance. Displacements of accidental matches scatter. Displacements of true matches vary
smoothly over the image. The support of a match is the number of nearby matches with a similar displacement (grid-based motion
statistics: Bian et al., CVPR 2017). The half of the matches with least support is dropped repeatedly. This reduces support by
chance, but not the support that true matches give each other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.types import Indices

Doubles = NDArray[np.float64]

NEAR = 0.1  # half the side of the neighbourhood, as a fraction of the image's longer side
SIMILAR = 0.025  # the same for displacements
SIGNIFICANCE = 0.05  # level at which support counts as more than chance
CLEAN_FRACTION = 0.8  # fraction of matches with significant support at which no more matches are dropped
MAX_CLEAN = 2000  # as many matches as an image has keypoints; if there are more, most are accidental


def count_support(first: Doubles, second: Doubles, near: float, similar: float) -> Indices:
    """Return for each match the number of other nearby matches with a similar displacement. (M, 2), (M, 2) pixels -> (M,)

    Parameters
    ----------
    near, similar : largest difference along each axis of positions in the first image, and of displacements, in pixels
    """
    from scipy.spatial import cKDTree

    points = _embed(first, second, near, similar)
    return np.asarray(cKDTree(points).query_ball_point(points, 1.0, p=np.inf, return_length=True), np.int64) - 1


def select_consistent(first: Doubles, second: Doubles, longer: float, minimum: int, rng: np.random.Generator) -> Indices:
    """Return the matches that support each other. (M, 2), (M, 2) pixels -> (M',) their rows, ascending

    The selection stops if 80% of the remaining matches have more support than 95% of the same matches shuffled, or if `minimum`
    remain.

    Parameters
    ----------
    longer : longer side of the image, in pixels
    """
    left = np.arange(len(first))
    near, similar = NEAR * longer, SIMILAR * longer
    while len(left) > minimum:
        a, b = first[left], second[left]
        support = count_support(a, b, near, similar)
        if len(left) <= MAX_CLEAN and _is_clean(support, count_support(a, rng.permutation(b), near, similar)):
            break
        best = np.argsort(-support, kind="stable")[: max(minimum, len(left) // 2)]
        left = left[np.sort(best)]
    return left


def _is_clean(support: Indices, chance: Indices) -> bool:
    """Return whether enough matches have more support than shuffled ones."""
    return bool((support > np.quantile(chance, 1 - SIGNIFICANCE)).mean() >= CLEAN_FRACTION)


def find_supported(first: Doubles, second: Doubles, trusted: Indices, longer: float) -> Indices:
    """Return the matches near another, trusted match with a similar displacement. -> (M',) their rows, ascending"""
    from scipy.spatial import cKDTree

    points = _embed(first, second, NEAR * longer, SIMILAR * longer)
    counts = np.asarray(cKDTree(points[trusted]).query_ball_point(points, 1.0, p=np.inf, return_length=True))
    counts[trusted] -= 1
    return np.flatnonzero(counts > 0)


def _embed(first: Doubles, second: Doubles, near: float, similar: float) -> Doubles:
    """Return matches as points that differ by at most 1 along each axis if they are near and similar. -> (M, 4)"""
    return np.concatenate([first / near, (second - first) / similar], axis=1)
