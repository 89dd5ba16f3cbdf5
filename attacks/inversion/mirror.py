"""What would have been released of the mirrored photograph, so that an attacker can paint it twice and average.

A gradient histogram of the mirrored photograph is the photograph's own in another order, which an extractor knows of itself; and
what defenses release of a descriptor is rearranged as descriptors are.
"""

from __future__ import annotations

import dataclasses
import math
from functools import singledispatch

import numpy as np

from bench.types import Descriptors, Floats, Indices, Release, Subspaces, WordSets


def mirrored(release: Release, order: Indices) -> Release:
    """The release of the mirrored photograph. `order`: (D,) as `Extractor.mirror_order` returns it.

    Raises
    ------
    TypeError
        if nothing is defined for this kind of release.
    """
    return elsewhere(_rearranged(release, order))


def elsewhere(release: Release) -> Release:
    """The same release with its keypoints at their places in the mirrored photograph, for those who look at nothing else."""
    width = np.float32(release.size[0])
    return dataclasses.replace(release, keypoints=np.stack([width - release.keypoints[:, 0], release.keypoints[:, 1]], axis=1))


@singledispatch
def _rearranged(release: Release, order: Indices) -> Release:
    raise TypeError(f"what a mirrored photograph makes of {type(release).__name__} is not defined")


@_rearranged.register
def _(release: Descriptors, order: Indices) -> Release:
    return dataclasses.replace(release, descriptors=release.descriptors[:, order], frames=_turned(release.frames))


@_rearranged.register
def _(release: WordSets, order: Indices) -> Release:
    return dataclasses.replace(release, candidates=release.candidates[:, :, order], words=None)  # no words of the dictionary


@_rearranged.register
def _(release: Subspaces, order: Indices) -> Release:
    return dataclasses.replace(release, origins=release.origins[:, order], bases=release.bases[:, :, order])


def _turned(frames: Floats | None) -> Floats | None:
    """Scales stay, orientations turn about the vertical."""
    if frames is None or frames.shape[1] == 1:
        return frames
    return np.stack([frames[:, 0], np.float32(math.pi) - frames[:, 1]], axis=1)
