"""No defense: releases the descriptors unchanged. The upper bound of every attack, the paper's rows "Raw"."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bench.api import Defense, Privacy
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.types import Descriptors, Features, Floats, Points

COLUMNS = {"positions": 0, "scale": 1, "scale-and-orientation": 2}  # number of columns of `Features.frames` that are sent


@dataclass(frozen=True, kw_only=True)
class Undefended(Defense):
    """Releases the descriptors unchanged.

    Some clients send the scale and the orientation of a keypoint as well, as the files of COLMAP and hloc do (`sends`).
    """

    releases = Descriptors

    sends: Literal["positions", "scale", "scale-and-orientation"] = "positions"  # data sent of each keypoint

    def __post_init__(self) -> None:
        if self.sends not in COLUMNS:
            raise UserError(f"none: sends must be positions, scale or scale-and-orientation, got {self.sends}")

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        return Descriptors(
            positions=Points(keypoints=secret.keypoints.copy()),
            size=secret.size,
            descriptors=secret.descriptors.copy(),
            frames=self._select_frames(secret),
        )

    def _select_frames(self, secret: Features) -> Floats | None:
        columns = COLUMNS[self.sends]
        if columns == 0:
            return None
        if secret.frames is None:
            raise UserError(f"none: sends={self.sends}, but the extractor does not provide scale and orientation")
        return secret.frames[:, :columns].copy()

    def privacy(self, public: Public) -> Privacy:
        return Privacy("none")


PLUGIN = Undefended
