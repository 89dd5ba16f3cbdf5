"""DIA, the direct inversion attack: reconstructs the photograph with a network trained for the defense.

Source: Dusmanu et al., CVPR 2021; the paper's Tables 1 and 4.

Method:

1. Encode each keypoint of the release: the descriptor, the m words, or the parameters of the subspace. The random origin and
   basis of a subspace are noise and no part of the encoding `invariant` (`bench/inversion/encoding.py`).
2. The network reconstructs the photograph from the encoded keypoints. For word sets, the context model of the attack `context`
   first computes the posterior of each candidate, and the network weighs the candidates by it.
3. If the extractor declares how descriptors change when the photograph is mirrored or rotated, repeat both steps for all eight
   symmetries and average the reconstructions.

Knowledge: a network trained on public photographs for that distribution of releases. With undefended descriptors the result is
the upper bound, the paper's row "Raw".

Limits: a network for another defense would make the defense look safe. So without a network for this defense the attack does not
apply.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.api import Defense, Extractor, ImageAttack, View
from bench.codebook.public import ASSETS, Public
from bench.context import weights as context
from bench.core.errors import UserError
from bench.inversion.symmetry import Symmetry, find_symmetries
from bench.inversion.weights import Network, find_network, load
from bench.settings import Asset
from bench.threat_model import PublicAssets
from bench.types import Descriptors, Floats, Release, Subspaces, WordSets

# File names of the shipped networks. As printed: the input is the words of a set, or origin and basis of a subspace, stacked.
SHIPPED = {"shipped": "inversion-*.safetensors", "shipped-as-printed": "as-printed-*.safetensors"}


@dataclass(frozen=True, kw_only=True)
class DIA(ImageAttack):
    """Reconstructs the photograph with a network trained for the defense."""

    accepts = (Descriptors, WordSets, Subspaces)
    needs = frozenset({PublicAssets})

    weights: Asset = Asset("shipped")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        return _choose(self.weights, defense, extractor, public)[1]

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        network = self._network(defense, extractor, public)
        if network.meta["encoding"] == "posteriors":
            _load_context(network).verify()
        return {"weights": network.verify()}  # its metadata have the digest of the context model

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        from bench.inversion.reconstruct import reconstruct_image

        public = view.know(PublicAssets).assets
        network = self._network(view.defense, view.extractor, public)
        symmetries = find_symmetries(view.extractor)
        if network.meta["encoding"] == "posteriors":
            return _weigh_and_reconstruct(network, view.release, view.defense, symmetries, public)
        settings = network.encode_settings(view.defense, public)
        return reconstruct_image(
            network.module, view.release, symmetries, settings, network.meta["slots"], network.meta["encoding"]
        )

    def _network(self, defense: Defense, extractor: Extractor, public: Public) -> Network:
        path, reason = _choose(self.weights, defense, extractor, public)
        if path is None:
            raise UserError(f"dia: {reason}")
        return load(path)


def _weigh_and_reconstruct(
    network: Network, release: Release, defense: Defense, symmetries: Sequence[Symmetry], public: Public
) -> Floats:
    """Reconstruct with the posteriors of the context model that the network was trained with."""
    from bench.context.encoding import prior_odds
    from bench.context.reconstruct import reconstruct_from_posteriors
    from bench.inversion.network import Inverter

    if not isinstance(release, WordSets) or not isinstance(network.module, Inverter):
        raise TypeError(f"{network.path} reads WordSets, got {type(release).__name__}")
    odds = prior_odds(defense, public, release.subset_size)
    return reconstruct_from_posteriors(network.module, _load_context(network).module, release, odds, symmetries)


def _load_context(network: Network) -> context.Network:
    """Load the context model that a network was trained with.

    Raises
    ------
    UserError
        if the installed one is another.
    """
    installed = context.load(ASSETS / "context.safetensors")
    if installed.digest != network.meta.get("context"):
        raise UserError(f"dia: {network.path} was trained with another context model than {installed.path}; reinstall")
    return installed


def _choose(asset: str, defense: Defense, extractor: Extractor, public: Public) -> tuple[Path | None, str | None]:
    """Return the path of the weights for these releases, or the reason why there are none."""
    path, details = find_network(asset, SHIPPED, defense, extractor, public)
    if path is not None:
        return path, None
    command = "bench train --encoding released" if asset == "shipped-as-printed" else "bench train"
    return None, f"no adapted attacker{details}; train one with `{command}` and pass dia:weights=FILE"


PLUGIN = DIA
