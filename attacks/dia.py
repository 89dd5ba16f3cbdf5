"""DIA, the direct inversion attack (Dusmanu et al., CVPR 2021; the paper's Tables 1 and 4).

A network paints the photograph from the release. What is released for a keypoint is stacked: the descriptor itself (the upper
bound, "Raw"), the m words, or the parameters of a subspace (not its random origin and basis, which are noise: `encoding.py`). The
network must have been trained for that very distribution of releases; another defense's would make a defense look safe. It paints
eight times, of what the photograph mirrored and turned would have released, where the extractor tells that; the mean is shown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.api import Asset, Defense, Extractor, ImageAttack, View
from bench.codebook.public import ASSETS, Public
from bench.core.errors import UserError
from bench.inversion.encoding import condition
from bench.inversion.reconstruct import painted
from bench.inversion.symmetry import symmetries
from bench.inversion.weights import Network, load, misfit
from bench.types import Descriptors, Floats, Knowledge, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class DIA(ImageAttack):
    """Paints the photograph with a network trained for that very defense."""

    accepts = (Descriptors, WordSets, Subspaces)
    needs = frozenset({Knowledge.TRAINING_IMAGES})

    weights: Asset = Asset("shipped")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        return _choose(self.weights, defense, extractor, public)[1]

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        return {"weights": self._network(defense, extractor, public).digest}

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        network = self._network(view.defense, view.extractor, view.know(Knowledge.TRAINING_IMAGES))
        known = condition(view.defense, network.served)
        seen = symmetries(view.extractor)
        return painted(network.module, view.release, seen, known, network.meta["slots"], network.meta["encoding"])

    def _network(self, defense: Defense, extractor: Extractor, public: Public) -> Network:
        path, reason = _choose(self.weights, defense, extractor, public)
        if path is None:
            raise UserError(f"dia: {reason}")
        return load(path)


def _choose(asset: str, defense: Defense, extractor: Extractor, public: Public) -> tuple[Path | None, str | None]:
    """The weights to use, or why there are none."""
    candidates = sorted(ASSETS.glob("inversion-*.safetensors")) if asset == "shipped" else [Path(asset)]
    reasons = []
    for path in candidates:
        meta = load(path).meta
        reason = misfit(meta, defense, extractor, public)
        if reason is None:
            return path, None
        if asset != "shipped" or meta["defense"]["name"] == defense.name():
            reasons.append(f"{path.name} was {reason}")
    told = f" ({'; '.join(reasons)})" if reasons else ""
    return None, f"no adapted attacker{told}; `bench train` makes one, and dia:weights=FILE uses it"


PLUGIN = DIA
