"""Density: the point of each line where the crossings with all other lines are densest. Descriptors are not read.

Source: Chelani, Kahl and Sattler, "How Privacy-Preserving are Line Clouds?", CVPR 2021.

Method: `bench.positions.neighbourhood.find_densest`.

Knowledge: none.

Limits: the source attacks lines in space, where two lines rarely pass near each other. In an image all lines cross, and their
density shows that of all keypoints. The attack is the baseline of `neighbourhood`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import PositionAttack, View
from bench.geometry.lines import read_lines
from bench.positions.neighbourhood import find_densest
from bench.types import Descriptors, Floats, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Density(PositionAttack):
    """Returns the point of each line where the crossings with all other lines are densest."""

    accepts = (Descriptors, WordSets, Subspaces)

    width: float = 8.0  # standard deviation of the density's kernel in pixels

    def locate(self, view: View, rng: np.random.Generator) -> Floats:
        return find_densest(read_lines(view.release), view.release.size, self.width)


PLUGIN = Density
