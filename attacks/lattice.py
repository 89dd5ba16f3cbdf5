"""Lattice, an attack that is in no paper: it needs no knowledge but that descriptors are 8-bit vectors scaled to unit norm.

The linear span L of D has dim + 1 dimensions. The secret's 8-bit vector lies in L, and so do those of the adversarial words, where
the database is 8-bit too; beside their combinations no integer vector of moderate length does, for a random direction has none. Three
steps find them all:

1. Lattice reduction gives a basis of the integer vectors of L. It drops the random half of a hybrid lifting: dim + 1 dimensions
   become dim / 2 + 1.
2. A multiple x of a point of D, x = f y with y in D, is that of a unit vector if |x| = f, where f is linear on L. Such x are
   enumerated. In the form |x|² - β f² they are nearly orthogonal to each other, if β is about the words' mean cosine: reduced by
   that form, the basis often consists of them, and few combinations must be tried.
3. What is nowhere negative among them is the descriptor and the words: dim / 2 + 1 candidates for a hybrid lifting, dim + 1 for an
   adversarial one, and the descriptor alone for a random one. `candidates.py` says which is taken.

Float32 tells a component to about 1e-5 of an integer's unit, and 0.75 k + 1 of those suffice. A release that says much less (half
precision, noise of 1e-3 in the descriptor before it is lifted) is safe from this attack. Where no candidate is found, the estimate is
the direction of the point of D nearest to zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.kernels.candidates import most_genuine
from bench.kernels.lattice import integer_vectors, reduced, short_vectors
from bench.kernels.search import unit_rows
from bench.kernels.subspaces import feet
from bench.plugin import Defense, DescriptorAttack, Extractor, View
from bench.public import Public
from bench.types import Floats, Indices, Subspaces

Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]

BATCH = 256  # subspaces at a time
FINENESS = 64.0  # of the grid on which the second form is reduced
ON_SPHERE = 1e-6  # of ||x| - f| / |x|: float32 leaves 1e-7
MOST = 1e6  # expected number of short vectors above which a lattice is given up


@dataclass(frozen=True, kw_only=True)
class Lattice(DescriptorAttack):
    """Finds the descriptor as one of the few integer vectors of its subspace."""

    accepts = (Subspaces,)

    longest: float = 520.0  # norm of an 8-bit descriptor at most; SIFT scales its own to 512, and then rounds

    def unsuited(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        if not extractor.eight_bit:
            return f"{self.name()} attacks 8-bit descriptors; those of {extractor.name()} are not declared to be"
        return None

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release = view.release
        if not isinstance(release, Subspaces):
            raise TypeError(f"lattice attacks Subspaces, got {type(release).__name__}")
        estimates = feet(release)  # (N, D)
        owners, rows = candidates(release, self.longest)
        best = most_genuine(owners, rows, len(release))  # (N,)
        estimates[best >= 0] = rows[best[best >= 0]]
        return estimates


def candidates(release: Subspaces, longest: float) -> tuple[Indices, Floats]:
    """All points of each D that are nowhere negative, of unit norm, and multiples of an integer vector no longer than `longest`.

    Returns
    -------
    (n,) the keypoint of each, and (n, D) unit norm
    """
    owners, rows = [np.empty(0, dtype=np.int64)], [np.empty((0, release.origins.shape[1]), dtype=np.float32)]
    for start in range(0, len(release), BATCH):
        block = slice(start, start + BATCH)
        # The last column of Q is the direction of D's point nearest to zero, at distance R[-1, -1].
        columns = np.concatenate([release.bases[block].transpose(0, 2, 1), release.origins[block, :, None]], axis=2)
        spans, triangles = np.linalg.qr(columns.astype(np.float64))  # (b, D, dim + 1)
        levels = spans[:, :, -1] / triangles[:, -1, -1:]  # (b, D) f
        bases = integer_vectors(spans, longest)
        ranks = np.array([len(basis) for basis in bases])
        for rank in np.unique(ranks[ranks > 0]):
            members = np.flatnonzero(ranks == rank)
            owner, x = _on_sphere(np.stack([bases[i] for i in members]).astype(np.float64), levels[members], longest)
            owners.append(members[owner] + start)
            rows.append(unit_rows(x))
    return np.concatenate(owners), np.concatenate(rows)


def _on_sphere(bases: Doubles, levels: Doubles, longest: float) -> tuple[Indices, Doubles]:
    """Integer combinations that are multiples of unit vectors of D. (n, q, D), (n, D) -> (c,) which of the n, (c, D)"""
    rank = bases.shape[1]
    f = np.einsum("nqd,nd->nq", bases, levels)
    grams = bases @ bases.transpose(0, 2, 1)  # (n, q, q)
    # Of points of unit norm and one cosine c, the affine hull is at the squared distance c + (1 - c) / q from zero.
    near = 1 / np.einsum("nq,nq->n", f, np.linalg.solve(grams, f[:, :, None])[:, :, 0])
    beta = np.maximum(near - (1 - near) / (rank - 1), 0.0) if rank > 1 else np.zeros(len(bases))
    forms = grams - beta[:, None, None] * f[:, :, None] * f[:, None, :]
    change = np.stack([_reduction(form) for form in forms])  # (n, q, q)
    bases, f = change @ bases, np.einsum("npq,nq->np", change, f)
    forms = change @ forms @ change.transpose(0, 2, 1)
    bounds = (1 - beta) * longest**2
    few = _expected(forms, bounds) <= MOST
    owner, coefficients = short_vectors(forms[few], bounds[few])
    owner = np.flatnonzero(few)[owner]
    x = np.einsum("cq,cqd->cd", coefficients.astype(np.float64), bases[owner])
    level = np.einsum("cq,cq->c", coefficients.astype(np.float64), f[owner])
    norm = np.linalg.norm(x, axis=1)
    good = (level > 0) & (x.min(axis=1) >= 0) & (np.abs(norm - level) <= ON_SPHERE * norm)
    return owner[good], x[good]


def _reduction(form: Doubles) -> Integers:
    """The change of basis that reduces a positive definite form. (q, q) -> (q, q)"""
    rank = len(form)
    return reduced(np.concatenate([FINENESS * np.linalg.cholesky(form), np.eye(rank)], axis=1))[:, rank:]


def _expected(forms: Doubles, bounds: Doubles) -> Doubles:
    """Volume of the ball of squared radius `bounds` over that of a cell. (n, q, q), (n,) -> (n,)"""
    rank = forms.shape[1]
    ball = rank / 2 * math.log(math.pi) - math.lgamma(rank / 2 + 1)
    return np.exp(ball + rank / 2 * np.log(bounds) - np.linalg.slogdet(forms)[1] / 2)


PLUGIN = Lattice
