"""Keypoints attack: reconstructs the photograph from the positions of the keypoints alone.

Source: not in the paper.

Method: a network reconstructs the photograph from the positions. The result is the mean over the eight symmetries of a square.

Knowledge: a network trained on the positions of keypoints in public photographs.

Limits: positions are released in the clear, so their leakage does not depend on ε. The attack is the baseline of every defense
that releases them: an attack that recovers no more is no evidence about the descriptors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.api import Defense, Extractor, ImageAttack, View
from bench.codebook.public import ASSETS, Public
from bench.core.errors import UserError
from bench.inversion.symmetry import POSITION_SYMMETRIES
from bench.inversion.weights import Network, explain_other_features, load
from bench.settings import Asset
from bench.threat_model import PublicAssets
from bench.types import Descriptors, Floats, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Keypoints(ImageAttack):
    """Reconstructs the photograph from the positions of the keypoints alone."""

    accepts = (Descriptors, WordSets, Subspaces)
    needs = frozenset({PublicAssets})

    weights: Asset = Asset("shipped")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        networks = self._list_networks()
        if any(network.meta["encoding"] != "positions" for network in networks):
            return "that network reads descriptors; train one with `bench train --encoding positions`"
        if any(network.meta.get("model") for network in networks):
            return "that network samples photographs; train one with `bench train --encoding positions`"
        reasons = [explain_other_features(network.meta, extractor, public) for network in networks]
        return None if None in reasons else reasons[-1]

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        return {"weights": self._network(extractor, public).verify()}

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        from bench.inversion.reconstruct import reconstruct_image

        module = self._network(view.extractor, view.know(PublicAssets).assets).module
        return reconstruct_image(module, view.release, POSITION_SYMMETRIES, np.empty(0, np.float32), 0, "positions")

    def _network(self, extractor: Extractor, public: Public) -> Network:
        """Return the network for an extractor that `explain_incompatible` accepts."""
        return next(net for net in self._list_networks() if explain_other_features(net.meta, extractor, public) is None)

    def _list_networks(self) -> list[Network]:
        """Load the given network, or the shipped ones, that of SIFT last."""
        if self.weights != "shipped":
            return [load(Path(self.weights))]
        if not (paths := sorted(ASSETS.glob("positions*.safetensors"))):
            raise UserError("keypoints: the network is not installed; reinstall, or pass keypoints:weights=FILE")
        return [load(path) for path in paths]


PLUGIN = Keypoints
