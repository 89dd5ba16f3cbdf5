"""Search for the words nearest to affine subspaces: a fast pass finds the candidates, float64 decides among them.

Let p be the point of D nearest to zero and B its orthonormal basis. A unit word u has dist(D, u)² = 1 + |p|² − s with the score
s = 2 p·u + |B u|². So nearly all of the work is one matrix product of 2·N·(dim + 1)·K·D operations, which is the floor.

No near word is lost. The fast pass rounds p, B and each product, so its scores err by at most E (`_bound_error`). Let s' be the
lowest of its `count` highest scores. The true score of that word is at least s' − E. A word with a score below s' − 2 E has a
lower true score. Every other word is a candidate. Zero is no special case; float64 separates it from small distances.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bench.core.device import pick_device, pick_dtype
from bench.geometry.nearest_words import unit_rows
from bench.types import Floats, Indices, Subspaces, Words

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Doubles = NDArray[np.float64]

BLOCK = 2048  # words in a block
ROWS = 1024  # rows of B and p per pass over the words: a block of products then fits into the cache
GROUP = 32  # greatest size of a group of words; its words are tested individually only if the best of them may be near
GROUPS = 32  # least number of groups per requested word, if there are enough words
NEAR = 1024  # requested words, of several subspaces, per batch in float64
FAR = 1e9  # placeholder distance of a missing word
TIE_TOLERANCE = 1e-12  # distances with a smaller difference count as equal; float64 errs by about 1e-16


def find_nearest_to_subspaces(release: Subspaces, words: Words | Floats, count: int = 1) -> tuple[Indices, Doubles]:
    """Return the nearest words of each subspace, nearest first, ties to the lowest index, and their distances.

    Parameters
    ----------
    words : (K, D) integers or float32, none zero; only their directions count, as `unit_rows` returns them
    count : number of words per subspace; all if there are fewer

    Returns
    -------
    (N, min(count, K)) int64 and float64. Distances are to the released float32 subspace: about 1e-7 for adversarial words.
    """
    count = min(count, len(words))
    feet, frames = feet_and_frames(release)
    found = np.empty((len(release), count), dtype=np.int64)
    distances = np.empty((len(release), count))
    step = max(1, ROWS // (release.dim + 1))
    for start in range(0, len(release), step):
        batch = slice(start, start + step)
        rows, near = _find_candidates(feet[batch], frames[batch], words, count)
        found[batch], distances[batch] = _decide(feet[batch], frames[batch], words, rows, near, count)
    return found, distances


def feet_and_frames(release: Subspaces) -> tuple[Doubles, Doubles]:
    """Return the point of each subspace nearest to zero, and a basis orthonormal to float64. -> (N, D), (N, dim, D)"""
    frames = np.linalg.qr(release.bases.astype(np.float64).transpose(0, 2, 1))[0].transpose(0, 2, 1)
    origins = release.origins.astype(np.float64)[:, None]  # (N, 1, D)
    return (origins - origins @ frames.transpose(0, 2, 1) @ frames)[:, 0], frames


def guess_descriptors(release: Subspaces, signed: bool = False) -> Floats:
    """Return the direction of each subspace's point nearest to zero, with negative components set to zero. -> (N, D) unit norm

    This is the best guess of a non-negative unit descriptor from D alone. `signed` descriptors keep their negative components.
    """
    cut = feet_and_frames(release)[0]
    cut = cut if signed else np.maximum(cut, 0.0)
    cut[~cut.any(axis=1)] = 1.0
    return unit_rows(cut.astype(np.float32))


def project(release: Subspaces, points: Doubles) -> Doubles:
    """Return the point of each subspace nearest to the given one. (N, D) -> (N, D)"""
    feet, frames = feet_and_frames(release)
    return feet + (points[:, None] @ frames.transpose(0, 2, 1) @ frames)[:, 0]


def _find_candidates(feet: Doubles, frames: Doubles, words: Words | Floats, count: int) -> tuple[Indices, Indices]:
    """Return pairs of a subspace and a word that may be near it, by subspace. (n, D), (n, dim, D), (K, D) -> (P,) twice"""
    import torch

    device = pick_device()
    dtype = pick_dtype(device)
    exact = np.concatenate([feet[:, None], frames], axis=1).transpose(1, 0, 2)  # (1 + dim, n, D)
    coarse = torch.from_numpy(exact).to(dtype)
    error = _bound_error(exact, coarse.double().numpy(), dtype, words.dtype)  # (n,)
    planes, allowed = coarse.to(device), torch.from_numpy(2 * error).float().to(device)[:, None]
    size = max(1, min(GROUP, len(words) // (GROUPS * count)))
    # The highest scores so far, one per group. The lowest of them is a lower bound of the count-th highest score.
    best = torch.full((len(feet), count), torch.finfo(torch.float32).min, device=device)
    waiting, pairs = [], []
    for start in range(0, len(words), BLOCK):
        scores = _compute_scores(planes, torch.from_numpy(words[start : start + BLOCK]).to(device))  # (n, K')
        ragged = -scores.shape[1] % size
        if ragged:
            scores = torch.nn.functional.pad(scores, (0, ragged), value=-torch.inf)
        groups = scores.view(len(feet), size, -1)  # (n, size, G)
        waiting.append((start, groups, groups.amax(dim=1)))
        if sum(maxima.shape[1] for _, _, maxima in waiting) < 2 * count and start + BLOCK < len(words):
            continue
        best = torch.cat([best, *(maxima for _, _, maxima in waiting)], dim=1).topk(count, dim=1, sorted=False).values
        least = best.amin(dim=1, keepdim=True) - allowed  # (n, 1)
        pairs += [_select_at_least(least, *block) for block in waiting]
        waiting = []
    rows, near, scores = (torch.cat(part) for part in zip(*pairs, strict=True))
    passing = scores >= least[rows, 0]  # the final bound, after all words
    rows, order = rows[passing].sort(stable=True)
    return rows.cpu().numpy(), near[passing][order].cpu().numpy()


def _select_at_least(least: Tensor, start: int, groups: Tensor, maxima: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return subspace, word and score of a block's high scores. (n, 1), start, (n, size, G), (n, G) -> three of (P,)"""
    row, group = (maxima >= least).nonzero(as_tuple=True)
    members = groups[row, :, group]  # (S, size)
    hit, member = (members >= least[row]).nonzero(as_tuple=True)
    return row[hit], start + member * groups.shape[2] + group[hit], members[hit, member]


def _compute_scores(planes: Tensor, block: Tensor) -> Tensor:
    """Return approximate scores 2 p·u + |B u|². (1 + dim, n, D), (K', D) -> (n, K') float32"""
    import torch

    scale = block.float().square().sum(dim=1).rsqrt()  # (K',) words are multiplied unscaled: bytes are exact in bf16
    products = (planes.flatten(0, 1) @ block.to(planes.dtype).T).unflatten(0, planes.shape[:2])  # (1 + dim, n, K')
    scores = torch.zeros(products.shape[1:], device=planes.device)
    for product in products[1:]:  # one at a time, so that a float32 copy stays in the cache
        wide = product.float()
        scores.addcmul_(wide, wide)
    return scores.mul_(scale).add_(products[0], alpha=2).mul_(scale)


def _bound_error(exact: Doubles, rounded: Doubles, dtype: torch.dtype, words: np.dtype) -> Doubles:
    """Return a bound of the error of a score of the fast pass. (1 + dim, n, D) twice -> (n,)

    Let r bound the relative error of one rounding (2^-8 for bf16), and let p', B', u' be the rounded p, B, u. Let s = D 2^-23,
    which is twice the greatest error, relative to the norms, of a sum of D products in float32. The factor of two covers the few
    float32 operations that follow. Then p·u errs by at most

        t = |p' − p| + |p| (|u' − u| + s)          and then by r |p·u| as it is rounded,

    the vector B u by at most

        y = |B' − B| + |u' − u| + √dim s           and then by r |B u|,

    and the score 2 p·u + |B u|² by at most

        2 (1 + r) (t + y) + 2 r (|p·u| + |B u|²) + (y + r)²,    where |p·u| + |B u|² ≤ 1 + |p|² / 4, as |p̂·u|² + |B u|² ≤ 1.
    """
    import torch

    r = torch.finfo(dtype).eps / 2
    word = 0.0 if words == np.uint8 else r  # |u' − u|
    s = exact.shape[2] * 2.0**-23
    foot = np.linalg.norm(exact[0], axis=1)  # (n,) |p|
    off = rounded - exact
    t = np.linalg.norm(off[0], axis=1) + foot * (word + s)
    y = np.linalg.norm(off[1:].transpose(1, 0, 2), ord=2, axis=(1, 2)) + word + (len(off) - 1) ** 0.5 * s
    return 2 * (1 + r) * (t + y) + 2 * r * (1 + foot**2 / 4) + (y + r) ** 2


def _decide(
    feet: Doubles, frames: Doubles, words: Words | Floats, rows: Indices, near: Indices, count: int
) -> tuple[Indices, Doubles]:
    """Return the nearest candidates of each subspace. (n, D), (n, dim, D), (K, D), (P,) twice -> (n, count) twice"""
    nearest, distances = np.empty((len(feet), count), dtype=np.int64), np.empty((len(feet), count))
    few = max(1, NEAR // count)
    for start in range(0, len(feet), few):
        part = slice(start, start + few)
        first, last = (np.searchsorted(rows, np.arange(len(feet))[part], side)[:, None] for side in ("left", "right"))
        positions = first + np.arange((last - first).max())  # (f, c), of which each subspace uses its number of candidates
        table = near[np.minimum(positions, last - 1)]
        offsets = unit_rows(words[table]) - feet[part, None]  # (f, c, D) float64
        offsets -= offsets @ frames[part].transpose(0, 2, 1) @ frames[part]
        norms = np.where(positions < last, np.linalg.norm(offsets, axis=2), FAR)  # (f, c)
        nearest[part], distances[part] = _rank_words(table, norms, count)
    return nearest, distances


def _rank_words(table: Indices, distances: Doubles, count: int) -> tuple[Indices, Doubles]:
    """Return the words of least distance in each row, ties to the lowest index. (f, c) twice -> (f, count) twice"""
    order = np.argsort(distances, axis=1)
    table, distances = np.take_along_axis(table, order, axis=1), np.take_along_axis(distances, order, axis=1)
    ranks = (np.diff(distances, axis=1, prepend=0) > TIE_TOLERANCE).cumsum(axis=1)
    order = np.lexsort((table, ranks), axis=1)[:, :count]
    return np.take_along_axis(table, order, axis=1), np.take_along_axis(distances, order, axis=1)
