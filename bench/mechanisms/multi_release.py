"""What several independent releases of the same features tell together: where subspaces meet, and which word recurs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from bench.geometry.intersections import orthonormal
from bench.mechanisms.subset import log10_chance
from bench.types import Indices, Subspaces

Doubles = NDArray[np.float64]

BLOCK = 256  # keypoints at a time
PARALLEL = 1e-9  # sin² of the angle between directions that count as one: float32 turns them by 1e-7
NEGLIGIBLE = 1e-18  # the chance of a state that `chances_of_success` leaves out


def common_points(releases: Sequence[Subspaces]) -> Doubles:
    """For each keypoint the point of its first subspace that is nearest to its other ones, in the sense of least squares.

    With p the point of the first subspace nearest to zero and B its basis, c minimises Σ_t |(I − B_tᵀ B_t)(p + Bᵀ c − o_t)|²,
    which is a system of dim equations. Where subspaces share a direction (two liftings that drew the same word do), the points
    that minimise it form a line or more, and the one nearest to zero is returned; with one release alone that is p. So what is
    returned depends on the subspaces alone, not on the bases and origins that describe them.

    Parameters
    ----------
    releases : T subspaces of each of N keypoints, in one order

    Returns
    -------
    (N, D) float64, of the norm that it has
    """
    first, *others = releases
    found = np.empty(first.origins.shape)
    for start in range(0, len(first), BLOCK):
        rows = slice(start, start + BLOCK)
        B = orthonormal(first.bases[rows].astype(np.float64))  # (n, dim, D)
        o = first.origins[rows].astype(np.float64)  # (n, D)
        p = o - _within(B, o)
        gram = np.zeros((len(B), B.shape[1], B.shape[1]))  # (n, dim, dim)
        pull = np.zeros((len(B), B.shape[1]))  # (n, dim)
        for other in others:
            frame = orthonormal(other.bases[rows].astype(np.float64))
            shared = B @ frame.transpose(0, 2, 1)  # (n, dim, dim) cosines between directions
            gram += np.eye(B.shape[1]) - shared @ shared.transpose(0, 2, 1)
            offset = other.origins[rows] - p
            pull += np.einsum("nid,nd->ni", B, offset - _within(frame, offset))
        inverse = np.linalg.pinv(gram, rcond=PARALLEL, hermitian=True)
        found[rows] = p + np.einsum("nij,nj,nid->nd", inverse, pull, B)
    return found


def _within(bases: Doubles, vectors: Doubles) -> Doubles:
    """The part of each vector that lies in the span of its basis. (n, dim, D), (n, D) -> (n, D)"""
    return np.einsum("nid,ni->nd", bases, np.einsum("nid,nd->ni", bases, vectors))


def likeliest(words: Indices, rng: np.random.Generator) -> Indices:
    """The column of a word that has the greatest likelihood given T sets of the ω-subset mechanism.

    Pr(Z_1, ..., Z_T | v) is proportional to exp(ε |{t : v in Z_t}|), so it is the word that stands in most of the sets. Of
    several, one is drawn at random.

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
    # A word that stands in c sets has c columns, and so have those that it ties with: each is as likely to be drawn.
    return (count + rng.random(words.shape)).argmax(axis=1)


def chances_of_success(epsilon: float, domain: int, size: int, releases: int) -> list[float]:
    """The chance that `likeliest` picks the true word of T = 1, ..., `releases` sets, by enumeration.

    A state is the number of sets that hold the true word, and how many of the |K| − 1 others stand in 1, 2, ... sets. What a
    further set adds to it is hypergeometric. States of a chance below 1e-18 are left out.

    Parameters
    ----------
    epsilon : nats, of one release
    domain : |K|
    size : m
    """
    told = 10 ** log10_chance(epsilon, domain, size)
    states: dict[tuple[int, tuple[int, ...]], float] = {(0, (0,) * releases): 1.0}
    successes = []
    for _ in range(releases):
        after: dict[tuple[int, tuple[int, ...]], float] = {}
        for (true, others), chance in states.items():
            for u, weight in ((1, told), (0, 1 - told)):
                for drawn, share in _draws(others, domain - 1, size - u):
                    if (joint := chance * weight * share) > NEGLIGIBLE:
                        state = true + u, drawn
                        after[state] = after.get(state, 0.0) + joint
        states = after
        successes.append(math.fsum(chance * _picked(*state) for state, chance in states.items()))
    return successes


def _picked(true: int, others: tuple[int, ...]) -> float:
    """The chance that the true word, in `true` sets, is drawn among the words in most sets; others[c - 1] wrong ones are in c."""
    if true == 0 or any(others[true:]):
        return 0.0
    return 1 / (1 + others[true - 1])


def _draws(others: tuple[int, ...], wrong: int, size: int) -> Iterator[tuple[tuple[int, ...], float]]:
    """How many words stand in 1, 2, ... sets after a further one has drawn `size` of the `wrong`, and each outcome's chance."""
    classes = (wrong - sum(others), *others)
    for drawn in _shares(classes, size):
        chance = math.prod(math.comb(have, take) for have, take in zip(classes, drawn, strict=True)) / math.comb(wrong, size)
        moved = (count - left + entered for count, left, entered in zip(others, drawn[1:], drawn, strict=False))
        yield tuple(moved), chance


def _shares(classes: tuple[int, ...], size: int) -> Iterator[tuple[int, ...]]:
    """All ways to take `size` from classes that hold so many."""
    if not classes:
        if size == 0:
            yield ()
        return
    for take in range(min(classes[-1], size) + 1):
        yield from ((*rest, take) for rest in _shares(classes[:-1], size - take))


def bound_on_success(epsilon: float, domain: int) -> float:
    """The greatest chance that any guess can have at a secret that is uniform on `domain` values, seen through ε-LDP.

    For a guess g, Σ_v Pr(z | v) ≥ Pr(z | g(z)) (1 + (|K| − 1) e^-ε) at each output z. Both sides summed over z, the left gives
    |K|, and the chance of success is Σ_z Pr(z | g(z)) / |K| ≤ 1 / (1 + (|K| − 1) e^-ε). T releases compose to T ε.
    """
    return 1 / (1 + (domain - 1) * math.exp(-epsilon))
