"""Lines in an image, and their parts in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.types import Floats, Lines, Release

Doubles = NDArray[np.float64]


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

    def sample(self, count: int) -> Floats:
        """Return the midpoints of `count` equal sections of each line's part in the image. -> (N, count, 2) float32"""
        steps = (np.arange(count) + 0.5) / count
        along = self.first[:, None] + steps * (self.last - self.first)[:, None]
        return (self.feet[:, None] + along[:, :, None] * self.along[:, None]).astype(np.float32)


def read_lines(release: Release) -> Floats:
    """Return the released lines. -> (N, 3)

    Raises
    ------
    TypeError
        if the release holds other positions.
    """
    if not isinstance(release.positions, Lines):
        raise TypeError(f"expected Lines, got {type(release.positions).__name__}")
    return release.positions.lines


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
