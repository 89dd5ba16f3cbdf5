"""Affine subspace lifting: hides each descriptor in a random affine subspace, which may also contain words of a database.

Source: Dusmanu et al., CVPR 2021; the paper's Sec. 3.

Method:

1. Draw one of the sub-databases of W for the photograph.
2. Choose dim directions for each descriptor d. A direction is d_i = a_i − d for a word a_i of the sub-database, or
   d_i ~ U([-1, 1])^n. The words of one keypoint are distinct and are called its adversarial descriptors. The field `lifting` sets
   their number: none ("random"), dim / 2 ("hybrid") or dim ("adversarial").
3. The subspace is D = d + span(d_1, ..., d_dim).
4. Release a new origin and a new basis of D, which are functions of D and of random vectors alone.

Guarantee: none. D contains d and the words, which the attacks `database`, `lattice` and others find.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from bench.api import LiftedRelease, Lifting, Privacy
from bench.codebook.public import Public
from bench.core.errors import SampleError, UserError
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.subset import draw_distinct
from bench.settings import Asset, Between, OneOf
from bench.types import Features, Floats, Indices, Points, Subspaces, Words

Doubles = NDArray[np.float64]

# A direction adds no dimension if at most this fraction of its length lies outside the span of the earlier directions.
DEGENERATE_FRACTION = 1e-6
MAX_DRAWS = 100


@dataclass(frozen=True, kw_only=True)
class Affine(Lifting):
    """Releases a random affine subspace that contains the descriptor and, unless lifting=random, words of a database.

    The adversarial words of a photograph come from one randomly drawn sub-database. The words of one keypoint are distinct.
    """

    supported_settings: ClassVar[Mapping[str, Between | OneOf]] = {"dim": OneOf((2, 4, 6, 8, 10, 12, 14, 16))}

    lifting: Literal["random", "adversarial", "hybrid"] = "hybrid"  # none, all or half of the directions lead to words
    dim: int = 4  # dimension of the subspace
    sub_databases: int = 16  # number of parts of the database, one of which a photograph uses
    database: Asset = Asset("shipped")

    def __post_init__(self) -> None:
        if self.lifting not in ("random", "adversarial", "hybrid"):
            raise UserError(f"affine: lifting must be random, adversarial or hybrid, got {self.lifting}")
        if self.dim < 1:
            raise UserError(f"affine: dim must be at least 1, got {self.dim}")
        if self.lifting == "hybrid" and self.dim % 2:
            raise UserError(f"affine: dim must be even with lifting=hybrid, got {self.dim}")
        if self.sub_databases < 1:
            raise UserError(f"affine: sub_databases must be at least 1, got {self.sub_databases}")

    @property
    def adversarial(self) -> int:
        return {"random": 0, "hybrid": self.dim // 2, "adversarial": self.dim}[self.lifting]

    def lift(self, secret: Features, public: Public, rng: np.random.Generator) -> LiftedRelease:
        length = secret.descriptors.shape[1]
        if self.dim >= length:
            raise UserError(f"affine: dim must be below the descriptors' length, {length}, got {self.dim}")
        first, words = self._draw_sub_database(secret, public, rng)
        d = secret.descriptors.astype(np.float64)  # (N, D)
        span, indices = lift(d, words, self.adversarial, self.dim, rng)  # (N, dim, D), (N, adversarial)
        origins, bases = reparameterise(d, span, rng)
        release = Subspaces(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, origins=origins, bases=bases)
        return LiftedRelease(release=release, words=first + indices)

    def privacy(self, public: Public) -> Privacy:
        return Privacy("none")

    def _draw_sub_database(self, secret: Features, public: Public, rng: np.random.Generator) -> tuple[int, Words]:
        """Draw the sub-database of a photograph. Returns its first row in the database, and its words (S, D)."""
        if self.adversarial == 0:
            return 0, np.empty((0, secret.descriptors.shape[1]), dtype=np.uint8)
        database = public.dictionary(self.database)
        database.check_suits(secret.exact, self.database)
        smallest = len(database) // self.sub_databases
        if smallest < self.adversarial:
            raise UserError(
                f"affine: {self.adversarial} words per keypoint, but {len(database)} words in {self.sub_databases} "
                f"sub-databases leave {smallest} each"
            )
        part = int(rng.integers(self.sub_databases))
        return database.start(part, self.sub_databases), database.sub_database(part, self.sub_databases)


def lift(d: Doubles, words: Words, adversarial: int, dim: int, rng: np.random.Generator) -> tuple[Doubles, Indices]:
    """Draw the directions of each subspace. Returns orthonormal bases of their span, and the indices of the words.

    If the directions span fewer than `dim` dimensions, all of them are drawn again. An example is a word that equals the
    descriptor.

    Parameters
    ----------
    d : (N, D) descriptors
    words : (S, D) of the sub-database

    Returns
    -------
    (N, dim, D) and (N, adversarial)

    Raises
    ------
    SampleError
        if MAX_DRAWS draws fail: the sub-database has too few words that differ from the descriptor.
    """
    rows, length = d.shape
    span = np.empty((rows, length, dim))
    indices = np.empty((rows, adversarial), dtype=np.int64)
    waiting = np.arange(rows)
    for _ in range(MAX_DRAWS):
        directions = np.empty((len(waiting), dim, length))
        indices[waiting] = draw_distinct(len(waiting), len(words), adversarial, rng)
        a = unit_rows(words[indices[waiting]])  # (waiting, adversarial, D)
        directions[:, :adversarial] = a - d[waiting, None]
        directions[:, adversarial:] = rng.uniform(-1, 1, (len(waiting), dim - adversarial, length))
        lengths = np.linalg.norm(directions, axis=2)  # (waiting, dim)
        span[waiting], triangle = np.linalg.qr(directions.transpose(0, 2, 1))
        gains = np.abs(np.diagonal(triangle, axis1=1, axis2=2))  # (waiting, dim) distance to the span of the earlier directions
        waiting = waiting[(gains <= DEGENERATE_FRACTION * lengths).any(axis=1)]
        if len(waiting) == 0:
            return span.transpose(0, 2, 1), indices
    raise SampleError(f"affine: a descriptor lies in the span of every draw of {adversarial} words of its sub-database")


def reparameterise(d: Doubles, span: Doubles, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return a new origin and a new orthonormal basis of D = d + span. -> (N, D), (N, dim, D)

    With random vectors e_i ~ U([-1, 1])^n, the origin is the projection of e_0 onto D. The basis is the projection of e_1,
    ..., e_dim onto the directions of D, orthonormalised. Both depend on D and the e_i alone, because a projection onto D does
    not depend on the point and the basis that describe D.
    """
    rows, dim, length = span.shape
    e = rng.uniform(-1, 1, (rows, 1 + dim, length))
    e[:, 0] -= d
    coordinates = e @ span.transpose(0, 2, 1)  # (N, 1 + dim, dim) of the projections in `span`
    origins = d + (coordinates[:, :1] @ span)[:, 0]
    mixing, triangle = np.linalg.qr(coordinates[:, 1:].transpose(0, 2, 1))  # (N, dim, dim) twice
    # LAPACK's signs depend on `span` and would reveal on which side of D the secret lies. Gram-Schmidt's signs do not.
    mixing *= np.sign(np.diagonal(triangle, axis1=1, axis2=2))[:, None]
    bases = mixing.transpose(0, 2, 1) @ span
    return origins.astype(np.float32), bases.astype(np.float32)


PLUGIN = Affine
