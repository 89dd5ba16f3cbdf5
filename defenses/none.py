"""No defense: the upper bound of every attack, the paper's rows "Raw"."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.plugin import Defense, Privacy
from bench.public import Public
from bench.types import Descriptors, Features


@dataclass(frozen=True, kw_only=True)
class Undefended(Defense):
    """Releases the descriptors as they are."""

    releases = Descriptors

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        return Descriptors(keypoints=secret.keypoints.copy(), size=secret.size, descriptors=secret.descriptors.copy())

    def privacy(self, public: Public) -> Privacy:
        return Privacy("none")


PLUGIN = Undefended
