"""Thumbnails: 16 x 16 blurred luminance of an image, their similarity, and the rank of the right one among others.

A thumbnail shows the layout of a photograph and none of its details. So it can tell whether a reconstruction shows the right
photograph where SSIM and PSNR are those of a blank image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.types import Floats

Doubles = NDArray[np.float64]

SIDE = 16  # pixels of a thumbnail
SIGMA = 3.0  # pixels of an image of 256 x 256
LUMINANCE = (0.299, 0.587, 0.114)  # Rec. 601, as in OpenCV
CONSTANT = 1e-5  # standard deviation of luminance; an image of 8 bits that is not constant has more


def compute_thumbnail(image: Floats | Doubles) -> Doubles:
    """Return the blurred luminance of an image, averaged over a grid. (H, W, 3) in [0, 1] -> (16, 16) in [0, 1]

    The standard deviation of the Gaussian is 3 pixels for each 256 pixels of a side. A pixel that crosses the edge of a grid cell
    counts in each by its area.
    """
    from scipy.ndimage import gaussian_filter

    luminance = image.astype(np.float64) @ np.array(LUMINANCE)
    height, width = luminance.shape
    blurred = gaussian_filter(luminance, (SIGMA * height / 256, SIGMA * width / 256))
    return _average_weights(height) @ blurred @ _average_weights(width).T


def _average_weights(length: int) -> Doubles:
    """Return the weights of an average over 16 intervals of equal length. -> (16, length), rows have sum 1"""
    edges = np.linspace(0, length, SIDE + 1)
    pixels = np.arange(length)
    overlaps = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)  # (16, length)
    return np.clip(overlaps, 0, None) * (SIDE / length)


def normalize_thumbnails(thumbnails: Doubles) -> Doubles:
    """Subtract the mean of each thumbnail and scale it to unit norm; a constant one becomes zero. (..., 16, 16) -> (..., 256)"""
    return _normalize(_flatten(thumbnails))


def compare_thumbnails(one: Doubles, other: Doubles) -> Doubles:
    """Return the normalised correlation of thumbnails, from -1 to 1. (..., 16, 16), (..., 16, 16) -> (...)

    It does not change with brightness and contrast. A constant thumbnail has similarity 0 with every other.
    """
    return np.asarray((normalize_thumbnails(one) * normalize_thumbnails(other)).sum(axis=-1))


def rank_first(similarities: Doubles) -> float:
    """Return the rank of the first among all, from 1 for the greatest; equal values have their mean rank. (N,) -> 1 to N

    >>> rank_first(np.array([0.4, 0.9, 0.1]))
    2.0
    >>> rank_first(np.zeros(256))
    128.5
    """
    return float(1 + (similarities[1:] > similarities[0]).sum() + (similarities[1:] == similarities[0]).sum() / 2)


def compare_shifted(one: Doubles, other: Doubles, shift: int) -> Doubles:
    """Return the greatest correlation of thumbnails over shifts of up to `shift` rows and columns, from -1 to 1.

    Each correlation is that of the parts which overlap. (16, 16), (N, 16, 16) -> (N,)
    """
    best = np.full(len(other), -1.0)
    for down in range(-shift, shift + 1):
        for right in range(-shift, shift + 1):
            rows, columns = _slice_overlap(down), _slice_overlap(right)
            parts = one[rows[0], columns[0]], other[:, rows[1], columns[1]]
            best = np.maximum(best, _correlate(*(_flatten(part) for part in parts)))
    return best


def _slice_overlap(shift: int) -> tuple[slice, slice]:
    """Return the rows of one thumbnail, and those of the other, that coincide after a shift."""
    return slice(max(0, shift), SIDE + min(0, shift)), slice(max(0, -shift), SIDE + min(0, -shift))


def _flatten(part: Doubles) -> Doubles:
    return part.reshape(*part.shape[:-2], -1)


def _correlate(one: Doubles, other: Doubles) -> Doubles:
    """Return the normalised correlation; 0 for a constant part. (P,), (N, P) -> (N,)"""
    return np.asarray(_normalize(other) @ _normalize(one))


def _normalize(rows: Doubles) -> Doubles:
    """Subtract the mean of each row and scale it to unit norm; a constant one becomes zero. (..., P) -> (..., P)"""
    centred = rows - rows.mean(axis=-1, keepdims=True)
    norms = np.linalg.norm(centred, axis=-1, keepdims=True)
    smallest = CONSTANT * rows.shape[-1] ** 0.5  # the norm is the standard deviation times the root of P
    return np.where(norms > smallest, centred / np.maximum(norms, smallest), 0.0)
