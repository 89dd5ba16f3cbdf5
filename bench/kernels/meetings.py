"""Where affine subspaces meet: two that go through one descriptor have distance zero, and meet in that descriptor.

For D1 = {o1 + B1ᵀ c1} and D2 = {o2 + B2ᵀ c2} with orthonormal bases, put δ = o2 − o1 and G = B1 [B2ᵀ, δ]. The least squares over
c1 leave the quadratic form S = [[I, B2 δ], [(B2 δ)ᵀ, |δ|²]] − Gᵀ G of (c2, 1); eliminating c2 from it leaves dist(D1, D2)².

All pairs are screened in float32 after a projection onto dim + dim' + 16 fixed directions. A projection lengthens nothing, so two
that meet still do, and strangers stay apart in the 16 directions to spare. Those that remain are decided again in float64 and in
all dimensions: there the float32 releases of one descriptor meet to about 1e-7, and strangers keep a tenth and more.

Floor, for a pair of equal dimensions: 2 (dim + 1)² (2 dim + 16) operations of a matrix product, then dim (dim + 1)² + (dim + 1)³ / 3
multiply-adds of the elimination. These take most of the time; pairs lie side by side in memory, so that each step is a long loop.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.device import pick_device
from bench.types import Floats, Indices, Subspaces

Doubles = NDArray[np.float64]

MEETS = 1e-5  # the distance below which two subspaces meet
SPARE = 16  # directions beyond those that two subspaces span
NEAR = 4e-4  # squared distance that screening lets through; it errs by about 2e-5 for points of unit norm
SINGULAR = 1e-9  # squared sine of an angle at which two directions are one; orthonormal to 1e-14, shared ones have about 1e-13
PIVOT = 1e-6  # the least that is divided by, for pairs that have a direction in common
BLOCK = 600_000  # numbers in the quadratic forms of a block of pairs, which so stay near the processor
ROWS = 8  # subspaces of the one side in a block
EXACT = 1024  # pairs that are decided at a time


@dataclass(frozen=True, eq=False)
class Meetings:
    """P pairs of subspaces that meet."""

    first: Indices  # (P,) rows of the one
    second: Indices  # (P,) rows of the other
    points: Doubles  # (P, D) halfway between the nearest points of the two
    single: NDArray[np.bool_]  # (P,) whether they have that point in common and no line

    def __len__(self) -> int:
        return len(self.first)


def meetings(one: Subspaces, other: Subspaces) -> Meetings:
    """All pairs of a subspace of `one` and one of `other` that meet.

    Where their dimensions add up to D or more, all pairs do.
    """
    return _decided(one, other, _screened(one, other))


def meetings_within(release: Subspaces) -> Meetings:
    """All pairs of different subspaces of one release that meet, each pair once, with `first` < `second`."""
    pairs = ((first, second) for first, second in _screened(release, release, triangle=True))
    return _decided(release, release, ((first[first < second], second[first < second]) for first, second in pairs))


def meeting_points(one: Subspaces, other: Subspaces) -> Doubles:
    """The point nearest to both subspaces of each keypoint, for two releases of the same keypoints. -> (N, D)

    Two liftings of one descriptor meet there, and in no other point unless they share an adversarial descriptor, too.
    """
    rows = np.arange(len(one))
    return _decided(one, other, iter([(rows, rows)]), within=np.inf).points


def stacked(releases: Sequence[Subspaces]) -> Subspaces:
    """The subspaces of at least one release, one after the other."""
    return replace(
        releases[0],
        keypoints=np.concatenate([release.keypoints for release in releases]),
        origins=np.concatenate([release.origins for release in releases]),
        bases=np.concatenate([release.bases for release in releases]),
    )


def _screened(one: Subspaces, other: Subspaces, triangle: bool = False) -> Iterator[tuple[Indices, Indices]]:
    """Pairs that may meet, block by block; `triangle` leaves out blocks of which each pair has `first` > `second`."""
    device = pick_device()
    mine, theirs = (_projected(release, one.dim + other.dim + SPARE).to(device) for release in (one, other))  # (dim + 1, N, k)
    columns = max(1, BLOCK // ((other.dim + 1) ** 2 * ROWS))
    for top in range(0, len(one), ROWS):
        for left in range(top // columns * columns if triangle else 0, len(other), columns):
            squares = _squared_distances(mine[:, top : top + ROWS], theirs[:, left : left + columns])
            first, second = (squares < NEAR).nonzero(as_tuple=True)
            yield first.cpu().numpy() + top, second.cpu().numpy() + left


def _projected(release: Subspaces, count: int) -> Tensor:
    """Each subspace's image in `count` directions: an orthonormal basis, and its point nearest to zero. -> (dim + 1, N, count)"""
    onto = _directions(release.origins.shape[1], count)  # (D, count)
    span = np.linalg.qr((release.bases.astype(np.float64) @ onto).transpose(0, 2, 1))[0]  # (N, count, dim)
    points = (release.origins.astype(np.float64) @ onto)[:, :, None]  # (N, count, 1)
    feet = points - span @ (span.transpose(0, 2, 1) @ points)
    return torch.from_numpy(np.concatenate([span, feet], axis=2).transpose(2, 0, 1).astype(np.float32, order="C"))


@functools.cache
def _directions(length: int, count: int) -> Doubles:
    """Orthonormal columns, as many as there can be. What is found does not depend on them. -> (length, count)"""
    return np.linalg.qr(np.random.default_rng(0).normal(size=(length, min(length, count))))[0]


def _squared_distances(mine: Tensor, theirs: Tensor) -> Tensor:
    """dist² of all pairs of subspaces, each given by a basis and its point nearest to zero. (a + 1, n, k), (b + 1, n', k) -> (n, n')

    Symmetric elimination. What lies above the diagonal of the form is never read.
    """
    dim, other = len(mine) - 1, len(theirs) - 1
    flat = mine.flatten(0, 1) @ theirs.flatten(0, 1).T
    products = flat.view(dim + 1, mine.shape[1], other + 1, theirs.shape[1]).transpose(1, 2).contiguous()  # (a + 1, b + 1, n, n')
    form = torch.zeros(other + 1, *products.shape[1:], device=mine.device)  # (b + 1, b + 1, n, n')
    form.diagonal().fill_(1)  # (n, n', b + 1), of the first two axes
    form[other, :other] = -products[dim, :other]
    form[other, other] = mine[dim].square().sum(dim=1)[:, None] + theirs[dim].square().sum(dim=1) - 2 * products[dim, other]
    for inner in products[:dim]:  # (b + 1, n, n')
        form.addcmul_(inner[:, None], inner[None], value=-1)
    for step in range(other):
        column = form[step + 1 :, step]  # (b - step, n, n')
        scaled = column / form[step, step].clamp(min=PIVOT)
        form[step + 1 :, step + 1 :].addcmul_(column[:, None], scaled[None], value=-1)
    return form[other, other]


def _decided(one: Subspaces, other: Subspaces, pairs: Iterator[tuple[Indices, Indices]], within: float = MEETS) -> Meetings:
    """Of these pairs those whose distance is below `within`, in float64."""
    firsts, seconds = (np.concatenate([np.empty(0, np.int64), *rows]) for rows in zip(*pairs, strict=True))
    found = []
    for start in range(0, len(firsts), EXACT):
        first, second = firsts[start : start + EXACT], seconds[start : start + EXACT]
        points, distances, single = _nearest_points(
            (one.origins[first], one.bases[first]), (other.origins[second], other.bases[second])
        )
        met = distances < within
        found.append(Meetings(first[met], second[met], points[met], single[met]))
    if not found:
        return Meetings(firsts, seconds, np.empty((0, one.origins.shape[1])), np.empty(0, bool))
    return Meetings(
        np.concatenate([part.first for part in found]),
        np.concatenate([part.second for part in found]),
        np.concatenate([part.points for part in found]),
        np.concatenate([part.single for part in found]),
    )


def _nearest_points(one: tuple[Floats, Floats], other: tuple[Floats, Floats]) -> tuple[Doubles, Doubles, NDArray[np.bool_]]:
    """Midpoints of the nearest points of P pairs of subspaces, their distances, and whether they are the only nearest ones.

    Of several nearest points, one whose coordinates in the other subspace are small. (P, D), (P, dim, D) twice -> (P, D), (P,), (P,)
    """
    (p, A), (q, B) = ((origins.astype(np.float64), _orthonormal(bases.astype(np.float64))) for origins, bases in (one, other))
    apart = (q - p)[..., None]  # (P, D, 1)
    G = A @ B.transpose(0, 2, 1)  # (P, dim, dim')
    slope = B @ apart - G.transpose(0, 2, 1) @ (A @ apart)  # (P, dim', 1)
    values, vectors = np.linalg.eigh(np.eye(B.shape[1]) - G.transpose(0, 2, 1) @ G)  # (P, dim'), (P, dim', dim')
    inverse = np.where(values > SINGULAR, 1 / np.where(values > SINGULAR, values, 1), 0)[..., None]
    theirs = -vectors @ (inverse * (vectors.transpose(0, 2, 1) @ slope))  # (P, dim', 1)
    away = apart + B.transpose(0, 2, 1) @ theirs  # (P, D, 1) from p to the nearest point of the other
    mine = A.transpose(0, 2, 1) @ (A @ away)
    return p + ((away + mine) / 2)[..., 0], np.linalg.norm((away - mine)[..., 0], axis=1), values[:, 0] > SINGULAR


def _orthonormal(bases: Doubles) -> Doubles:
    """Bases that are orthonormal to 1e-7 as float32 has them, made so to 1e-14 by a step of Newton's. (P, dim, D) -> (P, dim, D)"""
    return bases + (np.eye(bases.shape[1]) - bases @ bases.transpose(0, 2, 1)) @ bases / 2
