"""Generative attack: samples photographs given the release, by conditional flow matching.

Source: Lipman et al., ICLR 2023, for flow matching. The use on releases of features is ours; work on privacy of visual
localization uses conditional diffusion likewise.

Method (`bench/inversion/flow.py`):

1. Encode each keypoint of the release as `dia` does, and scatter the embeddings to a grid of cells of 4 x 4 pixels. Add the
   reconstruction of the network of `dia`, the draft, if the network was trained with drafts.
2. Start at Gaussian noise and follow a learned velocity to a photograph, in `steps` steps: of Heun's method, the last
   one of Euler's.
3. With `guidance` w, the velocity is u + w (v - u), for the velocity v given the release and the velocity u of the prior.
4. Return the mean of `samples` samples.

A regression network answers uncertainty by blur. A sample is one photograph that may have this release. The mean of many samples
estimates the posterior mean, which blurs all that the release does not determine. Guidance 0 does not read the release: its
samples are those of the prior, a control.

Knowledge: a network trained on public photographs for that distribution of releases.

Limits: as those of `dia`. It does not read hidden positions. The choice of the best sample would need the photograph, so no field
offers it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from bench.api import Defense, Extractor, ImageAttack, View
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.inversion.weights import SHIPPED as DRAFTS
from bench.inversion.weights import AdaptedNetworks, Network, find_network, load
from bench.settings import Asset
from bench.threat_model import PublicAssets
from bench.types import Descriptors, Floats, Subspaces, WordSets

if TYPE_CHECKING:
    from torch import Tensor

SHIPPED = {"shipped": "flow-*.safetensors"}
UNUSED = "unused"  # in records: drafts of a network that reads none


@dataclass(frozen=True, kw_only=True)
class Generative(ImageAttack):
    """Samples photographs given the release with a network trained for the defense, and returns their mean."""

    accepts = (Descriptors, WordSets, Subspaces)
    needs = frozenset({PublicAssets})

    weights: Asset = Asset("shipped")
    drafts: Asset = Asset("shipped")  # a network for drafts, if `weights` was trained with another than that of `dia`
    samples: int = 1
    steps: int = 12  # of the solver, with two evaluations of the velocity each, the last one with one
    guidance: float = 1.0  # 0: the prior; 1: the posterior; more: images that are likelier for this release than for others

    def __post_init__(self) -> None:
        if self.samples < 1 or self.steps < 1:
            raise UserError(f"generative: samples and steps must be at least 1, got {self.samples} and {self.steps}")
        if not (self.guidance >= 0 and math.isfinite(self.guidance)):
            raise UserError(f"generative: guidance must be finite and at least 0, got {self.guidance}")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        networks, releases = self._networks(), (defense, extractor, public)
        return networks.explain_missing(*releases) or self._explain_other_drafts(networks.load(*releases), *releases)

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        from bench.context.drafts import Drafter

        network = self._networks().load(defense, extractor, public)
        reads_drafts = bool(network.meta.get("drafts"))
        drafts = Drafter(self.drafts, extractor).digest(defense, public) if reads_drafts else UNUSED
        return {"weights": network.verify(), "drafts": drafts}

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        return self.sample(view, rng).mean(axis=0, dtype=np.float32)

    def sample(self, view: View, rng: np.random.Generator) -> Floats:
        """Return the samples. -> (samples, H, W, 3) float32 in [0, 1]"""
        from bench.inversion.encoding import encode
        from bench.inversion.flow import FlowNetwork, sample_images

        public = view.know(PublicAssets).assets
        network = self._networks().load(view.defense, view.extractor, public)
        settings, module = network.encode_settings(view.defense, public), network.module
        assert isinstance(module, FlowNetwork)  # by the metadata
        points = encode([view.release], [settings], network.meta["slots"], network.meta["encoding"])
        if network.meta.get("drafts") and self.guidance > 0:  # the prior reads no draft
            points = replace(points, drafts=self._draft(view, public))
        images = sample_images(module, points, self.samples, self.steps, self.guidance, rng)
        return images.permute(0, 2, 3, 1).cpu().numpy()

    def _draft(self, view: View, public: Public) -> Tensor:
        """Return the reconstruction that the network reads. -> (1, 3, H, W)"""
        import torch

        from bench.context.drafts import Drafter

        image = Drafter(self.drafts, view.extractor)(view.defense, view.release, public)
        return torch.from_numpy(image).permute(2, 0, 1)[None]

    def _explain_other_drafts(self, network: Network, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        """Return the reason why there are no drafts as the network was trained with; None if there are, or it reads none."""
        digests, name = network.meta.get("drafts"), network.path.name
        if not digests:
            return None if self.drafts in (*DRAFTS, UNUSED) else f"{name} reads no drafts; omit generative:drafts"
        path, details = find_network(self.drafts, DRAFTS, defense, extractor, public)
        if path is None:
            return f"{name} reads drafts, and no network makes them{details}; pass one with generative:drafts=FILE"
        if load(path).digest == digests.get(defense.name()):
            return None
        return f"{name} reads drafts of another network than {path.name}; pass that one with generative:drafts=FILE"

    def _networks(self) -> AdaptedNetworks:
        return AdaptedNetworks(self.name(), self.weights, SHIPPED, model="flow")


PLUGIN = Generative
