"""Whether cameras that structure from motion placed stand where they truly are, up to a similarity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pycolmap

from bench.structure.consistency import Doubles
from bench.structure.mapping import Model

NEAR = 0.05  # of the largest distance between two of the true cameras
TURN = 5.0  # degrees


def right(model: Model, truth: Sequence[pycolmap.Rigid3d]) -> int:
    """How many of the registered images have the right pose, in the similarity by which most positions fit.

    Parameters
    ----------
    truth : cam_from_world of every image, registered or not
    """
    every = np.array([pose.inverse().translation for pose in truth])  # (I, 3)
    near = NEAR * float(np.linalg.norm(every[:, None] - every[None], axis=2).max())
    true = every[list(model.images)]  # (V, 3)
    options = pycolmap.RANSACOptions(max_error=near, min_inlier_ratio=0.1, max_num_trials=1000, random_seed=0)
    found: Any = pycolmap.estimate_sim3d_robust(model.centres, true, options)  # a dict, whatever its signature says
    if found is None:
        return 0
    moved: pycolmap.Sim3d = found["tgt_from_src"]
    off = np.linalg.norm(_transformed(moved, model.centres) - true, axis=1)
    turned = [
        np.degrees((pose.rotation * moved.rotation.inverse()).angle_to(truth[image].rotation))
        for image, pose in zip(model.images, model.poses, strict=True)
    ]
    return int(((off <= near) & (np.array(turned) <= TURN)).sum())


def _transformed(moved: pycolmap.Sim3d, points: Doubles) -> Doubles:
    """(N, 3) -> (N, 3)"""
    return np.asarray(moved.scale * points @ moved.rotation.matrix().T + moved.translation)
