"""Permutation: swaps one coordinate of each keypoint with that of another one. Descriptors are released unchanged.

Source: after Pan, Schönberger, Larsson and Pollefeys, "Privacy Preserving Localization via Coordinate Permutations", ICCV 2023. A
permuted point has x of one keypoint and y of another, and the descriptors of both. So each descriptor has one known coordinate.

Method: draw for each keypoint, with equal chances, whether its x or its y is released, and release the line of that coordinate.

Guarantee: none.

Limits: as those of `lines`, with lines that are parallel to the sides of the image. Difference to the source: half of the
coordinates are released on average, instead of exactly half, and the pairs of permuted points are not formed. They carry no
information beyond the lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.api import Defense, Privacy
from bench.codebook.public import Public
from bench.positions.lines import draw_lines
from bench.types import Descriptors, Features, Lines, Positions


@dataclass(frozen=True, kw_only=True)
class Permutation(Defense):
    """Releases one coordinate of each keypoint, and the descriptors unchanged."""

    releases = Descriptors
    positions: ClassVar[type[Positions]] = Lines

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        angles = rng.integers(0, 2, len(secret)) * (np.pi / 2)
        return Descriptors(
            positions=draw_lines(secret.keypoints, angles), size=secret.size, descriptors=secret.descriptors.copy()
        )

    def privacy(self, public: Public) -> Privacy:
        return Privacy("none")


PLUGIN = Permutation
