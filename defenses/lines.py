"""Lines: hides each keypoint's position on a random line through it. Descriptors are released unchanged.

Source: Speciale et al., "Privacy Preserving Image Queries for Camera Localization", ICCV 2019.

Method: draw the direction of each line uniformly, and release the line through the keypoint. Keypoints come in random
order (`bench.mechanisms.protection.hide_order`): their order from top to bottom would reveal the position.

Guarantee: none. The position on the line is hidden, the distance to the line is not.

Limits: keypoints crowd, so the lines of neighbours cross near the keypoint. The attack `neighbourhood` uses this.
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
class RandomLines(Defense):
    """Releases a random line through each keypoint, and the descriptors unchanged."""

    releases = Descriptors
    positions: ClassVar[type[Positions]] = Lines

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        angles = rng.uniform(0, np.pi, len(secret))
        return Descriptors(
            positions=draw_lines(secret.keypoints, angles), size=secret.size, descriptors=secret.descriptors.copy()
        )

    def privacy(self, public: Public) -> Privacy:
        return Privacy("none")


PLUGIN = RandomLines
