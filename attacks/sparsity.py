"""Sparsity, an attack that is in no paper: it knows nothing but that descriptors are non-negative with many exact zeros.

The points of D that are nowhere negative are a polytope, and a vertex of it is where dim components vanish. SIFT has a median
of about 20 zeros in 128, so that the secret is a *degenerate* vertex, where more vanish. Chance makes no such vertex of unit
norm: one that is found is the secret, or a word of the database that is as sparse (`bench/geometry/candidates.py` says which
is taken). A walk over vertices by linear programming finds them (`bench/geometry/vertices.py`).

Where it fails: at descriptors of dim zeros or fewer, which are no degenerate vertex; at those of few more, for few objectives
lead to them; and where words of the database are sparse as well, above all if they are raw descriptors. Where no vertex was
found, the estimate is the direction of D's point nearest to zero; the best vertex short of the secret is farther from it (a
mean cosine of 0.4 to 0.5 at any dimension, against 0.83 to 0.63 for dim 2 to 16). `lattice`, which uses the 8-bit grid, has
none of these limits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from bench.api import Defense, DescriptorAttack, Extractor, View
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.candidates import EQUAL, most_genuine
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import guesses
from bench.geometry.vertices import unit_vertices
from bench.types import Floats, Indices, Subspaces


@dataclass(frozen=True, kw_only=True)
class Sparsity(DescriptorAttack):
    """Finds the descriptor as the vertex where more components vanish than chance allows."""

    accepts = (Subspaces,)

    pivots: int = 100  # steps of the walk over vertices, for each dimension of the subspace
    ties: int = 4  # components equal to the greatest that end the walk: SIFT cuts at 0.2, a cluster's centre does not

    def __post_init__(self) -> None:
        if self.pivots < 1:
            raise UserError(f"sparsity: pivots must be at least 1, got {self.pivots}")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        if not extractor.exact_zeros:
            return f"{self.name()} attacks descriptors with exact zeros; {extractor.name()} does not declare that its have any"
        return None

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release = view.release
        if not isinstance(release, Subspaces):
            raise TypeError(f"sparsity attacks Subspaces, got {type(release).__name__}")
        estimates = guesses(release)  # (N, D)
        owners, rows = self.candidates(release, rng)
        best = most_genuine(owners, rows, len(release))  # (N,)
        estimates[best >= 0] = rows[best[best >= 0]]
        return estimates

    def candidates(self, release: Subspaces, rng: np.random.Generator) -> tuple[Indices, Floats]:
        """The degenerate vertices of unit norm that were found: (n,) the keypoint of each, and (n, D) unit norm."""

        def enough(x: Tensor) -> Tensor:
            return (x >= x.amax(dim=1, keepdim=True) - EQUAL).sum(dim=1) >= self.ties

        origins, bases = release.origins.astype(np.float64), release.bases.astype(np.float64)
        owners, points = unit_vertices(origins, bases, self.pivots * release.dim, enough, rng)
        return owners, unit_rows(points.astype(np.float32))


PLUGIN = Sparsity
