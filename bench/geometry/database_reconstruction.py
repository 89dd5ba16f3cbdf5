"""Database reconstruction from releases alone: subspaces with a common word intersect in it, and it is an 8-bit vector."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.geometry.intersections import SubspaceIntersections
from bench.types import Bytes

Doubles = NDArray[np.float64]

NORM = 512.0  # approximate norm of 8-bit descriptors
INTEGER_TOLERANCE = 0.01  # a number this near to an integer counts as an integer; float32 releases err by 1e-4 of the last bit


def reconstruct_database(intersections: SubspaceIntersections) -> Bytes:
    """Return the distinct words at which subspaces intersect in one point. -> (K, D)"""
    points = intersections.points[intersections.single]
    # A word has many intersections, at slightly different points.
    first = np.unique(np.rint(points * NORM), axis=0, return_index=True)[1]
    return np.unique(find_byte_vectors(points[first]), axis=0)


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
