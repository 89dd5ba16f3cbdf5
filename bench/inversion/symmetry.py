"""Releases of the mirrored or rotated photograph, computed from the release of the photograph.

Attackers use them in training, and average the reconstructions over all eight. A gradient histogram of the transformed photograph
is a permutation of the original histogram. The extractor declares the permutation, and releases are permuted like descriptors.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import singledispatch
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np

from bench.api import Extractor
from bench.types import Bytes, Descriptors, Floats, Indices, Lines, Permuted, Points, Positions, Release, Subspaces, WordSets

if TYPE_CHECKING:
    from torch import Tensor


AnyRelease = TypeVar("AnyRelease", bound=Release)


@dataclass(frozen=True, eq=False)
class Symmetry:
    """One of the eight symmetries of a square: an optional left-right mirror, then a rotation."""

    mirrored: bool
    turns: int  # quarters, counter-clockwise
    order: Indices | None  # (D,) permutation of a descriptor's components; None to transform positions alone

    def transform_image(self, pixels: Bytes) -> Bytes:
        """Return the transformed photograph. (H, W, 3) -> (H, W, 3), or (W, H, 3) for one or three quarter turns"""
        return np.ascontiguousarray(np.rot90(pixels[:, ::-1] if self.mirrored else pixels, self.turns))

    def invert_image(self, image: Tensor) -> Tensor:
        """Return the inversely transformed image. (3, H, W)"""
        back = image.rot90(-self.turns, (1, 2))
        return back.flip(2) if self.mirrored else back

    def transform_release(self, release: AnyRelease) -> AnyRelease:
        """Return the release of the transformed photograph.

        Raises
        ------
        TypeError
            if there is a permutation and releases of this type have none, or if positions of this type have no symmetries.
        """
        if self.order is not None:
            release = cast(AnyRelease, _permute(release, self.order, self))
        positions = _transform_positions(release.positions, self, release.size)
        size = release.size[::-1] if self.turns % 2 else release.size
        return dataclasses.replace(release, positions=positions, size=size)

    def transform_points(self, points: Floats, size: tuple[int, int]) -> Floats:
        """Return points (N, 2) of a photograph of `size` in the transformed photograph."""
        (width, height), (x, y) = size, points.T
        if self.mirrored:
            x = width - x
        for _ in range(self.turns):
            x, y, width, height = y, width - x, height, width
        return np.stack([x, y], axis=1, dtype=np.float32)

    def transform_lines(self, lines: Floats, size: tuple[int, int]) -> Floats:
        """Return lines (N, 3) of a photograph of `size` in the transformed photograph."""
        (width, height), (a, b, c) = size, lines.T
        if self.mirrored:
            a, c = -a, c + a * width
        for _ in range(self.turns):
            a, b, c, width, height = b, -a, c + a * width, height, width
        return np.stack([a, b, c], axis=1, dtype=np.float32)


IDENTITY = Symmetry(False, 0, None)
POSITION_SYMMETRIES = tuple(Symmetry(mirrored, turns, None) for mirrored in (False, True) for turns in range(4))


def find_symmetries(extractor: Extractor) -> tuple[Symmetry, ...]:
    """Return the symmetries for which the extractor declares permutations, the identity first."""
    mirror, turn = extractor.mirror_order(), extractor.turn_order()
    symmetries = [IDENTITY] if mirror is None else [IDENTITY, Symmetry(True, 0, mirror)]
    if turn is not None:
        for turns in range(1, 4):
            symmetries += [_rotate(symmetry, turn) for symmetry in symmetries if symmetry.turns == turns - 1]
    return tuple(symmetries)


def _rotate(symmetry: Symmetry, turn: Indices) -> Symmetry:
    order = turn if symmetry.order is None else symmetry.order[turn]
    return Symmetry(symmetry.mirrored, symmetry.turns + 1, order)


@singledispatch
def _transform_positions(positions: Positions, symmetry: Symmetry, size: tuple[int, int]) -> Positions:
    raise TypeError(f"symmetries of {type(positions).__name__} are not defined")


@_transform_positions.register
def _(positions: Points, symmetry: Symmetry, size: tuple[int, int]) -> Positions:
    return Points(keypoints=symmetry.transform_points(positions.keypoints, size))


@_transform_positions.register
def _(positions: Lines, symmetry: Symmetry, size: tuple[int, int]) -> Positions:
    return Lines(lines=symmetry.transform_lines(positions.lines, size))


@_transform_positions.register
def _(positions: Permuted, symmetry: Symmetry, size: tuple[int, int]) -> Positions:
    points = symmetry.transform_points(positions.points, size)
    return Permuted(lines=symmetry.transform_lines(positions.lines, size), points=points)


@singledispatch
def _permute(release: Release, order: Indices, symmetry: Symmetry) -> Release:
    raise TypeError(f"symmetries of {type(release).__name__} are not defined")


@_permute.register
def _(release: Descriptors, order: Indices, symmetry: Symmetry) -> Release:
    return dataclasses.replace(
        release, descriptors=release.descriptors[:, order], frames=_transform_frames(release.frames, symmetry)
    )


@_permute.register
def _(release: WordSets, order: Indices, symmetry: Symmetry) -> Release:
    return dataclasses.replace(release, candidates=release.candidates[:, :, order], words=None)  # no words of the dictionary


@_permute.register
def _(release: Subspaces, order: Indices, symmetry: Symmetry) -> Release:
    return dataclasses.replace(release, origins=release.origins[:, order], bases=release.bases[:, :, order])


def _transform_frames(frames: Floats | None, symmetry: Symmetry) -> Floats | None:
    """Transform clockwise orientations with the photograph; scales stay."""
    if frames is None or frames.shape[1] == 1:
        return frames
    angle = np.float32(math.pi) - frames[:, 1] if symmetry.mirrored else frames[:, 1]
    return np.stack([frames[:, 0], angle - np.float32(symmetry.turns * math.pi / 2)], axis=1)
