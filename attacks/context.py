"""Context: which candidate of a keypoint is the true word, told by the candidates around it. In no paper that we follow.

Wrong words are drawn from the whole dictionary alike, true ones fit what the photograph shows there. A network that was trained
on public photographs (`surroundings/`) gives each candidate its posterior chance, and the chance that it is none of them, which
the defense's configuration sets beforehand, as well as the descriptor to be expected then.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from bench.api import Asset, Defense, DescriptorAttack, Extractor, View
from bench.codebook.public import ASSETS, Public
from bench.context.encoding import prior_odds, scene
from bench.context.network import Belief
from bench.context.weights import Network, load
from bench.inversion.weights import misfit
from bench.types import Floats, Knowledge, WordSets

ESTIMATES = {"word": Belief.word, "mean": Belief.mean}


@dataclass(frozen=True, kw_only=True)
class Context(DescriptorAttack):
    """Weighs the candidates of each keypoint by those of the keypoints around it."""

    accepts = (WordSets,)
    needs = frozenset({Knowledge.TRAINING_IMAGES})

    # The likeliest candidate, or the posterior mean, in which what is expected where it is none of them has its share. The mean
    # has the smaller angle; but it is smooth as no descriptor is, and what the network for raw descriptors paints of it is worse.
    estimate: Literal["word", "mean"] = "word"
    weights: Asset = Asset("shipped")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        reason = misfit(self._network().meta, defense, extractor, public)
        return reason and f"no adapted attacker: {self._path().name} was {reason}"

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        return {"weights": self._network().digest}

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release = view.release
        if not isinstance(release, WordSets):
            raise TypeError(f"context attacks WordSets, got {type(release).__name__}")
        module = self._network().module
        odds = prior_odds(view.defense, view.know(Knowledge.TRAINING_IMAGES), release.subset_size)
        seen = scene([release], [odds], module.shape.neighbours)
        with torch.inference_mode():
            seen = seen.to(next(module.parameters()).device)
            found = ESTIMATES[self.estimate](module(seen), seen.candidates)
        return found.cpu().numpy()

    def _path(self) -> Path:
        return ASSETS / "context.safetensors" if self.weights == "shipped" else Path(self.weights)

    def _network(self) -> Network:
        return load(self._path())


PLUGIN = Context
