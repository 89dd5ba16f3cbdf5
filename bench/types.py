"""The secret `Features`, and a `Release`: positions × descriptors.

Shapes use N for keypoints, D for a descriptor's length, m for candidates a keypoint, dim for a subspace's dimension.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """Features that the phone extracted from one photograph: the only secret of the benchmark."""

    keypoints: Floats  # (N, 2) x, y in pixels; the centre of the top-left pixel is (0.5, 0.5)
    descriptors: Floats  # (N, D) unit norm
    codes: Bytes | None  # (N, D) the 8-bit vectors that the descriptors came from, where there are any
    size: tuple[int, int]  # width, height in pixels
    frames: Floats | None = None  # (N, 2) scale in pixels and orientation in radians, where the extractor reports them

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
class Positions:
    """Where a release says that its keypoints are: a base class, one subclass for each kind."""

    def __len__(self) -> int:
        """The number of keypoints."""
        raise NotImplementedError

    def take(self, rows: NDArray[Any]) -> Self:
        """Return the positions of some keypoints, in the order of `rows`: indices, or a mask."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True, eq=False)
class Points(Positions):
    """Positions in the clear."""

    keypoints: Floats  # (N, 2) x, y in pixels

    def __len__(self) -> int:
        return len(self.keypoints)

    def take(self, rows: NDArray[Any]) -> Points:
        return Points(keypoints=self.keypoints[rows])


@dataclass(frozen=True, kw_only=True, eq=False)
class Release:
    """What leaves the phone: positions × descriptors.

    The class says how descriptors are released, and the class of `positions` how positions are. Their number is released in the
    clear.
    """

    positions: Positions
    size: tuple[int, int]  # width, height in pixels

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def keypoints(self) -> Floats:
        """(N, 2) x, y in pixels.

        Raises
        ------
        TypeError
            if the release has no points.
        """
        if not isinstance(self.positions, Points):
            raise TypeError(f"this release has {type(self.positions).__name__}, not Points")
        return self.positions.keypoints


@dataclass(frozen=True, kw_only=True, eq=False)
class Descriptors(Release):
    """One descriptor a keypoint, and what else of it is released."""

    descriptors: Floats  # (N, D)
    frames: Floats | None = None  # (N, 1) scale in pixels, or (N, 2) with orientation in radians, where they are released


@dataclass(frozen=True, kw_only=True, eq=False)
class Subspaces(Release):
    """One affine subspace {origin + basisᵀ c} a keypoint."""

    origins: Floats  # (N, D) a point of the subspace
    bases: Floats  # (N, dim, D) orthonormal rows

    @property
    def dim(self) -> int:
        return self.bases.shape[1]

    def take(self, rows: NDArray[Any]) -> Subspaces:
        """Return the subspaces of some keypoints, in the order of `rows`: indices, or a mask."""
        return replace(self, positions=self.positions.take(rows), origins=self.origins[rows], bases=self.bases[rows])


@dataclass(frozen=True, kw_only=True, eq=False)
class WordSets(Release):
    """A set of m candidate descriptors a keypoint; the order of a row carries no information."""

    candidates: Floats  # (N, m, D) unit norm
    words: Indices | None  # (N, m) rows of the dictionary, ascending; None where there is no dictionary

    @property
    def subset_size(self) -> int:
        return self.candidates.shape[1]
