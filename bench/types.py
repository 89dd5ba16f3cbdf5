"""What flows through the benchmark: the secret `Features`, the three kinds of `Release`, and what an attacker may know.

Shapes use N for keypoints, D for a descriptor's length, m for candidates a keypoint, dim for a subspace's dimension.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """What the phone extracted from one photograph, and the only secret of the benchmark."""

    keypoints: Floats  # (N, 2) x, y in pixels; the centre of the top-left pixel is (0.5, 0.5)
    descriptors: Floats  # (N, D) unit norm
    codes: Bytes | None  # (N, D) the 8-bit vectors that the descriptors came from, where there are any
    size: tuple[int, int]  # width, height in pixels
    frames: Floats | None = None  # (N, 2) scale in pixels and orientation in radians, where the extractor tells them

    def __len__(self) -> int:
        return len(self.keypoints)

    def by_position(self) -> Features:
        """The same features from top to bottom, then from left to right.

        Extractors find strong keypoints first, and strength is not released: in their order it would be.
        """
        return self.take(np.lexsort((self.keypoints[:, 0], self.keypoints[:, 1])))

    def take(self, rows: NDArray[Any]) -> Features:
        """The features of some keypoints, in the order of `rows`: indices, or a mask."""
        return Features(
            keypoints=self.keypoints[rows],
            descriptors=self.descriptors[rows],
            codes=None if self.codes is None else self.codes[rows],
            size=self.size,
            frames=None if self.frames is None else self.frames[rows],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Release:
    """What leaves the phone. The keypoints' positions and their number are released in the clear."""

    keypoints: Floats  # (N, 2)
    size: tuple[int, int]  # width, height

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True, kw_only=True, eq=False)
class Descriptors(Release):
    """One descriptor a keypoint, and what else of it is sent."""

    descriptors: Floats  # (N, D)
    frames: Floats | None = None  # (N, 1) scale in pixels, or (N, 2) with orientation in radians, where they are sent


@dataclass(frozen=True, kw_only=True, eq=False)
class Subspaces(Release):
    """One affine subspace {origin + basisᵀ c} a keypoint."""

    origins: Floats  # (N, D) a point of the subspace
    bases: Floats  # (N, dim, D) orthonormal rows

    @property
    def dim(self) -> int:
        return self.bases.shape[1]

    def take(self, rows: NDArray[Any]) -> Subspaces:
        """The subspaces of some keypoints, in the order of `rows`: indices, or a mask."""
        return replace(self, keypoints=self.keypoints[rows], origins=self.origins[rows], bases=self.bases[rows])


@dataclass(frozen=True, kw_only=True, eq=False)
class WordSets(Release):
    """A set of m candidate descriptors a keypoint; the order of a row carries nothing."""

    candidates: Floats  # (N, m, D) unit norm
    words: Indices | None  # (N, m) rows of the dictionary, ascending; None where there is no dictionary

    @property
    def subset_size(self) -> int:
        return self.candidates.shape[1]


class Knowledge(Enum):
    """What an attacker may have beside the release."""

    DATABASE = "the database W that lifting drew its adversarial descriptors from"
    PUBLIC_DATABASE = "a database Z of the attacker's own, from other photographs"
    OTHER_RELEASES = "other releases made with the same database"
    REPEATED_RELEASES = "further releases of the same photograph"
    MAP = "the server's map"
    TRAINING_IMAGES = "photographs to train an inversion network on"
