"""Lattice attack: finds the few 8-bit vectors in an affine subspace, one of which is the descriptor.

Source: not in the paper.

Method:

1. A subspace D is spanned by the descriptor, words of a database and random directions. The descriptor and the words are 8-bit
   vectors, scaled to unit norm. No other vector in D is, since the directions are random. `bench/geometry/lattice.py` finds all
   of them from the float32 release. A hybrid lifting has dim / 2 + 1 of these candidates, an adversarial one dim + 1, and a
   random one the descriptor alone.
2. `bench/geometry/candidates.py` selects the descriptor among the candidates. Only this choice is uncertain.

Knowledge: nothing beside the release. That descriptors are 8-bit vectors is a public fact of the extractor.

Limits of step 1:

- More random directions, a greater dimension or descriptors without zeros do not prevent the attack.
- Noise in the descriptor before the lifting prevents it: 1e-5 per component with the kernel's WEIGHT, and 1e-4 (a twentieth of
  an 8-bit unit) with every tested WEIGHT. The words are still found, and one of them is returned.
- A release in half precision prevents it with this WEIGHT, but not fully with a WEIGHT of 10^4: 29% were found at dim 2.
- If nothing is found, the estimate is the direction of the point of D nearest to zero.

Limits of step 2: with a database of centres of large clusters the choice is always right. With a database of raw descriptors, a
candidate is known to be a word only if it occurs twice in the photograph. An attacker with the database removes all of its words.
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
    """Finds the 8-bit vectors in a subspace, and selects the descriptor among them."""

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
