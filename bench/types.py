"""The secret `Features`, and a `Release`: positions × descriptors.

Shapes use N for keypoints, D for the length of a descriptor, m for candidates per keypoint, dim for the dimension of a subspace.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]
# Rows of integers, of which only the directions count: without sign as in SIFT, or with sign.
Words = NDArray[np.uint8] | NDArray[np.int8]


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """Features that the phone extracts from one photograph: the only secret of the benchmark."""

    keypoints: Floats  # (N, 2) x, y in pixels; the centre of the top-left pixel is (0.5, 0.5)
    descriptors: Floats  # (N, D) unit norm
    codes: Bytes | None  # (N, D) the 8-bit vectors of the descriptors; None if the extractor has none
    size: tuple[int, int]  # width, height in pixels
    frames: Floats | None = None  # (N, 2) scale in pixels and orientation in radians; None if the extractor has none

    def __len__(self) -> int:
        return len(self.keypoints)

    @property
    def exact(self) -> Bytes | Floats:
        """The 8-bit vectors if there are any, else the descriptors. (N, D)"""
        return self.descriptors if self.codes is None else self.codes

    def by_position(self) -> Features:
        """Return the same features from top to bottom, then from left to right.

        Extractors return strong keypoints first. Their order would reveal the strength, which is not released.
        """
        return self.take(np.lexsort((self.keypoints[:, 0], self.keypoints[:, 1])))

    def take(self, rows: NDArray[Any]) -> Features:
        """Return the features of some keypoints, in the order of `rows`: indices, or a mask."""
        return Features(
            keypoints=self.keypoints[rows],
            descriptors=self.descriptors[rows],
            codes=None if self.codes is None else self.codes[rows],
            size=self.size,
            frames=None if self.frames is None else self.frames[rows],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Positions:
    """Released positions of keypoints. Base class, with one subclass for each kind of release."""

    disclosed: ClassVar[str]  # what the release discloses in the clear; no ε covers it

    def __len__(self) -> int:
        """Return the number of keypoints."""
        raise NotImplementedError

    def take(self, rows: NDArray[Any]) -> Self:
        """Return the positions of some keypoints, in the order of `rows`: indices, or a mask."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True, eq=False)
class Points(Positions):
    """Positions in the clear."""

    disclosed = "the keypoints' positions"

    keypoints: Floats  # (N, 2) x, y in pixels

    def __len__(self) -> int:
        return len(self.keypoints)

    def take(self, rows: NDArray[Any]) -> Points:
        return Points(keypoints=self.keypoints[rows])


@dataclass(frozen=True, kw_only=True, eq=False)
class Lines(Positions):
    """One line per keypoint, which passes through it."""

    disclosed = "a line through each keypoint"

    lines: Floats  # (N, 3) a, b, c of {(x, y): a x + b y + c = 0} in pixels, a² + b² = 1

    def __len__(self) -> int:
        return len(self.lines)

    def take(self, rows: NDArray[Any]) -> Lines:
        return Lines(lines=self.lines[rows])


@dataclass(frozen=True, kw_only=True, eq=False)
class Permuted(Lines):
    """Points with one coordinate of their keypoint and one of another keypoint. The line has all points of the former."""

    disclosed = "the keypoints' coordinates, one of them with the coordinate of another keypoint"

    points: Floats  # (N, 2) x, y in pixels

    def take(self, rows: NDArray[Any]) -> Permuted:
        return Permuted(lines=self.lines[rows], points=self.points[rows])


@dataclass(frozen=True, kw_only=True, eq=False)
class Release:
    """The data that leave the phone: positions × descriptors.

    The subclass defines the form of the descriptors. The class of `positions` defines the form of the positions. The number of
    keypoints is always released in the clear.
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
    """One descriptor per keypoint, and its scale and orientation if the defense releases them."""

    descriptors: Floats  # (N, D)
    frames: Floats | None = None  # (N, 1) scale in pixels, or (N, 2) with orientation in radians; None if not released


@dataclass(frozen=True, kw_only=True, eq=False)
class Subspaces(Release):
    """One affine subspace {origin + basisᵀ c} per keypoint."""

    origins: Floats  # (N, D) a point of the subspace
    bases: Floats  # (N, dim, D) orthonormal rows

    @property
    def dim(self) -> int:
        """Dimension of the subspaces."""
        return self.bases.shape[1]

    def take(self, rows: NDArray[Any]) -> Subspaces:
        """Return the subspaces of some keypoints, in the order of `rows`: indices, or a mask."""
        return replace(self, positions=self.positions.take(rows), origins=self.origins[rows], bases=self.bases[rows])


@dataclass(frozen=True, kw_only=True, eq=False)
class WordSets(Release):
    """A set of m candidate descriptors per keypoint. The order within a row carries no information."""

    candidates: Floats  # (N, m, D) unit norm
    words: Indices | None  # (N, m) rows of the dictionary, ascending; None if there is no dictionary

    @property
    def subset_size(self) -> int:
        """Number m of candidates per keypoint."""
        return self.candidates.shape[1]
