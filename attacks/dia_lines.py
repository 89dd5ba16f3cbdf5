"""DIA for hidden positions: a network trained for the defense locates keypoints on their lines, and reconstructs the photograph.

Source: ours. The direct inversion is that of `dia`, the idea that neighbours reveal positions that of `neighbourhood`.

Method (`bench/inversion/line_network.py`):

1. Each line gives sample points. The network computes the posterior of the keypoint over the samples of its line, from the
   descriptors and the lines of all keypoints.
2. The estimated position is the sample with the least expected truncated distance.
3. The network reconstructs the photograph from the descriptors at their likeliest samples.
4. If the extractor declares how descriptors change when the photograph is mirrored or rotated, average the posteriors and the
   reconstructions over all eight symmetries.

Knowledge: a network trained on public photographs for that distribution of releases.

Limits: as those of `dia`. Of permuted coordinates, the network reads the lines alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.api import Defense, Extractor, ImageAttack, PositionAttack, View
from bench.codebook.public import Public
from bench.inversion.symmetry import find_symmetries
from bench.inversion.weights import AdaptedNetworks
from bench.settings import Asset
from bench.threat_model import PublicAssets
from bench.types import Descriptors, Floats, Subspaces, WordSets

SHIPPED = {"shipped": "line-inversion*.safetensors"}


@dataclass(frozen=True, kw_only=True)
class DIALines(PositionAttack, ImageAttack):
    """Locates keypoints on their lines and reconstructs the photograph with a network trained for the defense."""

    accepts = (Descriptors, WordSets, Subspaces)
    needs = frozenset({PublicAssets})

    weights: Asset = Asset("shipped")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        return self._networks().explain_missing(defense, extractor, public)

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        return {"weights": self._networks().load(defense, extractor, public).verify()}

    def locate(self, view: View, rng: np.random.Generator) -> Floats:
        from bench.inversion.reconstruct import locate_keypoints

        return locate_keypoints(*self._list_inputs(view))

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        from bench.inversion.reconstruct import reconstruct_image

        return reconstruct_image(*self._list_inputs(view))

    def _list_inputs(self, view: View) -> tuple[Any, ...]:
        """Return the network, the release, its symmetries, and the settings of the encoding."""
        public = view.know(PublicAssets).assets
        network = self._networks().load(view.defense, view.extractor, public)
        settings = network.encode_settings(view.defense, public)
        encoding = settings, network.meta["slots"], network.meta["encoding"]
        return network.module, view.release, find_symmetries(view.extractor), *encoding

    def _networks(self) -> AdaptedNetworks:
        return AdaptedNetworks(self.name(), self.weights, SHIPPED)


PLUGIN = DIALines
