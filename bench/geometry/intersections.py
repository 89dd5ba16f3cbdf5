"""Where affine subspaces meet: two that go through one descriptor have distance zero, and meet in that descriptor.

For D1 = {o1 + B1ᵀ c1} and D2 = {o2 + B2ᵀ c2} with orthonormal bases, put δ = o2 − o1 and G = B1 [B2ᵀ, δ]. The least squares over
c1 leave the quadratic form S = [[I, B2 δ], [(B2 δ)ᵀ, |δ|²]] − Gᵀ G of (c2, 1); eliminating c2 from it leaves dist(D1, D2)².

All pairs are screened in float32 after a projection onto dim + dim' + 16 fixed directions. A projection lengthens nothing, so two
that meet still do, and strangers stay apart in the 16 directions to spare. Those that remain are decided again in float64 and in
all dimensions: there the float32 releases of one descriptor meet to about 1e-7, and strangers keep a tenth and more.

Floor, for a pair of equal dimensions: 2 (dim + 1)² (2 dim + 16) operations of a matrix product, dim (dim + 1)² + (dim + 1)³ / 3
multiply-adds of the elimination. The latter take most of the time; pairs lie side by side in memory, so each step is a long loop.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.core.device import pick_device
from bench.core.errors import UserError
from bench.types import Indices, Subspaces

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

    def take(self, rows: NDArray[Any]) -> Meetings:
        """Some of the pairs, in the order of `rows`: indices, or a mask."""
        return Meetings(self.first[rows], self.second[rows], self.points[rows], self.single[rows])


def meetings(one: Subspaces, other: Subspaces) -> Meetings:
    """All pairs of a subspace of `one` and one of `other` that meet.

    Raises
    ------
    UserError
        if their dimensions add up to D or more, where all pairs meet.
    """
    return _decided(one, other, _screened(one, other))


def meetings_within(release: Subspaces) -> Meetings:
    """All pairs of different subspaces of one release that meet, each pair once, with `first` < `second`."""
    pairs = ((first, second) for first, second in _screened(release, release, triangle=True))
    return _decided(release, release, ((first[first < second], second[first < second]) for first, second in pairs))


def joined(parts: Sequence[Meetings]) -> Meetings:
    """The pairs of at least one list, one after the other."""
    return Meetings(
        np.concatenate([part.first for part in parts]),
        np.concatenate([part.second for part in parts]),
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.single for part in parts]),
    )


def _screened(one: Subspaces, other: Subspaces, triangle: bool = False) -> Iterator[tuple[Indices, Indices]]:
    """Pairs that may meet, block by block; `triangle` leaves out blocks of which each pair has `first` > `second`."""
    length = one.origins.shape[1]
    if one.dim + other.dim >= length:
        raise UserError(f"subspaces of dimensions {one.dim} and {other.dim} always meet in a space of {length}")
    for top, left, squares in squared_distances(one, other, one.dim + other.dim + SPARE, triangle):
        first, second = (squares < NEAR).nonzero(as_tuple=True)
        yield first.cpu().numpy() + top, second.cpu().numpy() + left


def squared_distances(
    one: Subspaces, other: Subspaces, directions: int, triangle: bool = False
) -> Iterator[tuple[int, int, Tensor]]:
    """dist² of all pairs, block by block, after a projection onto so many fixed directions; onto D of them it changes nothing.

    Returns
    -------
    The first row, the first column and (n, n') float32 of each block; `triangle` leaves out those below the diagonal.
    """
    device = pick_device()
    mine, theirs = (_projected(release, directions).to(device) for release in (one, other))  # (dim + 1, N, k)
    columns = max(1, BLOCK // ((other.dim + 1) ** 2 * ROWS))
    for top in range(0, len(one), ROWS):
        for left in range(top // columns * columns if triangle else 0, len(other), columns):
            yield top, left, _squared_distances(mine[:, top : top + ROWS], theirs[:, left : left + columns])


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
    """dist² of all pairs. (a + 1, n, k), (b + 1, n', k) bases and, last, the points nearest to zero -> (n, n')

    Symmetric elimination. What lies above the diagonal of the form is never read.
    """
    dim, other = len(mine) - 1, len(theirs) - 1
    flat = mine.flatten(0, 1) @ theirs.flatten(0, 1).T
    products = flat.view(dim + 1, mine.shape[1], other + 1, theirs.shape[1]).transpose(1, 2).contiguous()  # (a + 1, b + 1, n, n')
    form = torch.zeros(other + 1, *products.shape[1:], device=mine.device)  # (b + 1, b + 1, n, n')
    form.diagonal().fill_(1)  # (n, n', b + 1), of the first two axes
    form[other, :other] = -products[dim, :other]
    form[other, other] = mine[dim].square().sum(dim=1)[:, None] + theirs[other].square().sum(dim=1) - 2 * products[dim, other]
    for inner in products[:dim]:  # (b + 1, n, n')
        form.addcmul_(inner[:, None], inner[None], value=-1)
    for step in range(other):
        column = form[step + 1 :, step]  # (b - step, n, n')
        scaled = column / form[step, step].clamp(min=PIVOT)
        form[step + 1 :, step + 1 :].addcmul_(column[:, None], scaled[None], value=-1)
    return form[other, other]


def _decided(one: Subspaces, other: Subspaces, screened: Iterator[tuple[Indices, Indices]]) -> Meetings:
    """Those of the screened pairs that meet, in float64."""
    pairs = [np.empty((2, 0), dtype=np.int64), *(np.stack(pair) for pair in screened)]
    firsts, seconds = np.concatenate(pairs, axis=1)
    found = [Meetings(firsts[:0], seconds[:0], np.empty((0, one.origins.shape[1])), np.empty(0, dtype=bool))]
    for start in range(0, len(firsts), EXACT):
        first, second = firsts[start : start + EXACT], seconds[start : start + EXACT]
        points, distances, single = nearest_points(one.take(first), other.take(second))
        found.append(Meetings(first, second, points, single).take(distances < MEETS))
    return joined(found)


def nearest_points(one: Subspaces, other: Subspaces) -> tuple[Doubles, Doubles, NDArray[np.bool_]]:
    """Where the subspaces of each row come nearest to each other, in float64.

    Returns
    -------
    (N, D) midpoints of the nearest points of the two, (N,) their distances, and (N,) whether they are the only nearest ones.
    """
    (p, A), (q, B) = ((part.origins.astype(np.float64), orthonormal(part.bases.astype(np.float64))) for part in (one, other))
    apart = (q - p)[..., None]  # (N, D, 1)
    G = A @ B.transpose(0, 2, 1)  # (N, dim, dim')
    slope = B @ apart - G.transpose(0, 2, 1) @ (A @ apart)  # (N, dim', 1)
    values, vectors = np.linalg.eigh(np.eye(B.shape[1]) - G.transpose(0, 2, 1) @ G)  # (N, dim'), (N, dim', dim')
    inverse = np.where(values > SINGULAR, 1 / np.where(values > SINGULAR, values, 1), 0)[..., None]
    theirs = -vectors @ (inverse * (vectors.transpose(0, 2, 1) @ slope))  # (N, dim', 1) coordinates of the other's nearest point
    away = apart + B.transpose(0, 2, 1) @ theirs  # (N, D, 1) from p to it
    mine = A.transpose(0, 2, 1) @ (A @ away)
    return p + ((away + mine) / 2)[..., 0], np.linalg.norm((away - mine)[..., 0], axis=1), values[:, 0] > SINGULAR


def orthonormal(bases: Doubles) -> Doubles:
    """Bases that are orthonormal to 1e-7, as float32 has them, made so to 1e-14 by a step of Newton's. (N, dim, D)"""
    return bases + (np.eye(bases.shape[1]) - bases @ bases.transpose(0, 2, 1)) @ bases / 2
