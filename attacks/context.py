"""The context attack: finds the true word of a keypoint from the candidates of nearby keypoints. Not in the paper.

Wrong words are drawn uniformly from the dictionary, while true words fit the photograph at that position. The context model
(`bench/context`), trained on public photographs, computes the posterior of each candidate and of none. The prior follows from
the configuration of the defense. The model also predicts the descriptor for the case that the true word is none of the
candidates.
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
    """Weighs the candidates of each keypoint by the candidates of nearby keypoints."""

    accepts = (WordSets,)
    needs = frozenset({PublicAssets})

    # The likeliest candidate, or the posterior mean, which includes the predicted descriptor. The mean has the smaller angle, but
    # it is smoother than a descriptor, so the network for raw descriptors reconstructs a worse image from it.
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
