"""Lattice, an attack that is in no paper: it knows nothing but that descriptors are 8-bit vectors, scaled to unit norm.

D was made from the secret, from words of a database and from random directions. The secret and the words are multiples of
8-bit vectors; nothing else in D is, for the directions are random. `bench/geometry/lattice.py` finds all of them from the
release's float32: the descriptor and the adversarial words, dim / 2 + 1 candidates for a hybrid lifting, dim + 1 for an
adversarial one, and for a random one the descriptor alone. Neither the random directions nor the dimension are a hindrance,
and zeros are not needed.

Which candidate is the descriptor is left to tell (`bench/geometry/candidates.py`), and is all that such a lifting hides. A
database of centres of large clusters hides nothing. Of raw descriptors, only those are known that come twice in a photograph.
An attacker who has the database need not guess: he strikes out its words.

What stops it is noise in the descriptor before it is lifted: of 1e-5 in each component with the kernel's WEIGHT, of 1e-4 (a
twentieth of an 8-bit unit) with every WEIGHT that was tried. A release in half precision stops this one, but at a WEIGHT of
10^4 not all (29% were found at dim 2). The words are found even then, and one of them is returned. Where nothing is found,
the estimate is the direction of D's point nearest to zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import Defense, DescriptorAttack, Extractor, View
from bench.codebook.public import Public
from bench.geometry.candidates import most_genuine
from bench.geometry.lattice import unit_integer_points
from bench.geometry.subspaces import guesses
from bench.types import Floats, Subspaces


@dataclass(frozen=True, kw_only=True)
class Lattice(DescriptorAttack):
    """Finds the descriptor as one of the few integer vectors of its subspace."""

    accepts = (Subspaces,)

    longest: float = 520.0  # norm of an 8-bit descriptor at most; SIFT scales its own to 512, and rounds

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        if extractor.eight_bit:
            return None
        return f"{self.name()} attacks 8-bit descriptors; {extractor.name()} does not declare that its are"

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release = view.release
        if not isinstance(release, Subspaces):
            raise TypeError(f"lattice attacks Subspaces, got {type(release).__name__}")
        estimates = guesses(release)  # (N, D)
        owners, rows = unit_integer_points(release, self.longest)
        best = most_genuine(owners, rows, len(release))  # (N,)
        estimates[best >= 0] = rows[best[best >= 0]]
        return estimates


PLUGIN = Lattice
