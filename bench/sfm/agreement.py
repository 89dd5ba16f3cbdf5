"""Agreement of the cameras of structure from motion with the true cameras, up to a similarity.

Positions alone do not determine the rotation about the line of a straight walk, so rotations must agree, too. Each pair of images
a and b proposes a similarity, which maps a to its true pose and b to its true distance from a. The similarity with most agreeing
images is selected.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from bench.sfm.incremental_mapping import Model

if TYPE_CHECKING:
    import pycolmap

MAX_OFFSET = 0.05  # fraction of the largest distance between two of the true cameras
MAX_ANGLE = 5.0  # degrees


def count_correct_poses(model: Model, truth: Sequence[pycolmap.Rigid3d]) -> int:
    """Return the number of registered images whose pose is within `MAX_OFFSET` and `MAX_ANGLE` of the true pose.

    Parameters
    ----------
    truth : cam_from_world of every image, registered or not
    """
    every = np.array([pose.inverse().translation for pose in truth])  # (I, 3)
    max_offset = MAX_OFFSET * float(np.linalg.norm(every[:, None] - every[None], axis=2).max())
    true, centres = every[list(model.images)], model.centres  # (V, 3) twice
    turns = np.array(  # (V, 3, 3) from the model's world to the true one, by each image
        [truth[image].rotation.matrix().T @ pose.rotation.matrix() for image, pose in zip(model.images, model.poses, strict=True)]
    )
    traces = np.einsum("aij,bij->ab", turns, turns)  # of the rotation between two of them: 1 + 2 cos
    facing = traces >= 1 + 2 * np.cos(np.radians(MAX_ANGLE))  # (V, V)
    most = 0
    for a, turn in enumerate(turns):
        moved = (centres - centres[a]) @ turn.T  # (V, 3)
        lengths = np.linalg.norm(moved, axis=1)
        scales = np.linalg.norm(true - true[a], axis=1)[lengths > 0] / lengths[lengths > 0]  # one for each b
        off = np.linalg.norm(scales[:, None, None] * moved + true[a] - true, axis=2)  # (b, V)
        most = max(most, int(((off <= max_offset) & facing[a]).sum(axis=1).max(initial=0)))
    return most
