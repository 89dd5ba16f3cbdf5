"""Points of affine subspaces that are multiples of an integer vector, by lattice reduction (Lenstra, Lenstra, Lovász 1982).

The linear span L of an affine subspace D has k = dim + 1 dimensions. A random direction in L has no integer vector of moderate
length. If L is given with a relative error of 10^-6, the existing integer vectors can be found, as follows. k components y of a
vector x in L determine the others: x = M y. Let M' be e rows of M. The rows of [I, λ M'] and [0, λ I] span a lattice. Integer
vectors x of L are short vectors of this lattice, with a length of about |x|. A random lattice has a shortest length of about
λ^(e / (k + e)).

Such a vector is x = f y, with y in D and f linear on L. It is a multiple of a unit vector of D if |x| = f. All such x up to a
given length are enumerated (Fincke, Pohst 1985). In the form |x|² - β f², with β their mean cosine, they are nearly orthogonal.
So a basis that is reduced in that form often consists of them, and few combinations must be tried.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bench.geometry.nearest_words import unit_rows
from bench.geometry.pivoting import select_independent_rows
from bench.types import Floats, Indices, Subspaces

Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]

BATCH = 256  # subspaces at a time
WEIGHT = 1e6  # λ: float32 leaves errors of 1e-6 to 5e-5 in an integer vector's components
INTEGRAL = 0.01  # a component this near to an integer counts as an integer
MARGIN = 2.0  # factor by which random short vectors must be longer
SLACK = 1.25  # factor by which vectors of a basis may be longer than the searched ones
ROUNDS = 4  # number of reductions; each uses the components that were fractional after the previous one
FINENESS = 64.0  # of the grid to which bases are rounded; rounding errors add up over k components of up to 255
DEFINITE = 0.999  # of the greatest β for which |x|² - β f² is positive
ON_SPHERE = 1e-6  # greatest ||x| - f| / |x|; float32 leaves 1e-7
MAX_SHORT_VECTORS = 1e6  # expected number of short vectors above which a lattice is skipped


def find_unit_integer_points(release: Subspaces, longest: float) -> tuple[Indices, Floats]:
    """Return all points of each subspace that are non-negative, of unit norm, and a multiple of an integer vector.

    Parameters
    ----------
    release : in float32; half precision is too coarse for WEIGHT
    longest : greatest norm of the integer vectors

    Returns
    -------
    (n,) the keypoint of each, and (n, D) the points
    """
    owners, rows = [np.empty(0, dtype=np.int64)], [np.empty((0, release.origins.shape[1]), dtype=np.float32)]
    for start in range(0, len(release), BATCH):
        block = slice(start, start + BATCH)
        # The last column of Q is the direction of the point of D nearest to zero, at the distance R[-1, -1].
        columns = np.concatenate([release.bases[block].transpose(0, 2, 1), release.origins[block, :, None]], axis=2)
        spans, triangles = np.linalg.qr(columns.astype(np.float64))  # (b, D, dim + 1)
        levels = spans[:, :, -1] / triangles[:, -1, -1:]  # (b, D) f
        lattices = find_integer_vectors(spans, longest)
        ranks = np.array([len(basis) for basis in lattices])
        for rank in np.unique(ranks[ranks > 0]):
            members = np.flatnonzero(ranks == rank)
            owner, x = _select_on_sphere(np.stack([lattices[i] for i in members]).astype(np.float64), levels[members], longest)
            owners.append(members[owner] + start)
            rows.append(unit_rows(x.astype(np.float32)))
    return np.concatenate(owners), np.concatenate(rows)


def find_integer_vectors(spans: Doubles, longest: float) -> list[Integers]:
    """Return bases of the integer vectors in linear subspaces. (N, D, k) orthonormal columns -> N arrays (q, D), q <= k

    A basis is complete if its vectors need not be longer than SLACK · longest. Each subspace is one call of FLINT: 0.03 ms at
    k = 3, 6 ms at k = 17.
    """
    length, k = spans.shape[1:]
    free = select_independent_rows(spans)  # (N, k)
    inverse = np.linalg.inv(np.take_along_axis(spans, free[:, :, None], axis=1))  # (N, k, k)
    maps = spans @ inverse  # (N, D, k) M
    leverage = np.square(maps).sum(axis=2)  # (N, D)
    np.put_along_axis(leverage, free, -1.0, axis=1)
    # In n components, an integer vector has about longest √(n / D), the shortest random vector √(n / 2πe) λ^(e / n).
    chance = math.log(MARGIN * longest * math.sqrt(2 * math.pi * math.e / length))
    extra = min(length - k, math.ceil(k * chance / (math.log(WEIGHT) - chance)) + 1)
    informative = np.argsort(-leverage, axis=1)[:, :extra]  # (N, e) components that depend most on y
    return [_solve_integer_lattice(m, rows, longest) for m, rows in zip(maps, informative, strict=True)]


def enumerate_short_vectors(grams: Doubles, bounds: Doubles) -> tuple[Indices, Integers]:
    """Return all integer c with cᵀ G c <= bound, for many lattices.

    Parameters
    ----------
    grams : (N, q, q) positive definite; the search is fast for LLL-reduced bases
    bounds : (N,)

    Returns
    -------
    (n,) the lattice of each, and (n, q) its coefficients; zero and both signs are included.
    """
    lower = np.linalg.cholesky(grams)  # (N, q, q): cᵀ G c = Σ_i (L_ii c_i + Σ_{j > i} L_ji c_j)²
    count, q = grams.shape[:2]
    owners = np.arange(count)
    coefficients = np.zeros((count, q), dtype=np.int64)
    left = bounds.astype(np.float64)
    for i in reversed(range(q)):
        scale = lower[owners, i, i]
        centre = -np.einsum("nj,nj->n", coefficients[:, i + 1 :], lower[owners, i + 1 :, i]) / scale
        reach = np.sqrt(np.maximum(left, 0.0)) / scale
        first = np.ceil(centre - reach).astype(np.int64)
        branches = np.maximum(np.floor(centre + reach).astype(np.int64) - first + 1, 0)
        parent = np.repeat(np.arange(len(owners)), branches)
        rank = np.arange(len(parent)) - np.repeat(np.cumsum(branches) - branches, branches)
        value = first[parent] + rank
        left = left[parent] - np.square(scale[parent] * (value - centre[parent]))
        owners, coefficients = owners[parent], coefficients[parent]
        coefficients[:, i] = value
    return owners, coefficients


def reduce_basis(basis: Doubles) -> Doubles:
    """Return the LLL-reduced rows of a basis, rounded to multiples of 1 / FINENESS. (n, c) -> (n, c)"""
    from flint import fmpz_mat

    rows, columns = basis.shape
    short = fmpz_mat(rows, columns, np.rint(FINENESS * basis).astype(np.int64).ravel().tolist()).lll()
    return np.array([float(entry) for entry in short.entries()]).reshape(basis.shape) / FINENESS


def _solve_integer_lattice(m: Doubles, rows: Indices, longest: float) -> Integers:
    """Return a basis of the integer vectors x = M y of one subspace. (D, k), (e,) -> (q, D)"""
    y = np.eye(m.shape[1])
    for _ in range(ROUNDS):
        y = _reduce_to_short(y, m[rows], SLACK * longest)
        x = y @ m.T  # (r, D)
        off = np.abs(x - np.rint(x))
        if off.max(initial=0.0) < INTEGRAL:
            return np.rint(x).astype(np.int64)
        # Some vectors are integral only in the selected components, such as one divided by a common factor of those.
        rows = np.argsort(-off.max(axis=0))[: len(y) + 1]
    return np.empty((0, len(m)), dtype=np.int64)


def _reduce_to_short(y: Doubles, m: Doubles, bound: float) -> Doubles:
    """Return vectors of the lattice of y for which M y is nearly integral and no longer than the bound. (r, k), (e, k)"""
    (r, k), e = y.shape, len(m)
    basis = np.zeros((r + e, k + e))
    basis[:r, :k], basis[:r, k:], basis[r:, k:] = y, WEIGHT * (y @ m.T), WEIGHT * np.eye(e)
    short = reduce_basis(basis)  # (r + e, k + e)
    vectors = short[np.linalg.norm(short, axis=1) <= bound, :k]
    return vectors[vectors.any(axis=1)]


def _select_on_sphere(bases: Doubles, levels: Doubles, longest: float) -> tuple[Indices, Doubles]:
    """Return the integer combinations that are non-negative and multiples of unit vectors of D.

    (n, q, D), (n, D) -> (c,) indices into n, and (c, D)
    """
    rank = bases.shape[1]
    f = np.einsum("nqd,nd->nq", bases, levels)
    grams = bases @ bases.transpose(0, 2, 1)  # (n, q, q)
    # The affine hull of q unit vectors of one cosine c is at the squared distance c + (1 - c) / q from zero; solved for c.
    near = 1 / np.einsum("nq,nq->n", f, np.linalg.solve(grams, f[:, :, None])[:, :, 0])
    beta = np.clip(near - (1 - near) / max(rank - 1, 1), 0.0, DEFINITE * np.minimum(near, 1.0))
    forms = grams - beta[:, None, None] * f[:, :, None] * f[:, None, :]
    change = np.stack([_reduce_form(form) for form in forms])  # (n, q, q)
    bases, f = change @ bases, np.einsum("npq,nq->np", change, f)
    forms = change @ forms @ change.transpose(0, 2, 1)
    bounds = (1 - beta) * longest**2
    few = np.flatnonzero(_estimate_count(forms, bounds) <= MAX_SHORT_VECTORS)
    owner, coefficients = enumerate_short_vectors(forms[few], bounds[few])
    owner = few[owner]
    x = np.einsum("cq,cqd->cd", coefficients.astype(np.float64), bases[owner])
    level = np.einsum("cq,cq->c", coefficients.astype(np.float64), f[owner])
    norm = np.linalg.norm(x, axis=1)
    good = (level > 0) & (x.min(axis=1, initial=0.0) >= 0) & (np.abs(norm - level) <= ON_SPHERE * norm)
    return owner[good], x[good]


def _reduce_form(form: Doubles) -> Doubles:
    """Return the change of basis that reduces a positive definite form. (q, q) -> (q, q)"""
    rank = len(form)
    return reduce_basis(np.concatenate([np.linalg.cholesky(form), np.eye(rank)], axis=1))[:, rank:]


def _estimate_count(forms: Doubles, bounds: Doubles) -> Doubles:
    """Return the expected number of vectors within `bounds`: ball volume / lattice cell volume. (n, q, q), (n,) -> (n,)"""
    rank = forms.shape[1]
    ball = rank / 2 * math.log(math.pi) - math.lgamma(rank / 2 + 1)
    return np.exp(ball + rank / 2 * np.log(bounds) - np.linalg.slogdet(forms)[1] / 2)
