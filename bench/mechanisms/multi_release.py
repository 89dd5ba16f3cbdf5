"""Inference from several independent releases of the same features: common points of subspaces, and recurring words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from bench.geometry.intersections import orthonormalize
from bench.mechanisms.subset import log10_chance
from bench.types import Indices, Subspaces

Doubles = NDArray[np.float64]

BLOCK = 256  # keypoints at a time
PARALLEL = 1e-9  # sin² of the angle below which directions count as one: float32 turns them by 1e-7
NEGLIGIBLE = 1e-18  # states of a lower chance are skipped by `compute_success_chances`


def find_common_points(releases: Sequence[Subspaces]) -> Doubles:
    """Return for each keypoint the point of its first subspace nearest to its other subspaces, in least squares.

    Let p be the point of the first subspace nearest to zero and B its basis. The result is p + Bᵀ c, where c minimises
    Σ_t |(I − B_tᵀ B_t)(p + Bᵀ c − o_t)|²: a system of dim equations. If subspaces have a common direction, as two liftings with
    the same word do, the minimisers form a line or more. Then the one nearest to zero is returned; with one release that is p. So
    the result depends on the subspaces alone, not on their bases and origins.

    Parameters
    ----------
    releases : T releases of the same N keypoints, in the same order

    Returns
    -------
    (N, D) float64, not normalised
    """
    first, *others = releases
    points = np.empty(first.origins.shape)
    for start in range(0, len(first), BLOCK):
        rows = slice(start, start + BLOCK)
        B = orthonormalize(first.bases[rows].astype(np.float64))  # (n, dim, D)
        o = first.origins[rows].astype(np.float64)  # (n, D)
        p = o - _project_onto_span(B, o)
        gram = np.zeros((len(B), B.shape[1], B.shape[1]))  # (n, dim, dim)
        pull = np.zeros((len(B), B.shape[1]))  # (n, dim)
        for other in others:
            frame = orthonormalize(other.bases[rows].astype(np.float64))
            shared = B @ frame.transpose(0, 2, 1)  # (n, dim, dim) cosines between directions
            gram += np.eye(B.shape[1]) - shared @ shared.transpose(0, 2, 1)
            offset = other.origins[rows] - p
            pull += np.einsum("nid,nd->ni", B, offset - _project_onto_span(frame, offset))
        inverse = np.linalg.pinv(gram, rcond=PARALLEL, hermitian=True)
        points[rows] = p + np.einsum("nij,nj,nid->nd", inverse, pull, B)
    return points


def _project_onto_span(bases: Doubles, vectors: Doubles) -> Doubles:
    """Project each vector onto the span of its basis. (n, dim, D), (n, D) -> (n, D)"""
    return np.einsum("nid,ni->nd", bases, np.einsum("nid,nd->ni", bases, vectors))


def select_likeliest(words: Indices, rng: np.random.Generator) -> Indices:
    """Return the column of the word of greatest likelihood given T sets of the ω-subset mechanism.

    Pr(Z_1, ..., Z_T | v) is proportional to exp(ε |{t : v in Z_t}|), so this is the word in most of the sets. Ties are
    broken at random.

    Parameters
    ----------
    words : (N, T m) the sets of a keypoint side by side

    Returns
    -------
    (N,) columns
    """
    columns = words.shape[1]
    count = np.zeros(words.shape)
    for column in range(columns):
        count += words == words[:, column, None]
    # A word in c sets has c columns, as have the words that it ties with, so all of them are equally likely.
    return (count + rng.random(words.shape)).argmax(axis=1)


def compute_success_chances(epsilon: float, domain: int, size: int, releases: int) -> list[float]:
    """Return the chance that `select_likeliest` picks the true word of T = 1, ..., `releases` sets, by enumeration.

    A state consists of the number of sets with the true word, and the numbers of wrong words (of |K| − 1) in 1, 2, ... sets. A
    further set adds a hypergeometric draw. States with a chance below 1e-18 are skipped.

    Parameters
    ----------
    epsilon : nats, of one release
    domain : |K|
    size : m
    """
    inclusion = 10 ** log10_chance(epsilon, domain, size)
    states: dict[tuple[int, tuple[int, ...]], float] = {(0, (0,) * releases): 1.0}
    successes = []
    for _ in range(releases):
        after: dict[tuple[int, tuple[int, ...]], float] = {}
        for (true, wrong), chance in states.items():
            for u, weight in ((1, inclusion), (0, 1 - inclusion)):
                for following, likelihood in _enumerate_draws(wrong, domain - 1, size - u):
                    if (joint := chance * weight * likelihood) > NEGLIGIBLE:
                        state = true + u, following
                        after[state] = after.get(state, 0.0) + joint
        states = after
        successes.append(math.fsum(chance * _compute_pick_chance(*state) for state, chance in states.items()))
    return successes


def _compute_pick_chance(true: int, wrong: tuple[int, ...]) -> float:
    """Return the chance to pick the true word, in `true` sets, among the words in most sets; wrong[c - 1] others are in c."""
    if true == 0 or any(wrong[true:]):
        return 0.0
    return 1 / (1 + wrong[true - 1])


def _enumerate_draws(counts: tuple[int, ...], total: int, size: int) -> Iterator[tuple[tuple[int, ...], float]]:
    """Yield the number of words in 1, 2, ... sets after a further set with `size` of `total` words, and its chance."""
    classes = (total - sum(counts), *counts)
    for drawn in _enumerate_splits(classes, size):
        chance = math.prod(math.comb(have, take) for have, take in zip(classes, drawn, strict=True)) / math.comb(total, size)
        moved = (count - left + entered for count, left, entered in zip(counts, drawn[1:], drawn, strict=False))
        yield tuple(moved), chance


def _enumerate_splits(classes: tuple[int, ...], size: int) -> Iterator[tuple[int, ...]]:
    """Yield all ways to take `size` elements from classes of these sizes."""
    if not classes:
        if size == 0:
            yield ()
        return
    for take in range(min(classes[-1], size) + 1):
        yield from ((*rest, take) for rest in _enumerate_splits(classes[:-1], size - take))


def bound_success(epsilon: float, domain: int) -> float:
    """Return an upper bound of the success of any guess of a secret, uniform on `domain` values, from an ε-LDP release.

    A guess g has Σ_v Pr(z | v) ≥ Pr(z | g(z)) (1 + (|K| − 1) e^-ε) at each output z. Summed over z, the left side is |K|. So the
    chance of success is Σ_z Pr(z | g(z)) / |K| ≤ 1 / (1 + (|K| − 1) e^-ε). T releases compose to T ε.
    """
    return 1 / (1 + (domain - 1) * math.exp(-epsilon))
