"""Knows the descriptors of half of the keypoints: those of the release itself."""

from dataclasses import dataclass

import numpy as np

from bench.api import Selection, SelectiveAttack, View
from bench.types import Descriptors


@dataclass(frozen=True, kw_only=True)
class Glimpse(SelectiveAttack):
    """Takes every second keypoint."""

    accepts = (Descriptors,)

    def select(self, view: View, rng: np.random.Generator) -> Selection:
        release = view.release
        assert isinstance(release, Descriptors)
        return Selection(rows=np.arange(0, len(release), 2), descriptors=release.descriptors[::2].copy())


PLUGIN = Glimpse
