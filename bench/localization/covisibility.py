"""Which references to match with each other, from their poses alone, as hloc's `pairs_from_poses` chooses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.images.scene import Reference

NEIGHBOURS = 20  # of each reference
TURN = 60.0  # degrees between optical axes beyond which two images have too little in common


def pairs(references: Sequence[Reference], neighbours: int = NEIGHBOURS, turn: float = TURN) -> list[tuple[int, int]]:
    """Each reference with the nearest of those that look its way: by the distance of centres, ties to the first.

    Returns
    -------
    Pairs (a, b) with a < b, ascending, each once.
    """
    centres = np.array([image.cam_from_world.inverse().translation for image in references])  # (V, 3)
    axes = np.array([image.cam_from_world.rotation.matrix()[2] for image in references])  # (V, 3)
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)  # (V, V)
    apart[axes @ axes.T < np.cos(np.radians(turn))] = np.inf
    np.fill_diagonal(apart, np.inf)
    found = set()
    for a, row in enumerate(apart):
        nearest = np.argsort(row, kind="stable")[:neighbours]
        found |= {(min(a, b), max(a, b)) for b in nearest.tolist() if np.isfinite(row[b])}
    return sorted(found)
