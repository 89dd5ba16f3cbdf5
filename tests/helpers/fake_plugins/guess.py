"""Guesses the middle of each subspace, or the first word of each set."""

from dataclasses import dataclass

import numpy as np

from bench.api import DescriptorAttack, View
from bench.geometry.nearest_words import unit_rows
from bench.types import Floats, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Guess(DescriptorAttack):
    """Returns the first candidate of each keypoint."""

    accepts = (WordSets, Subspaces)

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release = view.release
        if isinstance(release, WordSets):
            return release.candidates[:, 0].copy()
        assert isinstance(release, Subspaces)
        return unit_rows(release.origins)


PLUGIN = Guess
