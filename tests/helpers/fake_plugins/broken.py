"""A defense with a mistake in it."""

from dataclasses import dataclass

import numpy as np

from bench.api import Defense, Privacy
from bench.codebook.public import Public
from bench.types import Descriptors, Features


@dataclass(frozen=True, kw_only=True)
class Broken(Defense):
    """Fails at every photograph."""

    releases = Descriptors

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        raise TypeError("unsupported operand")

    def privacy(self, public: Public) -> Privacy:
        return Privacy("none")


PLUGIN = Broken
