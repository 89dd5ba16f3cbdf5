"""Sparsity attack: finds the descriptor in an affine subspace as a point with more zeros than chance allows.

Source: not in the paper.

Method:

1. The non-negative points of a subspace D form a polytope, and dim components are zero at a vertex. SIFT has a median of about 20
   zeros in 128 components, so the descriptor is a *degenerate* vertex: it has more than dim zeros.
2. A walk over vertices by linear programming finds degenerate vertices of unit norm (`bench/geometry/vertices.py`). Such a
   vertex does not occur by chance. It is the descriptor, or a word of the database that is as sparse.
3. `bench/geometry/candidates.py` selects one of them.

Knowledge: nothing beside the release. That descriptors are non-negative with many exact zeros is a public fact of the extractor.

Limits:

- A descriptor with at most dim zeros is no degenerate vertex and is never found. One with few more is often missed, since few
  objectives lead to it.
- The choice fails if words of the database are sparse, above all raw descriptors.
- If no vertex is found, the estimate is the direction of the point of D nearest to zero. It has a mean cosine with the descriptor
  of 0.83 to 0.63 for dim 2 to 16. The best other vertex is farther: 0.4 to 0.5 at any dimension.
- `lattice`, which uses the 8-bit grid, has none of these limits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.api import Defense, DescriptorAttack, Extractor, View
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.candidates import EQUAL_TOLERANCE, select_descriptors
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import guess_descriptors
from bench.geometry.vertices import find_unit_vertices
from bench.types import Floats, Indices, Subspaces

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Sparsity(DescriptorAttack):
    """Finds the descriptor as a point of its subspace with more zeros than chance allows."""

    accepts = (Subspaces,)

    pivots: int = 100  # steps of the walk over vertices, per dimension of the subspace
    ties: int = 4  # components equal to the maximum, at which the walk ends: SIFT clips at 0.2, a cluster centre does not

    def __post_init__(self) -> None:
        if self.pivots < 1:
            raise UserError(f"sparsity: pivots must be at least 1, got {self.pivots}")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        if not extractor.exact_zeros:
            return f"{self.name()} attacks descriptors with exact zeros; {extractor.name()} does not declare any"
        return None

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release = view.release
        if not isinstance(release, Subspaces):
            raise TypeError(f"sparsity attacks Subspaces, got {type(release).__name__}")
        estimates = guess_descriptors(release)  # (N, D)
        owners, rows = self.find_candidates(release, rng)
        best = select_descriptors(owners, rows, len(release))  # (N,)
        estimates[best >= 0] = rows[best[best >= 0]]
        return estimates

    def find_candidates(self, release: Subspaces, rng: np.random.Generator) -> tuple[Indices, Floats]:
        """Return the degenerate vertices of unit norm: (n,) the keypoint of each, and (n, D) the vertices."""

        def has_ties(x: Tensor) -> Tensor:
            return (x >= x.amax(dim=1, keepdim=True) - EQUAL_TOLERANCE).sum(dim=1) >= self.ties

        origins, bases = release.origins.astype(np.float64), release.bases.astype(np.float64)
        owners, points = find_unit_vertices(origins, bases, self.pivots * release.dim, has_ties, rng)
        return owners, unit_rows(points.astype(np.float32))


PLUGIN = Sparsity
