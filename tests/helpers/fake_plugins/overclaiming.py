"""A defense that claims an ε and does not satisfy it."""

from dataclasses import dataclass

import numpy as np

from bench.api import Defense, Privacy
from bench.codebook.public import Public
from bench.settings import Asset
from bench.types import Descriptors, Features, Points


@dataclass(frozen=True, kw_only=True)
class Overclaiming(Defense):
    """Releases the nearest word."""

    releases = Descriptors

    dictionary: Asset = Asset("shipped")

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        words = public.dictionary(self.dictionary).words[public.nearest_words(self.dictionary, secret)].astype(np.float32)
        words /= np.linalg.norm(words, axis=1, keepdims=True)
        return Descriptors(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, descriptors=words)

    def privacy(self, public: Public) -> Privacy:
        return Privacy("epsilon-ldp", 2.0)


PLUGIN = Overclaiming
