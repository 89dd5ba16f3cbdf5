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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.types import Floats, Indices

Doubles = NDArray[np.float64]

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


@dataclass(frozen=True, kw_only=True, eq=False)
class ClippedLines:
    """Lines with their parts in the image. The point at t is foot + t · along."""

    normals: Doubles  # (N, 2) unit
    offsets: Doubles  # (N,) c
    along: Doubles  # (N, 2) unit
    feet: Doubles  # (N, 2) the points of the lines nearest to the image's centre
    first: Doubles  # (N,) t at one end of the part in the image; 0 if the line is outside
    last: Doubles  # (N,) t at the other end

    def locate(self, along: Doubles) -> Floats:
        """Return the points at t = `along` (N,). -> (N, 2) float32"""
        return (self.feet + along[:, None] * self.along).astype(np.float32)


def clip_lines(lines: Floats, size: tuple[int, int]) -> ClippedLines:
    """Clip lines (N, 3) to the image."""
    exact, corner = np.asarray(lines, dtype=np.float64), np.array(size, dtype=np.float64)
    normals = exact[:, :2]
    along = np.stack([-normals[:, 1], normals[:, 0]], axis=1)
    feet = corner / 2 - (normals @ (corner / 2) + exact[:, 2])[:, None] * normals
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([-feet / along, (corner - feet) / along])  # (2, N, 2)
    # A line parallel to a side has no crossing with it, and is between the two sides or outside.
    parallel, between = np.abs(along) < 1e-9, (feet >= 0) & (feet <= corner)
    first = np.where(parallel, np.where(between, -np.inf, np.inf), ends.min(axis=0)).max(axis=1)
    last = np.where(parallel, np.where(between, np.inf, -np.inf), ends.max(axis=0)).min(axis=1)
    outside = first > last
    first, last = (np.where(outside, 0.0, end) for end in (first, last))
    return ClippedLines(normals=normals, offsets=exact[:, 2], along=along, feet=feet, first=first, last=last)


def _cross(lines: ClippedLines, rows: slice, near: Indices) -> tuple[Doubles, Doubles]:
    """Return t of the crossings with other lines, and the |sine| of the angles; both 0 for parallel lines. -> (B, k) twice"""
    sines = np.einsum("bd,bkd->bk", lines.along[rows], lines.normals[near])
    heights = np.einsum("bd,bkd->bk", lines.feet[rows], lines.normals[near]) + lines.offsets[near]
    usable = np.abs(sines) > MIN_SINE
    return np.where(usable, -heights / np.where(usable, sines, 1.0), 0.0), np.where(usable, np.abs(sines), 0.0)
