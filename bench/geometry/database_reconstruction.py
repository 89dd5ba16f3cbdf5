"""The words of a database rebuilt from releases alone: subspaces that share one meet there, in an exact 8-bit vector."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.geometry.intersections import Meetings
from bench.types import Bytes

Doubles = NDArray[np.float64]

NORM = 512.0  # about, of 8-bit descriptors
WHOLE = 0.01  # a number this near to an integer is one; a meeting of float32 releases is off by 1e-4 of the last bit


def rebuilt(met: Meetings) -> Bytes:
    """The different words at which subspaces meet in one point. -> (K, D)"""
    points = met.points[met.single]
    # One word is met many times, and not quite in the same point.
    first = np.unique(np.rint(points * NORM), axis=0, return_index=True)[1]
    return np.unique(bytes_of(points[first]), axis=0)


def bytes_of(points: Doubles) -> Bytes:
    """The least 8-bit vectors that point into these directions. Those of a point that is no multiple of one are left out.

    (P, D) -> (P', D). The greatest component is an integer from 1 to 255, and that leaves 255 lengths to try.
    """
    found = [np.empty((0, points.shape[1]), dtype=np.uint8)]
    directions = points / points.max(axis=1, initial=0.0, keepdims=True).clip(min=1e-9)  # (P, D) the greatest component is 1
    for greatest in range(1, 256):
        if len(directions) == 0:
            break
        whole = np.rint(directions * greatest)
        fits = (np.abs(directions * greatest - whole) < WHOLE).all(axis=1) & (whole >= 0).all(axis=1)
        found.append(whole[fits].astype(np.uint8))
        directions = directions[~fits]
    return np.concatenate(found)
