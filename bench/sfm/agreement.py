"""Whether cameras that structure from motion placed stand where they truly are, up to a similarity.

Positions alone leave open how a model is turned about the line of a straight walk, so rotations count as well: every two images
a and b propose the similarity that puts a's pose right and b at its true distance from it. The one that most images agree with
is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap

from bench.sfm.incremental_mapping import Model

NEAR = 0.05  # of the largest distance between two of the true cameras
TURN = 5.0  # degrees


def right(model: Model, truth: Sequence[pycolmap.Rigid3d]) -> int:
    """How many of the registered images have the right pose: within `NEAR` and `TURN`.

    Parameters
    ----------
    truth : cam_from_world of every image, registered or not
    """
    every = np.array([pose.inverse().translation for pose in truth])  # (I, 3)
    near = NEAR * float(np.linalg.norm(every[:, None] - every[None], axis=2).max())
    true, centres = every[list(model.images)], model.centres  # (V, 3) twice
    turns = np.array(  # (V, 3, 3) from the model's world to the true one, as each image has it
        [truth[image].rotation.matrix().T @ pose.rotation.matrix() for image, pose in zip(model.images, model.poses, strict=True)]
    )
    traces = np.einsum("aij,bij->ab", turns, turns)  # of the rotation between two of them: 1 + 2 cos
    facing = traces >= 1 + 2 * np.cos(np.radians(TURN))  # (V, V)
    most = 0
    for a, turn in enumerate(turns):
        moved = (centres - centres[a]) @ turn.T  # (V, 3)
        lengths = np.linalg.norm(moved, axis=1)
        scales = np.linalg.norm(true - true[a], axis=1)[lengths > 0] / lengths[lengths > 0]  # one for each b
        off = np.linalg.norm(scales[:, None, None] * moved + true[a] - true, axis=2)  # (b, V)
        most = max(most, int(((off <= near) & facing[a]).sum(axis=1).max(initial=0)))
    return most
