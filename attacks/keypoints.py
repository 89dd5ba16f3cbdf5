"""Keypoints: inverts the positions alone, the honest zero line of every defense that releases them.

Positions are released in the clear, so what this attack sees has leaked before any epsilon says something.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.api import Asset, Defense, Extractor, ImageAttack, View
from bench.codebook.public import ASSETS, Public
from bench.core.errors import UserError
from bench.inversion.reconstruct import painted
from bench.inversion.symmetry import OF_POSITIONS
from bench.inversion.weights import Network, load, other_features
from bench.types import Descriptors, Floats, Knowledge, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Keypoints(ImageAttack):
    """Paints the photograph from the keypoints' positions alone."""

    accepts = (Descriptors, WordSets, Subspaces)
    needs = frozenset({Knowledge.TRAINING_IMAGES})

    weights: Asset = Asset("shipped")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        network = self._network()
        if network.meta["encoding"] != "positions":
            return "that network reads descriptors; `bench train --encoding positions` makes one that does not"
        return other_features(network.meta, extractor, public)

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        return {"weights": self._network().digest}

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        return painted(self._network().module, view.release, OF_POSITIONS, np.empty(0, np.float32), 0, "positions")

    def _network(self) -> Network:
        if self.weights != "shipped":
            return load(Path(self.weights))
        path = ASSETS / "positions.safetensors"
        if not path.is_file():
            raise UserError("keypoints: its network is not part of this installation; reinstall, or name a file")
        return load(path)


PLUGIN = Keypoints
