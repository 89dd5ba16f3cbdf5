"""Intersections of affine subspaces: two subspaces with a common descriptor have distance zero and intersect in it.

For D1 = {o1 + B1ᵀ c1} and D2 = {o2 + B2ᵀ c2} with orthonormal bases, put δ = o2 − o1 and G = B1 [B2ᵀ, δ]. The least squares over
c1 leave the quadratic form S = [[I, B2 δ], [(B2 δ)ᵀ, |δ|²]] − Gᵀ G of (c2, 1); eliminating c2 from it leaves dist(D1, D2)².

All pairs are screened in float32 after a projection onto dim + dim' + 16 fixed directions. A projection increases no distance, so
intersecting pairs still intersect. Other pairs stay apart in the 16 extra directions. The remaining pairs are decided in float64
and in all dimensions. Two subspaces intersect if their distance is within the errors of their release (`estimate_errors`).
Float32 releases of one descriptor have a distance of about 1e-7, other pairs of a tenth or more.

Floor, for a pair of equal dimensions: 2 (dim + 1)² (2 dim + 16) operations of a matrix product, dim (dim + 1)² + (dim + 1)³ / 3
multiply-adds of the elimination. The latter take most of the time; pairs are contiguous in memory, so each step is a long loop.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.core.device import pick_device
from bench.core.errors import UserError
from bench.types import Indices, Subspaces

if TYPE_CHECKING:
    from torch import Tensor

Doubles = NDArray[np.float64]

INTERSECTION_DISTANCE = 1e-5  # below this distance two subspaces intersect, whatever the errors of their release
LARGEST_TOLERANCE = 0.05  # errors are not assumed to be larger: pairs that do not intersect have .08 or more
SPARE_DIRECTIONS = 16  # directions beyond those that two subspaces span
NEAR = 4e-4  # squared distance that passes the screening beside the errors; its error is about 2e-5 for points of unit norm
SINGULAR = 1e-9  # squared sine below which two directions are equal; common ones have about 1e-13 in bases orthonormal to 1e-14
NEARLY_ORTHONORMAL = 1e-6  # largest excess of B Bᵀ that one Newton step removes; float32 has 1e-7
PIVOT = 1e-6  # least divisor, for pairs that share a direction
BLOCK = 600_000  # numbers in the quadratic forms of a block of pairs, which then fit into the cache
ROWS = 8  # subspaces of the first side in a block
EXACT = 1024  # pairs decided at a time


@dataclass(frozen=True, eq=False)
class SubspaceIntersections:
    """P pairs of intersecting subspaces."""

    first: Indices  # (P,) rows of the first release
    second: Indices  # (P,) rows of the second release
    points: Doubles  # (P, D) midpoints of the nearest points of the two
    single: NDArray[np.bool_]  # (P,) whether the intersection is a single point, not a line or more
    tolerances: Doubles  # (P,) distance of the two that their errors allow

    def __len__(self) -> int:
        return len(self.first)

    def take(self, rows: NDArray[Any]) -> SubspaceIntersections:
        """Return the pairs selected by `rows`: indices, or a mask."""
        return SubspaceIntersections(
            self.first[rows], self.second[rows], self.points[rows], self.single[rows], self.tolerances[rows]
        )


def find_intersections(one: Subspaces, other: Subspaces) -> SubspaceIntersections:
    """Return all intersecting pairs of a subspace of `one` and a subspace of `other`.

    Raises
    ------
    UserError
        if their dimensions add up to D or more, where all pairs intersect.
    """
    errors = _measure_errors(one), _measure_errors(other)
    return _decide_pairs(one, other, errors, _screen_pairs(one, other, errors))


def find_intersections_within(release: Subspaces) -> SubspaceIntersections:
    """Return all intersecting pairs of different subspaces of one release, each pair once, with `first` < `second`."""
    errors = (_measure_errors(release),) * 2
    pairs = _screen_pairs(release, release, errors, triangle=True)
    return _decide_pairs(release, release, errors, ((first[first < second], second[first < second]) for first, second in pairs))


def concatenate_intersections(parts: Sequence[SubspaceIntersections]) -> SubspaceIntersections:
    """Return the pairs of one or more parts, in order."""
    return SubspaceIntersections(
        np.concatenate([part.first for part in parts]),
        np.concatenate([part.second for part in parts]),
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.single for part in parts]),
        np.concatenate([part.tolerances for part in parts]),
    )


def estimate_tolerances(release: Subspaces) -> Doubles:
    """Return for each subspace the distance below which it contains a point of unit norm: that which its errors allow. -> (N,)"""
    return _limit(_measure_errors(release).moves)


@dataclass(frozen=True, eq=False)
class _Errors:
    """The errors of the subspaces of a release."""

    vectors: Doubles  # (N,) of unit vectors in the span of the basis (`estimate_errors`)
    moves: Doubles  # (N,) how far these may move the points of unit norm


def _measure_errors(release: Subspaces) -> _Errors:
    """Estimate the errors of a release.

    A point o + Bᵀ c of unit norm has |c| ≤ |o| + 1. So it moves by at most e (2 |o| + 1), if e is the error of unit vectors and
    the relative error of o.
    """
    vectors = estimate_errors(release)
    return _Errors(vectors, vectors * (2 * np.linalg.norm(release.origins.astype(np.float64), axis=1) + 1))


def _limit(distances: Doubles) -> Doubles:
    return distances.clip(INTERSECTION_DISTANCE, LARGEST_TOLERANCE)


def estimate_errors(release: Subspaces) -> Doubles:
    """Return an estimate of the error of unit vectors in the span of each basis B: |B Bᵀ − I| √(D / dim), spectral norm. -> (N,)

    An error in a random direction shows in dim of the D components of B Bᵀ − I. The estimate for float16 is 8e-4, for float32
    7e-8. The published code orthogonalises in float32. Nearly dependent vectors, at dim 16, give it up to 1e-2. A small basis may
    be orthonormal by chance, so no estimate is below the median of the release.
    """
    bases = release.bases.astype(np.float64)
    values = np.linalg.eigvalsh(bases @ bases.transpose(0, 2, 1) - np.eye(release.dim))  # (N, dim)
    errors = np.abs(values).max(axis=1) * (bases.shape[2] / release.dim) ** 0.5
    return np.maximum(errors, np.median(errors)) if len(errors) else errors


def _screen_pairs(
    one: Subspaces, other: Subspaces, errors: tuple[_Errors, _Errors], triangle: bool = False
) -> Iterator[tuple[Indices, Indices]]:
    """Yield pairs that may intersect, block by block; `triangle` skips blocks where each pair has `first` > `second`."""
    import torch

    length = one.origins.shape[1]
    if one.dim + other.dim >= length:
        raise UserError(f"subspaces of dimensions {one.dim} and {other.dim} always intersect in a space of {length}")
    moves = [np.square(each.moves) for each in errors]
    for top, left, squares in squared_distances(one, other, one.dim + other.dim + SPARE_DIRECTIONS, triangle):
        rows, columns = (slice(start, start + count) for start, count in zip((top, left), squares.shape, strict=True))
        allowed = (NEAR + moves[0][rows, None] + moves[1][columns]).clip(max=NEAR + LARGEST_TOLERANCE**2)  # (n, n')
        first, second = (squares < torch.from_numpy(allowed).to(squares)).nonzero(as_tuple=True)
        yield first.cpu().numpy() + top, second.cpu().numpy() + left


def squared_distances(
    one: Subspaces, other: Subspaces, directions: int, triangle: bool = False
) -> Iterator[tuple[int, int, Tensor]]:
    """Yield dist² of all pairs, block by block, after a projection onto `directions` fixed directions; D of them are exact.

    Returns
    -------
    The first row, the first column and (n, n') float32 of each block; `triangle` skips blocks below the diagonal.
    """
    device = pick_device()
    left_side, right_side = (_project_subspaces(release, directions).to(device) for release in (one, other))  # (dim + 1, N, k)
    columns = max(1, BLOCK // ((other.dim + 1) ** 2 * ROWS))
    for top in range(0, len(one), ROWS):
        for left in range(top // columns * columns if triangle else 0, len(other), columns):
            yield top, left, _compute_squared_distances(left_side[:, top : top + ROWS], right_side[:, left : left + columns])


def _project_subspaces(release: Subspaces, count: int) -> Tensor:
    """Return each subspace projected onto `count` directions: basis, then the point nearest to zero. -> (dim + 1, N, count)"""
    import torch

    onto = _draw_directions(release.origins.shape[1], count)  # (D, count)
    span = np.linalg.qr((release.bases.astype(np.float64) @ onto).transpose(0, 2, 1))[0]  # (N, count, dim)
    points = (release.origins.astype(np.float64) @ onto)[:, :, None]  # (N, count, 1)
    feet = points - span @ (span.transpose(0, 2, 1) @ points)
    return torch.from_numpy(np.concatenate([span, feet], axis=2).transpose(2, 0, 1).astype(np.float32, order="C"))


@functools.cache
def _draw_directions(length: int, count: int) -> Doubles:
    """Return random orthonormal columns, at most `length`. Results do not depend on the draw. -> (length, count)"""
    return np.linalg.qr(np.random.default_rng(0).normal(size=(length, min(length, count))))[0]


def _compute_squared_distances(one: Tensor, other: Tensor) -> Tensor:
    """Return dist² of all pairs. (a + 1, n, k), (b + 1, n', k) bases and, last, the points nearest to zero -> (n, n')

    Symmetric elimination. Entries above the diagonal of the form are never read.
    """
    import torch

    a, b = len(one) - 1, len(other) - 1
    flat = one.flatten(0, 1) @ other.flatten(0, 1).T
    products = flat.view(a + 1, one.shape[1], b + 1, other.shape[1]).transpose(1, 2).contiguous()  # (a + 1, b + 1, n, n')
    form = torch.zeros(b + 1, *products.shape[1:], device=one.device)  # (b + 1, b + 1, n, n')
    form.diagonal().fill_(1)  # (n, n', b + 1), of the first two axes
    form[b, :b] = -products[a, :b]
    form[b, b] = one[a].square().sum(dim=1)[:, None] + other[b].square().sum(dim=1) - 2 * products[a, b]
    for inner in products[:a]:  # (b + 1, n, n')
        form.addcmul_(inner[:, None], inner[None], value=-1)
    for step in range(b):
        column = form[step + 1 :, step]  # (b - step, n, n')
        scaled = column / form[step, step].clamp(min=PIVOT)
        form[step + 1 :, step + 1 :].addcmul_(column[:, None], scaled[None], value=-1)
    return form[b, b]


def _decide_pairs(
    one: Subspaces, other: Subspaces, errors: tuple[_Errors, _Errors], screened: Iterator[tuple[Indices, Indices]]
) -> SubspaceIntersections:
    """Return the screened pairs that intersect, decided in float64."""
    pairs = [np.empty((2, 0), dtype=np.int64), *(np.stack(pair) for pair in screened)]
    firsts, seconds = np.concatenate(pairs, axis=1)
    none = np.empty(0)
    parts = [SubspaceIntersections(firsts[:0], seconds[:0], np.empty((0, one.origins.shape[1])), none.astype(bool), none)]
    for start in range(0, len(firsts), EXACT):
        first, second = firsts[start : start + EXACT], seconds[start : start + EXACT]
        sines = np.hypot(errors[0].vectors[first], errors[1].vectors[second])
        points, distances, single = find_nearest_points(one.take(first), other.take(second), sines)
        tolerances = _limit(np.hypot(errors[0].moves[first], errors[1].moves[second]))
        parts.append(SubspaceIntersections(first, second, points, single, tolerances).take(distances < tolerances))
    return concatenate_intersections(parts)


def find_nearest_points(
    one: Subspaces, other: Subspaces, sines: Doubles | float = 0.0
) -> tuple[Doubles, Doubles, NDArray[np.bool_]]:
    """Return the nearest points of the two subspaces of each row, in float64.

    Parameters
    ----------
    sines : (N,) directions of the two are equal if the sine of their angle is lower

    Returns
    -------
    (N, D) midpoints of the nearest points, (N,) their distances, and (N,) whether the nearest points are unique.
    """
    (p, A), (q, B) = ((part.origins.astype(np.float64), orthonormalize(part.bases.astype(np.float64))) for part in (one, other))
    apart = (q - p)[..., None]  # (N, D, 1)
    G = A @ B.transpose(0, 2, 1)  # (N, dim, dim')
    slope = B @ apart - G.transpose(0, 2, 1) @ (A @ apart)  # (N, dim', 1)
    values, vectors = np.linalg.eigh(np.eye(B.shape[1]) - G.transpose(0, 2, 1) @ G)  # (N, dim'), (N, dim', dim')
    differ = values > np.maximum(SINGULAR, np.square(sines))[..., None]  # (N, dim')
    inverse = np.where(differ, 1 / np.where(differ, values, 1), 0)[..., None]
    coordinates = -vectors @ (inverse * (vectors.transpose(0, 2, 1) @ slope))  # (N, dim', 1) of the nearest point of `other`
    away = apart + B.transpose(0, 2, 1) @ coordinates  # (N, D, 1) from p to it
    along = A.transpose(0, 2, 1) @ (A @ away)
    return p + ((away + along) / 2)[..., 0], np.linalg.norm((away - along)[..., 0], axis=1), differ[:, 0]


def orthonormalize(bases: Doubles) -> Doubles:
    """Return orthonormal bases of the same spans, to 1e-14: by one Newton step if all are orthonormal to 1e-7. (N, dim, D)"""
    excess = np.eye(bases.shape[1]) - bases @ bases.transpose(0, 2, 1)
    if np.abs(excess).max(initial=0.0) > NEARLY_ORTHONORMAL:
        return np.linalg.qr(bases.transpose(0, 2, 1))[0].transpose(0, 2, 1)
    return bases + excess @ bases / 2
