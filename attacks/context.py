"""Context attack: finds the true word of a keypoint by the candidates of nearby keypoints.

Source: not in the paper.

Method:

1. The configuration of the defense gives the prior probability that a candidate is the true word.
2. The context model (`bench/context`) computes the posterior of each candidate, and of the case that none is true. Wrong words
   are uniform over the dictionary, whereas true words fit the photograph at that position.
3. The model also predicts the descriptor for the case that no candidate is true.
4. The estimate is the likeliest candidate, or the posterior mean (`estimate`).

Knowledge: a network trained on public photographs for that defense, extractor and dictionary.

Limits: without such a network the attack does not apply.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from bench.api import Defense, DescriptorAttack, Extractor, View
from bench.codebook.public import ASSETS, Public
from bench.context.weights import Network, load
from bench.inversion.weights import explain_incompatible
from bench.settings import Asset
from bench.threat_model import PublicAssets
from bench.types import Floats, WordSets


@dataclass(frozen=True, kw_only=True)
class Context(DescriptorAttack):
    """Computes the probability of each candidate word from the candidates of nearby keypoints."""

    accepts = (WordSets,)
    needs = frozenset({PublicAssets})

    # The likeliest candidate, or the posterior mean, which includes the predicted descriptor. The mean has the smaller angle. It
    # is smoother than a descriptor, so the network for raw descriptors reconstructs a worse image from it.
    estimate: Literal["word", "mean"] = "word"
    weights: Asset = Asset("shipped")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        reason = explain_incompatible(self._network().meta, defense, extractor, public)
        return reason and f"no adapted attacker: {self._path().name} was {reason}"

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        return {"weights": self._network().verify()}

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        import torch

        from bench.context.encoding import build_graph, prior_odds
        from bench.context.network import Belief

        release = view.release
        if not isinstance(release, WordSets):
            raise TypeError(f"context attacks WordSets, got {type(release).__name__}")
        module = self._network().module
        odds = prior_odds(view.defense, view.know(PublicAssets).assets, release.subset_size)
        graph = build_graph([release], [odds], module.shape.neighbours)
        with torch.inference_mode():
            graph = graph.to(next(module.parameters()).device)
            estimates = getattr(Belief, self.estimate)(module(graph), graph.candidates)
        return estimates.cpu().numpy()

    def _path(self) -> Path:
        return ASSETS / "context.safetensors" if self.weights == "shipped" else Path(self.weights)

    def _network(self) -> Network:
        return load(self._path())


PLUGIN = Context
