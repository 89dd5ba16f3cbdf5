"""Positions of keypoints along released lines, estimated from the lines of their neighbours.

Source: Chelani, Benbihi, Sattler, Kahl and Kukelova, "Obfuscation Based Privacy Preserving Representations are Recoverable Using
Neighborhood Information", 3DV 2025 (arXiv 2409.11536). Its code is not published. The idea is theirs: a keypoint lies near its
neighbours, so it lies near its neighbours' lines. The estimators are ours.

Method: the point at t of line i has the distance |t − t_ij| |sin θ_ij| to the line of neighbour j. t_ij is the crossing of the
two lines and θ_ij their angle. The estimate minimizes the weighted sum of min(distance, `reach`) over the neighbours. The minimum
of this sum of truncated cones is at a crossing or at an end of the line, and all of them are tried. Without truncation the
estimate is the weighted median of the crossings.
"""

from __future__ import annotations

import numpy as np

from bench.geometry.lines import ClippedLines, Doubles, clip_lines
from bench.types import Floats, Indices

MIN_SINE = 0.02  # of the angle of two lines; lines that are closer to parallel say nothing about each other
BLOCK = 256  # lines that are processed together


def recover_positions(
    lines: Floats,
    neighbours: Indices,
    weights: Floats,
    size: tuple[int, int],
    reach: float = np.inf,
    known: Floats | None = None,
) -> Floats:
    """Return the estimated position on each line. -> (N, 2) float32 pixels

    Parameters
    ----------
    lines : (N, 3) lines {(x, y): a x + b y + c = 0} in pixels, a² + b² = 1
    neighbours : (N, k) rows of the lines
    weights : (N, k) at least 0; 0 leaves a neighbour out
    reach : pixels; a line farther away than this costs no more than one at this distance
    known : (N, 2) positions of some neighbours, NaN for the others; the nearest point to a known position replaces the crossing

    Without neighbours, the estimate is the point nearest to the centre of the image.
    """
    clipped = clip_lines(lines, size)
    if neighbours.shape[1] == 0:  # a single keypoint
        return clipped.locate(np.clip(0.0, clipped.first, clipped.last))
    best = np.empty(len(lines))
    for start in range(0, len(lines), BLOCK):
        rows = slice(start, start + BLOCK)
        crossings, slopes = _cross(clipped, rows, neighbours[rows])  # (B, k) twice
        if known is not None:
            steps = np.einsum("bkd,bd->bk", known[neighbours[rows]] - clipped.feet[rows, None], clipped.along[rows])
            crossings, slopes = np.where(np.isnan(steps), crossings, steps), np.where(np.isnan(steps), slopes, 1.0)
        first, last = clipped.first[rows, None], clipped.last[rows, None]
        tried = np.clip(crossings, first, last)
        distances = np.abs(tried[:, :, None] - crossings[:, None, :]) * slopes[:, None, :]  # (B, k, k)
        costs = (np.minimum(distances, reach) * weights[rows][:, None, :]).sum(axis=2)
        best[rows] = np.take_along_axis(tried, costs.argmin(axis=1, keepdims=True), axis=1)[:, 0]
    return clipped.locate(best)


def find_densest(lines: Floats, size: tuple[int, int], width: float = 8.0) -> Floats:
    """Return the point of each line where the crossings with all other lines are densest. -> (N, 2) float32 pixels

    Source: Chelani, Kahl and Sattler, CVPR 2021, for line clouds in space. There two lines rarely pass near each other. In an
    image all lines cross, and the density shows that of all keypoints. `width` is the standard deviation of the kernel.
    """
    from scipy.ndimage import gaussian_filter1d

    clipped, everything = clip_lines(lines, size), np.arange(len(lines))
    best = np.empty(len(lines))
    for row in range(len(lines)):
        crossings, slopes = _cross(clipped, slice(row, row + 1), everything[None])
        first, last = clipped.first[row], clipped.last[row]
        inside = (slopes > 0) & (crossings >= first) & (crossings <= last)
        bins = max(1, round(last - first))
        counts, edges = np.histogram(crossings[inside], bins, (first, last + 1e-9), weights=slopes[inside])
        density = gaussian_filter1d(counts, width, mode="nearest")
        best[row] = (edges[density.argmax()] + edges[density.argmax() + 1]) / 2
    return clipped.locate(best)


def _cross(lines: ClippedLines, rows: slice, near: Indices) -> tuple[Doubles, Doubles]:
    """Return t of the crossings with other lines, and the |sine| of the angles; both 0 for parallel lines. -> (B, k) twice"""
    sines = np.einsum("bd,bkd->bk", lines.along[rows], lines.normals[near])
    heights = np.einsum("bd,bkd->bk", lines.feet[rows], lines.normals[near]) + lines.offsets[near]
    usable = np.abs(sines) > MIN_SINE
    return np.where(usable, -heights / np.where(usable, sines, 1.0), 0.0), np.where(usable, np.abs(sines), 0.0)
