"""Database reconstruction from releases alone: subspaces with a common word intersect in it.

The words for SIFT are 8-bit vectors, which are recovered to the last bit. Others are recovered to the precision of the release.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.geometry.intersections import SubspaceIntersections
from bench.geometry.nearest_words import unit_rows
from bench.types import Bytes, Floats

Doubles = NDArray[np.float64]

NORM = 512.0  # approximate norm of 8-bit descriptors
INTEGER_TOLERANCE = 0.01  # a number this near to an integer counts as an integer; float32 releases err by 1e-4 of the last bit
UNIT_TOLERANCE = 1e-4  # of the norm of a word, and of the distance of two equal words; their errors may allow more


def reconstruct_database(intersections: SubspaceIntersections) -> Bytes | Floats:
    """Return the distinct words at which subspaces intersect in one point: 8-bit vectors, if there are any. -> (K, D)"""
    intersections = intersections.take(intersections.single)
    points = intersections.points
    # A word has many intersections, at slightly different points.
    first = np.unique(np.rint(points * NORM), axis=0, return_index=True)[1]
    whole = np.unique(find_byte_vectors(points[first]), axis=0)
    return whole if len(whole) else find_normalized_points(points[first], intersections.tolerances[first])


def find_normalized_points(points: Doubles, tolerances: Doubles) -> Floats:
    """Return the distinct points of unit norm, up to their errors. (P, D), (P,) -> (K, D) float32"""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    normal = np.abs(np.linalg.norm(points, axis=1) - 1) < np.maximum(UNIT_TOLERANCE, tolerances)
    words = points[normal]
    if len(words) == 0:
        return np.empty((0, points.shape[1]), dtype=np.float32)
    pairs = KDTree(words).query_pairs(max(UNIT_TOLERANCE, float(np.median(tolerances[normal]))), output_type="ndarray")  # (M, 2)
    indices = pairs.T.astype(np.int32)  # the only type that connected_components of scipy 1.11 reads
    equal = coo_array((np.ones(len(pairs), bool), indices), shape=(len(words), len(words)))
    return unit_rows(words[np.unique(connected_components(equal, directed=False)[1], return_index=True)[1]].astype(np.float32))


def find_byte_vectors(points: Doubles) -> Bytes:
    """Return the shortest 8-bit vector in the direction of each point; points without one are left out. (P, D) -> (P', D)

    The greatest component is an integer from 1 to 255, so 255 lengths are tried.
    """
    vectors = [np.empty((0, points.shape[1]), dtype=np.uint8)]
    directions = points / points.max(axis=1, initial=0.0, keepdims=True).clip(min=1e-9)  # (P, D) the greatest component is 1
    for greatest in range(1, 256):
        if len(directions) == 0:
            break
        whole = np.rint(directions * greatest)
        fits = (np.abs(directions * greatest - whole) < INTEGER_TOLERANCE).all(axis=1) & (whole >= 0).all(axis=1)
        vectors.append(whole[fits].astype(np.uint8))
        directions = directions[~fits]
    return np.concatenate(vectors)
