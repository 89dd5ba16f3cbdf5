"""Drafts: reconstructions by a network of `dia`, which a network that samples photographs reads beside the release.

A draft has what a network for regression knows of the release, also from the posteriors of the context model. It is made in one
pass, without the mean over symmetries.
"""

from __future__ import annotations

from dataclasses import dataclass

from bench.api import Defense, Extractor
from bench.codebook.public import Public
from bench.context.reconstruct import reconstruct_release, verify
from bench.core.errors import UserError
from bench.inversion.symmetry import IDENTITY
from bench.inversion.weights import SHIPPED, Network, find_network, load
from bench.settings import Asset
from bench.types import Floats, Release


@dataclass(frozen=True)
class Drafter:
    """Makes drafts by a network for the releases of a defense."""

    network: Asset  # a file, or "shipped": the network of `dia`
    extractor: Extractor

    def digest(self, defense: Defense, public: Public) -> str:
        """Verify the network for the releases of a defense, and return its digest.

        Raises
        ------
        UserError
            if there is none, or a file does not match its metadata.
        """
        return verify(self._load(defense, public))

    def __call__(self, defense: Defense, release: Release, public: Public) -> Floats:
        """Return the draft of a release. -> (H, W, 3) in [0, 1]"""
        return reconstruct_release(self._load(defense, public), release, defense, [IDENTITY], public)

    def _load(self, defense: Defense, public: Public) -> Network:
        path, details = find_network(self.network, SHIPPED, defense, self.extractor, public)
        if path is None:
            advice = "train one with `bench train`, and pass it with --drafts FILE"
            raise UserError(f"no network makes drafts for {defense.name()}{details}; {advice}")
        return load(path)
