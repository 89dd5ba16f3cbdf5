"""Lines through keypoints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.types import Floats, Lines


def draw_lines(keypoints: Floats, angles: NDArray[np.float64]) -> Lines:
    """Return the line through each keypoint (N, 2) whose normal has that angle (N,) to the x axis, in radians."""
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    offsets = -(normals * keypoints).sum(axis=1)
    return Lines(lines=np.column_stack([normals, offsets]).astype(np.float32))
