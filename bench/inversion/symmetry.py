"""What would have been released of the photograph mirrored or turned, for an attacker to learn from, and to paint eight times.

A gradient histogram of the photograph so moved is the photograph's own in another order, which an extractor knows of itself; and
what defenses release of a descriptor is rearranged as descriptors are.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import singledispatch

import numpy as np
from torch import Tensor

from bench.api import Extractor
from bench.types import Bytes, Descriptors, Floats, Indices, Release, Subspaces, WordSets


@dataclass(frozen=True, eq=False)
class Symmetry:
    """One of the eight of a square: left and right change places, or do not; then the photograph is turned."""

    mirrored: bool
    turns: int  # quarters, counter-clockwise
    order: Indices | None  # (D,) of a descriptor's components; None for those who look at positions alone

    def of_image(self, pixels: Bytes) -> Bytes:
        """The photograph so moved. (H, W, 3) -> (H, W, 3), or (W, H, 3) where it is turned by one or three quarters"""
        return np.ascontiguousarray(np.rot90(pixels[:, ::-1] if self.mirrored else pixels, self.turns))

    def undone(self, image: Tensor) -> Tensor:
        """Moved back. (3, H, W)"""
        back = image.rot90(-self.turns, (1, 2))
        return back.flip(2) if self.mirrored else back

    def of_release(self, release: Release) -> Release:
        """What would have been released of the photograph so moved.

        Raises
        ------
        TypeError
            if there is an order and nothing is defined for this kind of release.
        """
        if self.order is not None:
            release = _rearranged(release, self.order, self)
        (width, height), (x, y) = release.size, release.keypoints.T
        if self.mirrored:
            x = width - x
        for _ in range(self.turns):
            x, y, width, height = y, width - x, height, width
        return dataclasses.replace(release, keypoints=np.stack([x, y], axis=1, dtype=np.float32), size=(width, height))


IDENTITY = Symmetry(False, 0, None)
OF_POSITIONS = tuple(Symmetry(mirrored, turns, None) for mirrored in (False, True) for turns in range(4))


def symmetries(extractor: Extractor) -> tuple[Symmetry, ...]:
    """Those under which an extractor tells what becomes of its descriptors; at least that which moves nothing."""
    mirror, turn = extractor.mirror_order(), extractor.turn_order()
    found = [IDENTITY] if mirror is None else [IDENTITY, Symmetry(True, 0, mirror)]
    if turn is not None:
        for turns in range(1, 4):
            found += [_turned(symmetry, turn) for symmetry in found if symmetry.turns == turns - 1]
    return tuple(found)


def _turned(symmetry: Symmetry, turn: Indices) -> Symmetry:
    order = turn if symmetry.order is None else symmetry.order[turn]
    return Symmetry(symmetry.mirrored, symmetry.turns + 1, order)


@singledispatch
def _rearranged(release: Release, order: Indices, symmetry: Symmetry) -> Release:
    raise TypeError(f"what a mirrored or turned photograph makes of {type(release).__name__} is not defined")


@_rearranged.register
def _(release: Descriptors, order: Indices, symmetry: Symmetry) -> Release:
    return dataclasses.replace(release, descriptors=release.descriptors[:, order], frames=_moved(release.frames, symmetry))


@_rearranged.register
def _(release: WordSets, order: Indices, symmetry: Symmetry) -> Release:
    return dataclasses.replace(release, candidates=release.candidates[:, :, order], words=None)  # no words of the dictionary


@_rearranged.register
def _(release: Subspaces, order: Indices, symmetry: Symmetry) -> Release:
    return dataclasses.replace(release, origins=release.origins[:, order], bases=release.bases[:, :, order])


def _moved(frames: Floats | None, symmetry: Symmetry) -> Floats | None:
    """Scales stay, orientations, which are clockwise, move with the photograph."""
    if frames is None or frames.shape[1] == 1:
        return frames
    angle = np.float32(math.pi) - frames[:, 1] if symmetry.mirrored else frames[:, 1]
    return np.stack([frames[:, 0], angle - np.float32(symmetry.turns * math.pi / 2)], axis=1)
