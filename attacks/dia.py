"""DIA, the direct inversion attack: reconstructs the photograph with a network trained for the defense.

Source: Dusmanu et al., CVPR 2021; the paper's Tables 1 and 4.

Method:

1. Encode each keypoint of the release: the descriptor, the m words, or the parameters of the subspace. The random origin and
   basis of a subspace are noise and no part of the encoding `invariant` (`bench/inversion/encoding.py`).
2. The network reconstructs the photograph from the encoded keypoints. For word sets, the context model of the attack `context`
   first computes the posterior of each candidate, and the network weighs the candidates by it. The posterior is the geometric
   mean of those in two symmetries of step 3.
3. If the extractor declares how descriptors change when the photograph is mirrored or rotated, encode and reconstruct in all
   eight symmetries, with the same posterior, and average the reconstructions.

Knowledge: a network trained on public photographs for that distribution of releases. With undefended descriptors the result is
the upper bound, the paper's row "Raw".

Limits: a network for another defense would make the defense look safe. So without a network for this defense the attack does not
apply.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bench.api import Defense, Extractor, ImageAttack, View
from bench.codebook.public import Public
from bench.inversion.symmetry import find_symmetries
from bench.inversion.weights import SHIPPED, AdaptedNetworks
from bench.settings import Asset
from bench.threat_model import PublicAssets
from bench.types import Descriptors, Floats, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class DIA(ImageAttack):
    """Reconstructs the photograph with a network trained for the defense."""

    accepts = (Descriptors, WordSets, Subspaces)
    needs = frozenset({PublicAssets})

    weights: Asset = Asset("shipped")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        return self._networks().explain_missing(defense, extractor, public)

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        from bench.context.reconstruct import verify

        return {"weights": verify(self._networks().load(defense, extractor, public))}

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        from bench.context.reconstruct import reconstruct_release

        public = view.know(PublicAssets).assets
        network = self._networks().load(view.defense, view.extractor, public)
        return reconstruct_release(network, view.release, view.defense, find_symmetries(view.extractor), public)

    def _networks(self) -> AdaptedNetworks:
        return AdaptedNetworks(self.name(), self.weights, SHIPPED)


PLUGIN = DIA
