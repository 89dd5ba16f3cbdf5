"""Nearest attack: replaces each affine subspace by the nearest word of a public database.

Source: Dusmanu et al., CVPR 2021; the paper's Table 1.

Method: the estimate is the word of Z with the smallest distance to the subspace.

Knowledge: Z, a public database of the attacker's own.

Limits: the defense's database W would not help. The word of W nearest to a subspace is an adversarial descriptor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import DescriptorAttack, View
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import find_nearest_to_subspaces
from bench.settings import Asset
from bench.threat_model import PublicDatabase
from bench.types import Floats, Subspaces


@dataclass(frozen=True, kw_only=True)
class Nearest(DescriptorAttack):
    """Replaces each subspace by the public word nearest to it."""

    accepts = (Subspaces,)
    needs = frozenset({PublicDatabase})

    database: Asset = Asset("shipped-public")

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release = view.release
        if not isinstance(release, Subspaces):
            raise TypeError(f"nearest attacks Subspaces, got {type(release).__name__}")
        words = view.know(PublicDatabase).words  # (K, D)
        nearest, _ = find_nearest_to_subspaces(release, words)  # (N, 1)
        return unit_rows(words[nearest[:, 0]])


PLUGIN = Nearest
