"""Distances between words and affine subspaces.

With p the point of D nearest to zero and B its orthonormal basis, dist(D, w)² = |w|² + |p|² − 2 w·p − |B w|², so that most of
the work is one matrix product: 2·N·(dim + 1)·K·D operations.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bench.device import pick_device
from bench.kernels.search import unit_rows
from bench.types import Floats, Indices, Subspaces

BLOCK = 2048  # words at a time, so that a block's products stay near the processor
BATCH = 128  # subspaces at a time
SHORTLIST = 4  # words that float32 hands on to float64


def nearest_to_subspaces(release: Subspaces, words: Floats) -> tuple[Indices, Floats]:
    """For each subspace the nearest of (K, D) unit words, ties to the lowest index, and its distance. -> (N,), (N,)

    Float32 finds the four best words of a subspace, float64 orders them.
    """
    device = pick_device()
    rows = torch.from_numpy(words).to(device)
    origins, bases = torch.from_numpy(release.origins).to(device), torch.from_numpy(release.bases).to(device)
    found, distances = [], []
    for points, frames in zip(origins.split(BATCH), bases.split(BATCH), strict=True):
        shortlist = _shortlist(points, frames, rows)  # (n, 4)
        exact = _distances(points.double(), frames.double(), rows[shortlist].double())  # (n, 4)
        # Ascending indices first, so that the first of equal distances is the lowest index.
        shortlist, order = shortlist.sort(dim=1)
        exact = exact.gather(1, order)
        best = exact.argmin(dim=1, keepdim=True)
        found.append(shortlist.gather(1, best)[:, 0].cpu())
        distances.append(exact.gather(1, best)[:, 0].cpu())
    if not found:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.float32)
    return torch.cat(found).numpy(), torch.cat(distances).float().numpy()


def feet(release: Subspaces) -> Floats:
    """For each subspace the direction of its point nearest to zero, negative components cut: what one guesses of a descriptor
    that is nowhere negative and of unit norm, if D is all one knows. -> (N, D) unit norm
    """
    origins, bases = release.origins.astype(np.float64), release.bases.astype(np.float64)
    points = origins - np.einsum("nmd,nm->nd", bases, np.einsum("nmd,nd->nm", bases, origins))
    cut = np.maximum(points, 0.0)
    cut[~cut.any(axis=1)] = 1.0
    return unit_rows(cut)


def _shortlist(points: Tensor, frames: Tensor, rows: Tensor) -> Tensor:
    """Indices of the words nearest to each subspace by float32. (n, D), (n, dim, D), (K, D) -> (n, 4)"""
    count, dim, length = frames.shape
    # The point of D nearest to zero makes B(w - p) = B w.
    feet = points - torch.einsum("nmd,nm->nd", frames, torch.einsum("nmd,nd->nm", frames, points))
    flat = frames.reshape(count * dim, length)
    scores = torch.empty(count, 0, device=points.device)
    indices = torch.empty(count, 0, dtype=torch.int64, device=points.device)
    for start in range(0, len(rows), BLOCK):
        block = rows[start : start + BLOCK].T  # (D, K')
        score = 2 * (feet @ block) + (flat @ block).square_().view(count, dim, -1).sum(dim=1)  # (n, K')
        value, place = score.topk(min(SHORTLIST, score.shape[1]), dim=1)
        scores, indices = torch.cat([scores, value], dim=1), torch.cat([indices, place + start], dim=1)
        scores, kept = scores.topk(min(SHORTLIST, scores.shape[1]), dim=1)
        indices = indices.gather(1, kept)
    return indices


def _distances(points: Tensor, frames: Tensor, candidates: Tensor) -> Tensor:
    """dist(D, w) in float64. (n, D), (n, dim, D), (n, c, D) -> (n, c)"""
    offsets = candidates - points[:, None]  # (n, c, D)
    inside = torch.einsum("ncd,nmd->ncm", offsets, frames)
    return (offsets - torch.einsum("ncm,nmd->ncd", inside, frames)).norm(dim=2)
