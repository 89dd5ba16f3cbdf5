"""A release as the network reads it: one row of numbers a keypoint, with the candidates of a keypoint stacked.

Dense feature maps of 128·m channels (paper, Sec. 5.3) are never built: each keypoint is embedded first and scattered afterwards.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import singledispatch
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from bench.api import Between, Defense, OneOf
from bench.types import Descriptors, Floats, Release, Subspaces, WordSets

CELL = 4  # pixels: the side of the cells that keypoints are scattered to
DIRECTIONS = 16  # that are projected onto subspaces
TYPICAL_SCALE = 4.0  # pixels


@dataclass(frozen=True, eq=False)
class Points:
    """The keypoints of a batch of B releases, P in all."""

    values: Tensor  # (P, F) float32
    places: Tensor  # (P, 2) float32, column and row in cells
    image: Tensor  # (P,) int64, which of the batch's
    batch: int  # B
    size: tuple[int, int]  # H, W in pixels

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of cells; the last ones may lie partly outside of the image."""
        return math.ceil(self.size[0] / CELL), math.ceil(self.size[1] / CELL)

    def to(self, device: torch.device) -> Points:
        return Points(self.values.to(device), self.places.to(device), self.image.to(device), self.batch, self.size)


# What a network is told of a keypoint: what was released as it was released (the paper's stacking: m words in order, or a random
# origin and basis); the same so that nothing depends on an order or a basis that was drawn; or its position alone.
Encoding = Literal["invariant", "released", "positions"]


def stack(release: Release, encoding: Encoding) -> Floats:
    """What the network is told of each keypoint beside its position, stacked. -> (N, slots, D)

    Word sets are stacked as they were released under either encoding; the network that reads them is invariant, or is not.

    Raises
    ------
    TypeError
        if there is no stacking for this kind of release.
    """
    if encoding == "positions":
        return np.empty((len(release), 0, 0), dtype=np.float32)
    return projections(release) if encoding == "invariant" and isinstance(release, Subspaces) else _released(release)


@singledispatch
def _released(release: Release) -> Floats:
    raise TypeError(f"no stacking is defined for {type(release).__name__}")


@_released.register
def _(release: Descriptors) -> Floats:
    return release.descriptors[:, None]  # (N, 1, D)


@_released.register
def _(release: WordSets) -> Floats:
    return release.candidates  # (N, m, D)


@_released.register
def _(release: Subspaces) -> Floats:
    return np.concatenate([release.origins[:, None], release.bases], axis=1)  # (N, 1 + dim, D)


def projections(release: Subspaces) -> Floats:
    """The projections onto each subspace D of zero and of fixed directions. -> (N, 1 + 16, D)

    The defense projects random ones: they tell nothing, and an origin so drawn buries the descriptor in noise of its own length.
    These depend on D alone, and determine it while it has at most as many dimensions as there are directions.
    """
    inner = np.einsum("nmd,nd->nm", release.bases, release.origins)
    feet = release.origins - np.einsum("nm,nmd->nd", inner, release.bases)  # (N, D) the point of D nearest to zero
    inside = release.bases @ _directions(release.bases.shape[2]).T  # (N, dim, 16) coordinates
    shadows = inside.transpose(0, 2, 1) @ release.bases  # (N, 16, D)
    return np.concatenate([feet[:, None], shadows], axis=1)


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


def encode(releases: list[Release], conditions: list[Floats], slots: int, encoding: Encoding) -> Points:
    """Encode a batch.

    A keypoint's row holds its stacked candidates, padded with zeros to `slots`; its place within its cell; its scale (octaves)
    and orientation (cosine, sine) where they are sent; the condition. Keypoints outside the image count as being on its border.

    Raises
    ------
    ValueError
        if a release has more candidates a keypoint than `slots`.
    """
    width, height = releases[0].size
    values, places, image = [], [], []
    for number, (release, known) in enumerate(zip(releases, conditions, strict=True)):
        stacked = stack(release, encoding)  # (N, s, D)
        count, used, length = stacked.shape
        if used > slots:
            raise ValueError(f"{used} candidates a keypoint, but the network was trained for at most {slots}")
        candidates = np.zeros((count, slots * length), dtype=np.float32)
        # Unit rows of length D, scaled so that an element is about 1.
        candidates[:, : used * length] = stacked.reshape(count, used * length) * np.float32(length**0.5)
        place = np.clip(release.keypoints, 0, np.array([width, height]) * (1 - 1e-6))
        place = (place / CELL).astype(np.float32)  # (N, 2)
        within = place - np.floor(place) - 0.5
        settings = np.broadcast_to(known, (count, len(known)))
        values.append(np.concatenate([candidates, within, _frames(release), settings], axis=1, dtype=np.float32))
        places.append(place)
        image.append(np.full(count, number))
    told, where, which = (torch.from_numpy(np.concatenate(parts)) for parts in (values, places, image))
    return Points(told, where, which, len(releases), (height, width))


def _frames(release: Release) -> Floats:
    """Scale and orientation as numbers of order 1. -> (N, 0), (N, 1) or (N, 3)"""
    frames = release.frames if isinstance(release, Descriptors) else None
    if frames is None:
        return np.empty((len(release), 0), dtype=np.float32)
    octaves = np.log2(frames[:, :1] / TYPICAL_SCALE)
    return np.concatenate([octaves, np.cos(frames[:, 1:]), np.sin(frames[:, 1:])], axis=1)
