"""Selection of pairs of references to match, by their poses alone, as in hloc's `pairs_from_poses`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.images.scene import Reference

NEIGHBOURS = 20  # per reference
MAX_ANGLE = 60.0  # degrees between optical axes; images with a greater angle have too little in common


def select_pairs(
    references: Sequence[Reference], neighbours: int = NEIGHBOURS, max_angle: float = MAX_ANGLE
) -> list[tuple[int, int]]:
    """Return pairs of each reference and its nearest neighbours of similar direction.

    Neighbours are nearest by the distance of camera centres, ties to the first. Pairs (a, b) have a < b, ascend, and occur once.
    """
    centres = np.array([image.cam_from_world.inverse().translation for image in references])  # (V, 3)
    axes = np.array([image.cam_from_world.rotation.matrix()[2] for image in references])  # (V, 3)
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)  # (V, V)
    distances[axes @ axes.T < np.cos(np.radians(max_angle))] = np.inf
    np.fill_diagonal(distances, np.inf)
    pairs = set()
    for a, row in enumerate(distances):
        nearest = np.argsort(row, kind="stable")[:neighbours]
        pairs |= {(min(a, b), max(a, b)) for b in nearest.tolist() if np.isfinite(row[b])}
    return sorted(pairs)
