"""The nearest attack (Dusmanu et al., CVPR 2021; the paper's Table 1).

It replaces each subspace by its nearest neighbour in a public database, the attacker's own Z. In the defense's W the nearest
word would be an adversarial descriptor.
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
    """Estimates the descriptor by the public word nearest to the subspace."""

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
