"""Integer vectors of a real subspace, by lattice reduction (Lenstra, Lenstra, Lovász 1982), and all short vectors of a lattice
(Fincke, Pohst 1985).

A k-dimensional subspace of R^D that is known to `NOISE` of an integer vector's unit is over-determined by it: k of its components,
y, fix the others, x = M y, and that all of those be integers is far more than chance allows. The rows of [I, λ M'], [0, λ I], with
M' some rows of M, span a lattice in which such vectors are the short ones: about |x|, where chance gives λ^(e / (k + e)) for e rows.
"""

from __future__ import annotations

import math

import numpy as np
from flint import fmpz_mat
from numpy.typing import NDArray

from bench.kernels.pivoting import independent_rows

Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]

WEIGHT = 1e6  # λ: one over what float32 leaves of a component's fraction, about 1e-6 to 5e-5
INTEGRAL = 0.01  # a component this near to an integer is one
SLACK = 1.25  # a reduced basis has vectors longer than the shortest
ROUNDS = 4  # reductions, each with the components that the last left fractional
FINENESS = 64.0  # of the grid that real bases are rounded to before they are reduced


def integer_vectors(spans: Doubles, longest: float) -> list[Integers]:
    """Bases of the lattices of integer vectors in subspaces.

    Parameters
    ----------
    spans : (N, D, k) orthonormal columns
    longest : norm up to which vectors are sought; a lattice's basis is complete if its reduced vectors are no longer than twice that

    Returns
    -------
    N arrays (q, D), q from 0 to k. One call of the LLL algorithm a subspace: 0.05 ms at k = 3, 10 ms at k = 17.
    """
    count, length, k = spans.shape
    free = independent_rows(spans)  # (N, k)
    inverse = np.linalg.inv(np.take_along_axis(spans, free[:, :, None], axis=1))  # (N, k, k)
    maps = spans @ inverse  # (N, D, k) M
    leverage = np.square(maps).sum(axis=2)  # (N, D)
    np.put_along_axis(leverage, free, -1.0, axis=1)
    extra = min(length - k, math.ceil(0.75 * k) + 1)
    telling = np.argsort(-leverage, axis=1)[:, :extra]  # (N, e) a component that hardly depends on y tells little
    return [_integral(m, rows, longest) for m, rows in zip(maps, telling, strict=True)]


def reduced(basis: Doubles) -> Integers:
    """LLL-reduce the rows of a basis, rounded to integers. (n, c) -> (n, c)"""
    entries = np.rint(basis).astype(np.int64).ravel().tolist()
    short = fmpz_mat(*basis.shape, entries).lll()
    return np.array([int(entry) for entry in short.entries()], dtype=np.int64).reshape(basis.shape)


def short_vectors(grams: Doubles, bounds: Doubles) -> tuple[Integers, Integers]:
    """All integer c with cᵀ G c <= bound, of many lattices at once.

    Parameters
    ----------
    grams : (N, q, q) positive definite, of LLL-reduced bases if it is to be quick
    bounds : (N,)

    Returns
    -------
    (n,) the lattice that each vector is of, ascending, and (n, q) its coefficients; zero and both signs are among them.
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
        owners, coefficients = owners[parent], coefficients[parent]
        coefficients[:, i] = value
        left = left[parent] - np.square(scale[parent] * (value - centre[parent]))
    return owners, coefficients


def _integral(m: Doubles, rows: NDArray[np.intp], longest: float) -> Integers:
    """The integer vectors x = M y of one subspace. (D, k), (e,) -> (q, D)"""
    y = np.eye(m.shape[1])
    for _ in range(ROUNDS):
        y = _short(y, m[rows], SLACK * longest)
        x = y @ m.T  # (r, D)
        off = np.abs(x - np.rint(x))
        if off.max(initial=0.0) < INTEGRAL:
            return np.rint(x).astype(np.int64)
        # Vectors that are whole only where they were asked to be, such as an integer vector divided by what those components share.
        rows = np.argsort(-off.max(axis=0))[: len(y) + 1]
    return np.empty((0, len(m)), dtype=np.int64)


def _short(y: Doubles, m: Doubles, bound: float) -> Doubles:
    """Of the lattice that y spans, a basis of what makes M y nearly integer and is no longer than the bound. (r, k), (e, k)"""
    (r, k), e = y.shape, len(m)
    basis = np.zeros((r + e, k + e))
    basis[:r, :k], basis[:r, k:], basis[r:, k:] = y, WEIGHT * (y @ m.T), WEIGHT * np.eye(e)
    short = reduced(basis).astype(np.float64)  # (r + e, k + e)
    found = short[np.linalg.norm(short, axis=1) <= bound, :k]
    return found[found.any(axis=1)]
