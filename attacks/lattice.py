"""The lattice attack: uses only that descriptors are 8-bit vectors, scaled to unit norm. Not in the paper.

D contains the secret, words of a database and random directions. The secret and the words are multiples of 8-bit vectors. No
other vector in D is, since the directions are random. `bench/geometry/lattice.py` finds all of them from the float32 release:
the descriptor and the adversarial words. These are dim / 2 + 1 candidates for a hybrid lifting, dim + 1 for an adversarial one,
and the descriptor alone for a random one. Neither random directions nor the dimension prevent this, and zeros are not needed.

`bench/geometry/candidates.py` then selects the descriptor among the candidates; only this choice is uncertain. With a database
of centres of large clusters it is always right. With one of raw descriptors, it is known only for words that occur twice in a
photograph. An attacker with the database need not guess: they remove its words.

Noise in the descriptor before the lifting prevents the attack: 1e-5 per component with the kernel's WEIGHT, 1e-4 (a twentieth
of an 8-bit unit) with every tested WEIGHT. A release in half precision prevents it with this WEIGHT, but with a WEIGHT of 10^4
not fully (29% were found at dim 2). The words are still found, and one of them is returned. If nothing is found, the estimate
is the direction of the point of D nearest to zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import Defense, DescriptorAttack, Extractor, View
from bench.codebook.public import Public
from bench.geometry.candidates import select_descriptors
from bench.geometry.lattice import find_unit_integer_points
from bench.geometry.subspaces import guess_descriptors
from bench.types import Floats, Subspaces


@dataclass(frozen=True, kw_only=True)
class Lattice(DescriptorAttack):
    """Finds the descriptor as one of the few integer vectors of its subspace."""

    accepts = (Subspaces,)

    longest: float = 520.0  # maximum norm of an 8-bit descriptor; SIFT scales to 512 and rounds

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        if extractor.eight_bit:
            return None
        return f"{self.name()} attacks 8-bit descriptors; {extractor.name()} does not declare 8-bit descriptors"

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release = view.release
        if not isinstance(release, Subspaces):
            raise TypeError(f"lattice attacks Subspaces, got {type(release).__name__}")
        estimates = guess_descriptors(release)  # (N, D)
        owners, rows = find_unit_integer_points(release, self.longest)
        best = select_descriptors(owners, rows, len(release))  # (N,)
        estimates[best >= 0] = rows[best[best >= 0]]
        return estimates


PLUGIN = Lattice
