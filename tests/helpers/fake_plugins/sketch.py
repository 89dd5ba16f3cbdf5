"""Draws a dot at each keypoint of any release, and counts its calls."""

from dataclasses import dataclass

import numpy as np

from bench.api import ImageAttack, View
from bench.types import Descriptors, Floats, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Sketch(ImageAttack):
    """Returns noise with a dot at each keypoint."""

    accepts = (Descriptors, WordSets, Subspaces)

    brightness: float = 1.0

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        width, height = view.release.size
        image = rng.random((height, width, 3), dtype=np.float32) * np.float32(0.5)
        x, y = np.minimum(view.release.keypoints.astype(int).T, width - 1)
        image[y, x] = self.brightness
        return image


PLUGIN = Sketch
