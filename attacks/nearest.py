"""Nearest (Dusmanu et al., CVPR 2021; the paper's Table 1).

Each subspace is replaced by its nearest neighbour in a public database. That is the attacker's own Z: in the defense's W the
nearest would be an adversarial descriptor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import Asset, DescriptorAttack, View
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import nearest_to_subspaces
from bench.types import Floats, Knowledge, Subspaces


@dataclass(frozen=True, kw_only=True)
class Nearest(DescriptorAttack):
    """Takes the public word nearest to each subspace for the descriptor."""

    accepts = (Subspaces,)
    needs = frozenset({Knowledge.PUBLIC_DATABASE})

    database: Asset = Asset("shipped-public")

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release = view.release
        if not isinstance(release, Subspaces):
            raise TypeError(f"nearest attacks Subspaces, got {type(release).__name__}")
        words = view.know(Knowledge.PUBLIC_DATABASE).words  # (K, D)
        nearest, _ = nearest_to_subspaces(release, words)  # (N, 1)
        return unit_rows(words[nearest[:, 0]])


PLUGIN = Nearest
