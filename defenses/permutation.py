"""Permutation: pairs of keypoints exchange one coordinate. Descriptors are released unchanged.

Source: after Pan, Schönberger, Larsson and Pollefeys, "Privacy Preserving Localization via Coordinate Permutations", ICCV 2023.

Method:

1. Draw a pairing of the keypoints. If their number is odd, one triple exchanges its coordinates in a circle.
2. Draw for each pair, with equal chances, whether x or y is exchanged. Release the points, and which coordinate is exchanged.

Keypoints come in random order (`bench.mechanisms.protection.hide_order`). A single keypoint exchanges with a random number.

Guarantee: none. The other coordinate stays in the clear.

Limits: as those of `lines`, with lines that are parallel to the sides of the image. The exchanged coordinates are those of other
keypoints, so each true coordinate is among the released ones. Keypoints of a pair with an equal coordinate may stay in place.
The construction follows the title and descriptions of the source. Its text was not available, so details may differ. Here,
localization reads the lines alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.api import Defense, Privacy
from bench.codebook.public import Public
from bench.positions.lines import draw_lines
from bench.types import Descriptors, Features, Permuted, Positions


@dataclass(frozen=True, kw_only=True)
class Permutation(Defense):
    """Exchanges one coordinate between pairs of keypoints, and releases the descriptors unchanged."""

    releases = Descriptors
    positions: ClassVar[type[Positions]] = Permuted

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        count = len(secret)
        groups = np.array_split(rng.permutation(count), max(1, count // 2))  # pairs, and a triple if the number is odd
        axes = np.zeros(count, np.int64)  # of the exchanged coordinates
        points = secret.keypoints.copy()
        for group, axis in zip(groups, rng.integers(0, 2, len(groups)), strict=True):
            axes[group] = axis
            points[group, axis] = secret.keypoints[np.roll(group, 1), axis]
        if count == 1:
            points[0, axes[0]] = rng.uniform(0, secret.size[axes[0]])
        angles = np.where(axes == 0, np.pi / 2, 0.0)  # of the normals: along the coordinate that is not exchanged
        lines = draw_lines(secret.keypoints, angles).lines
        positions = Permuted(lines=lines, points=points)
        return Descriptors(positions=positions, size=secret.size, descriptors=secret.descriptors.copy())

    def privacy(self, public: Public) -> Privacy:
        return Privacy("none")


PLUGIN = Permutation
