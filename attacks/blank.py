"""Blank attack: returns the best constant image, whatever the release.

Source: not in the paper.

Method: all pixels have the mean colour of public photographs, which is the constant of least squared error over them.

Knowledge: the mean colour of public photographs.

Limits: the attack ignores the release, so its score is that of no information. It is the baseline of every defense: an attack
that scores no more shows no leakage.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bench.api import Defense, Extractor, ImageAttack, View
from bench.codebook.public import Public
from bench.identification import distractors
from bench.threat_model import PublicAssets
from bench.types import Descriptors, Floats, Positions, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Blank(ImageAttack):
    """Returns the best constant image, whatever the release."""

    accepts = (Descriptors, WordSets, Subspaces)
    accepts_positions = (Positions,)
    needs = frozenset({PublicAssets})

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        return {"colour": distractors.DIGEST}

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        width, height = view.release.size
        return np.tile(distractors.load_distractors().mean_colour(), (height, width, 1))  # (H, W, 3)


PLUGIN = Blank
