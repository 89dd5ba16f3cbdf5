"""Encoding of releases as network input: one row of numbers per keypoint, with the candidates of the keypoint stacked.

The paper builds dense feature maps of 128·m channels (Sec. 5.3). Here each keypoint is embedded first and scattered afterwards.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import TYPE_CHECKING, Literal, Self

import numpy as np

from bench.api import Defense
from bench.geometry.lines import clip_lines, read_lines
from bench.settings import Between, OneOf
from bench.types import Descriptors, Floats, Release, Subspaces, WordSets

if TYPE_CHECKING:
    import torch
    from torch import Tensor

CELL = 4  # pixels: the side of a grid cell, to which keypoints are scattered
DIRECTIONS = 16  # number of fixed directions that are projected onto subspaces
TYPICAL_SCALE = 4.0  # pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class Encoded:
    """A batch of B releases, P keypoints in all."""

    values: Tensor  # (P, F) float32
    image: Tensor  # (P,) int64, index in the batch
    batch: int  # B
    size: tuple[int, int]  # H, W in pixels

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of cells; the last ones may lie partly outside the image."""
        return math.ceil(self.size[0] / CELL), math.ceil(self.size[1] / CELL)

    def to(self, device: torch.device) -> Self:
        moved = {name: value.to(device) for name, value in vars(self).items() if hasattr(value, "to")}
        return replace(self, **moved)


@dataclass(frozen=True, kw_only=True, eq=False)
class EncodedRelease(Encoded):
    """A batch of releases of points."""

    coordinates: Tensor  # (P, 2) float32, column and row in cells
    weights: Tensor | None = None  # (P,) of each keypoint's embedding; None: 1
    drafts: Tensor | None = None  # (B, 3, H, W) RGB in [0, 1], reconstructions of the photographs; None: not read
    draft_weights: Tensor | None = None  # (B,) of the drafts; None: 1


@dataclass(frozen=True, kw_only=True, eq=False)
class NoisyRelease(EncodedRelease):
    """A batch of releases of points, with photographs and noise for a step of flow matching (`bench.inversion.flow`)."""

    photographs: Tensor  # (B, 3, H, W) RGB in [0, 1]
    noise: Tensor  # (B, 48, H/4, W/4) float32, standard normal
    time: Tensor  # (B,) float32, from 0 (noise) to 1 (photograph)


@dataclass(frozen=True, kw_only=True, eq=False)
class EncodedLines(Encoded):
    """A batch of releases of lines. The position within the cell is zero in `values`."""

    samples: Tensor  # (P, S, 2) float32, column and row in cells of points on each line
    truth: Tensor | None  # (P,) int64, the sample that is nearest to the keypoint; None outside training
    within: int  # column of `values` where the position within the cell starts

    def pick_points(self, coordinates: Tensor, weights: Tensor) -> EncodedRelease:
        """Return k keypoints of each line at (P, k, 2) cells, with (P, k) weights."""
        points = coordinates.flatten(0, 1)
        values = self.values.repeat_interleave(coordinates.shape[1], dim=0)
        within = slice(self.within, self.within + 2)
        values[:, within] = points - points.floor() - 0.5
        image = self.image.repeat_interleave(coordinates.shape[1])
        return EncodedRelease(
            values=values, coordinates=points, image=image, batch=self.batch, size=self.size, weights=weights.flatten()
        )


# Network input for a keypoint. "released": the unchanged release, stacked as in the paper (m words in order, or a random origin
# and basis). "invariant": the release without its random order or basis. "positions": the position alone. "posteriors": as
# "released", and `bench.context.reconstruct` appends the posterior of each word.
Encoding = Literal["invariant", "released", "positions", "posteriors"]


def stack(release: Release, encoding: Encoding) -> Floats:
    """Stack the candidates of each keypoint. -> (N, slots, D)

    Word sets are stacked in their released order under both encodings. For "invariant", the network itself ignores the order.

    Raises
    ------
    TypeError
        if this kind of release has no stacking.
    """
    if encoding == "positions":
        return np.empty((len(release), 0, 0), dtype=np.float32)
    return project_directions(release) if encoding == "invariant" and isinstance(release, Subspaces) else _stack_released(release)


@singledispatch
def _stack_released(release: Release) -> Floats:
    raise TypeError(f"no stacking is defined for {type(release).__name__}")


@_stack_released.register
def _(release: Descriptors) -> Floats:
    return release.descriptors[:, None]  # (N, 1, D)


@_stack_released.register
def _(release: WordSets) -> Floats:
    return release.candidates  # (N, m, D)


@_stack_released.register
def _(release: Subspaces) -> Floats:
    return np.concatenate([release.origins[:, None], release.bases], axis=1)  # (N, 1 + dim, D)


def project_directions(release: Subspaces) -> Floats:
    """Project zero and fixed directions onto each subspace D. -> (N, 1 + 16, D)

    The random origin and basis of the defense carry no information, and the origin adds noise of the descriptor's length. These
    projections depend on D alone. They determine D if its dimension is at most the number of directions.
    """
    inner = np.einsum("nmd,nd->nm", release.bases, release.origins)
    feet = release.origins - np.einsum("nm,nmd->nd", inner, release.bases)  # (N, D) the point of D nearest to zero
    inside = release.bases @ _build_directions(release.bases.shape[2]).T  # (N, dim, 16) coordinates
    shadows = inside.transpose(0, 2, 1) @ release.bases  # (N, 16, D)
    return np.concatenate([feet[:, None], shadows], axis=1)


@functools.cache
def _build_directions(length: int) -> Floats:
    """Return fixed orthonormal directions. -> (16, D)"""
    normal = np.random.default_rng(0).normal(size=(length, min(DIRECTIONS, length)))
    return np.linalg.qr(normal)[0].T.astype(np.float32)


def encode_settings(defense: Defense, number: int, supported: Sequence[Mapping[str, Between | OneOf]]) -> Floats:
    """Return the settings of the defense that the network supports, scaled to [0, 1]. -> (C,)

    `supported` has the supported settings of each target of the network, and `number` is the defense's target. If there are
    several, each has columns of its own: an indicator and its settings. They are zero for other targets.
    """
    parts = []
    for target, settings in enumerate(supported):
        scaled = [_scale(defense, field, setting) if target == number else 0.0 for field, setting in sorted(settings.items())]
        parts += ([float(target == number)] if len(supported) > 1 else []) + scaled
    return np.array(parts, dtype=np.float32)


def _scale(defense: Defense, field: str, setting: Between | OneOf) -> float:
    value = float(getattr(defense, field))
    low, high = (setting.low, setting.high) if isinstance(setting, Between) else _find_extremes(setting)
    return (value - low) / (high - low) if high > low else 0.0


def _find_extremes(settings: OneOf) -> tuple[float, float]:
    numbers = [float(value) for value in settings.values]
    return min(numbers), max(numbers)


def encode(releases: list[Release], settings: list[Floats], slots: int, encoding: Encoding) -> EncodedRelease:
    """Encode a batch.

    The row of a keypoint holds its stacked candidates, padded with zeros to `slots`, and its position within its cell. Its scale
    (octaves) and orientation (cosine, sine), if released, and the settings follow. Keypoints outside the image are moved to its
    border.

    Raises
    ------
    ValueError
        if a release has more candidates per keypoint than `slots`.
    """
    import torch

    width, height = releases[0].size
    values, coordinates, image = [], [], []
    for number, (release, condition) in enumerate(zip(releases, settings, strict=True)):
        inside = np.clip(release.keypoints, 0, np.array([width, height]) * (1 - 1e-6))
        position = (inside / CELL).astype(np.float32)  # (N, 2)
        within = position - np.floor(position) - 0.5
        values.append(_encode_rows(release, condition, within, slots, encoding))
        coordinates.append(position)
        image.append(np.full(len(release), number))
    rows, cells, index = (torch.from_numpy(np.concatenate(parts)) for parts in (values, coordinates, image))
    return EncodedRelease(values=rows, coordinates=cells, image=index, batch=len(releases), size=(height, width))


def encode_lines(
    releases: Sequence[Release],
    settings: Sequence[Floats],
    slots: int,
    encoding: Encoding,
    samples: int,
    keypoints: Sequence[Floats] | None = None,
) -> EncodedLines:
    """Encode a batch of releases of lines, with that many samples of each line. `keypoints` are the true ones, for training.

    Rows are those of `encode`, with zeros for the position within the cell.

    Raises
    ------
    ValueError
        if a release has more candidates per keypoint than `slots`.
    """
    import torch

    width, height = releases[0].size
    values, points, image, truth = [], [], [], []
    for number, (release, condition) in enumerate(zip(releases, settings, strict=True)):
        values.append(_encode_rows(release, condition, np.zeros((len(release), 2), np.float32), slots, encoding))
        points.append(sample_lines(release, samples))
        image.append(np.full(len(release), number))
        if keypoints is not None:
            truth.append(np.linalg.norm(points[-1] - keypoints[number][:, None], axis=2).argmin(axis=1))
    limit = np.array([width, height]) * (1 - 1e-6)
    cells = (np.clip(np.concatenate(points), 0, limit) / CELL).astype(np.float32)
    within = values[0].shape[1] - len(settings[0]) - _encode_frames(releases[0]).shape[1] - 2
    return EncodedLines(
        values=torch.from_numpy(np.concatenate(values)),
        samples=torch.from_numpy(cells),
        image=torch.from_numpy(np.concatenate(image)),
        truth=torch.from_numpy(np.concatenate(truth)) if truth else None,
        within=within,
        batch=len(releases),
        size=(height, width),
    )


def sample_lines(release: Release, count: int) -> Floats:
    """Return that many points on the part of each line in the image, equally far from each other. -> (N, count, 2) pixels"""
    return clip_lines(read_lines(release), release.size).sample(count)


def _encode_rows(release: Release, condition: Floats, within: Floats, slots: int, encoding: Encoding) -> Floats:
    """Return the row of each keypoint. -> (N, F)"""
    stacked = stack(release, encoding)  # (N, s, D)
    count, used, length = stacked.shape
    if used > slots:
        raise ValueError(f"{used} candidates per keypoint, but the network was trained for at most {slots}")
    candidates = np.zeros((count, slots * length), dtype=np.float32)
    # Unit rows of length D, scaled so that an element is about 1.
    candidates[:, : used * length] = stacked.reshape(count, used * length) * np.float32(length**0.5)
    repeated = np.broadcast_to(condition, (count, len(condition)))
    return np.concatenate([candidates, within, _encode_frames(release), repeated], axis=1, dtype=np.float32)


def _encode_frames(release: Release) -> Floats:
    """Encode scale and orientation as numbers of order 1. -> (N, 0), (N, 1) or (N, 3)"""
    frames = release.frames if isinstance(release, Descriptors) else None
    if frames is None:
        return np.empty((len(release), 0), dtype=np.float32)
    octaves = np.log2(frames[:, :1] / TYPICAL_SCALE)
    return np.concatenate([octaves, np.cos(frames[:, 1:]), np.sin(frames[:, 1:])], axis=1)
