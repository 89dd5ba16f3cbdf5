"""A release as the network reads it: one row of numbers a keypoint, with the candidates of a keypoint stacked in order.

Dense feature maps of 128·m channels (paper, Sec. 5.3) are never built: each keypoint is embedded first and scattered afterwards.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import singledispatch

import numpy as np
import torch
from torch import Tensor

from bench.plugin import Between, Defense, OneOf
from bench.types import Descriptors, Floats, Release, Subspaces, WordSets

CELL = 2  # pixels: the side of the cells that keypoints are scattered to
DIRECTIONS = 16  # that are projected onto subspaces


@dataclass(frozen=True, eq=False)
class Points:
    """The keypoints of a batch of B releases, P in all."""

    values: Tensor  # (P, F) float32
    cells: Tensor  # (P,) int64, row of the flattened (B, H/2, W/2) grid
    batch: int  # B
    grid: tuple[int, int]  # H/2, W/2

    def to(self, device: torch.device) -> Points:
        return Points(self.values.to(device), self.cells.to(device), self.batch, self.grid)


@singledispatch
def stack(release: Release) -> Floats:
    """What is released for a keypoint, stacked. -> (N, slots, D)

    Raises
    ------
    TypeError
        if there is no stacking for this kind of release.
    """
    raise TypeError(f"no stacking is defined for {type(release).__name__}")


@stack.register
def _(release: Descriptors) -> Floats:
    return release.descriptors[:, None]  # (N, 1, D)


@stack.register
def _(release: WordSets) -> Floats:
    return release.candidates  # (N, m, D)


@stack.register
def _(release: Subspaces) -> Floats:
    """The projections onto D of zero and of fixed directions.

    The defense projects random ones: they tell nothing, and an origin so drawn buries the descriptor in noise of its own length.
    These depend on D alone, and determine it while it has at most as many dimensions as there are directions.
    """
    inner = np.einsum("nmd,nd->nm", release.bases, release.origins)
    feet = release.origins - np.einsum("nm,nmd->nd", inner, release.bases)  # (N, D) the point of D nearest to zero
    inside = release.bases @ _directions(release.bases.shape[2]).T  # (N, dim, 16) coordinates
    shadows = inside.transpose(0, 2, 1) @ release.bases  # (N, 16, D)
    return np.concatenate([feet[:, None], shadows], axis=1)  # (N, 1 + 16, D)


@functools.cache
def _directions(length: int) -> Floats:
    """Fixed orthonormal directions. -> (16, D)"""
    drawn = np.random.default_rng(0).normal(size=(length, min(DIRECTIONS, length)))
    return np.linalg.qr(drawn)[0].T.astype(np.float32)


def condition(defense: Defense, served: Mapping[str, Between | OneOf]) -> Floats:
    """The settings that the network serves, each scaled to [0, 1]: they are public, so the attacker knows them. -> (C,)"""
    scaled = []
    for field, settings in sorted(served.items()):
        value = float(getattr(defense, field))
        low, high = (settings.low, settings.high) if isinstance(settings, Between) else _extremes(settings)
        scaled.append((value - low) / (high - low) if high > low else 0.0)
    return np.array(scaled, dtype=np.float32)


def _extremes(settings: OneOf) -> tuple[float, float]:
    numbers = [float(value) for value in settings.values]
    return min(numbers), max(numbers)


def encode(releases: list[Release], conditions: list[Floats], slots: int) -> Points:
    """Encode a batch.

    A keypoint's row holds its stacked candidates, padded with zeros to `slots`; its place within its cell; the condition.

    Keypoints outside the image count as being on its border.

    Raises
    ------
    ValueError
        if a release has more candidates a keypoint than `slots`.
    """
    width, height = releases[0].size
    columns, rows = width // CELL, height // CELL
    values, cells = [], []
    for number, (release, known) in enumerate(zip(releases, conditions, strict=True)):
        stacked = stack(release)  # (N, s, D)
        count, used, length = stacked.shape
        if used > slots:
            raise ValueError(f"{used} candidates a keypoint, but the network was trained for at most {slots}")
        row = np.zeros((count, slots * length + 2 + len(known)), dtype=np.float32)
        # Unit rows of length D, scaled so that an element is about 1.
        row[:, : used * length] = stacked.reshape(count, -1) * np.float32(length**0.5)
        place = np.clip(release.keypoints, 0, np.array([width, height]) - 1e-3)
        cell = (place // CELL).astype(np.int64)  # (N, 2) column, row
        row[:, slots * length : slots * length + 2] = place / CELL - cell - 0.5
        row[:, slots * length + 2 :] = known
        values.append(row)
        cells.append((number * rows + cell[:, 1]) * columns + cell[:, 0])
    return Points(
        torch.from_numpy(np.concatenate(values)), torch.from_numpy(np.concatenate(cells)), len(releases), (rows, columns)
    )
