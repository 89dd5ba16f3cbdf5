"""The server's map: the keypoints of all references, their descriptors, and the 3D points that they are seen to be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.errors import UserError
from bench.kernels.search import unit_rows
from bench.tensorfile import Arrays
from bench.types import Bytes, Floats, Indices

KIND = "map"


@dataclass(frozen=True, kw_only=True, eq=False)
class Map:
    """T keypoints of V references, one reference after the other, and P points."""

    names: tuple[str, ...]  # (V,) of the references
    starts: Indices  # (V + 1,) keypoints starts[v] up to starts[v + 1] are of reference v
    keypoints: Floats  # (T, 2)
    stored: Bytes | Floats  # (T, D) the codes, where the extractor gives such, else the descriptors
    points: Indices  # (T,) the row of `xyz` that a keypoint is an image of, or -1
    xyz: NDArray[np.float64]  # (P, 3) in the scene's unit of length

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def descriptors(self) -> Floats:
        """(T, D) unit norm."""
        return self.stored if self.codes is None else unit_rows(self.stored)

    @property
    def codes(self) -> Bytes | None:
        """(T, D) 8-bit vectors, where the extractor gives such."""
        return self.stored if self.stored.dtype == np.uint8 else None

    def rows(self, reference: int) -> slice:
        """The keypoints of one reference."""
        return slice(int(self.starts[reference]), int(self.starts[reference + 1]))

    def to_arrays(self) -> tuple[Arrays, dict[str, Any]]:
        """What a file of tensors holds of it, and its metadata."""
        arrays = {
            "starts": self.starts,
            "keypoints": self.keypoints,
            "stored": self.stored,
            "points": self.points,
            "xyz": self.xyz,
        }
        return arrays, {"names": list(self.names)}


def from_arrays(arrays: Arrays, meta: dict[str, Any]) -> Map:
    """The map that `to_arrays` took apart.

    Raises
    ------
    UserError
        if an array is missing.
    """
    try:
        return Map(names=tuple(meta["names"]), **arrays)
    except (KeyError, TypeError) as error:
        raise UserError(f"not a whole map: {error}") from error
