"""The server's map: the keypoints of all references, their descriptors, and the 3D points that they observe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.formats.tensor_file import Arrays
from bench.geometry.nearest_words import unit_rows
from bench.types import Bytes, Floats, Indices

KIND = "map"


@dataclass(frozen=True, kw_only=True, eq=False)
class Map:
    """T keypoints of V references, in the order of the references, and P points."""

    names: tuple[str, ...]  # (V,) of the references
    starts: Indices  # (V + 1,) reference v has the keypoints from starts[v] to starts[v + 1] - 1
    keypoints: Floats  # (T, 2)
    descriptors: Floats  # (T, D) unit norm
    codes: Bytes | None  # (T, D) the 8-bit vectors of the descriptors, if there are any
    points: Indices  # (T,) the row in `xyz` of the point that a keypoint shows, or -1
    xyz: NDArray[np.float64]  # (P, 3) in the scene's unit of length

    def __len__(self) -> int:
        return len(self.names)

    def rows(self, reference: int) -> slice:
        """Return the rows of the keypoints of one reference."""
        return slice(int(self.starts[reference]), int(self.starts[reference + 1]))

    def to_arrays(self) -> tuple[Arrays, dict[str, Any]]:
        """Return arrays and metadata for a tensor file. Descriptors are stored only if there are no codes."""
        arrays: Arrays = {"starts": self.starts, "keypoints": self.keypoints, "points": self.points, "xyz": self.xyz}
        stored: Arrays = {"descriptors": self.descriptors} if self.codes is None else {"codes": self.codes}
        return arrays | stored, {"names": list(self.names)}


def from_arrays(arrays: Arrays, meta: Mapping[str, Any]) -> Map:
    """Return the map from the result of `to_arrays`."""
    codes = arrays.get("codes")
    return Map(
        names=tuple(meta["names"]),
        starts=arrays["starts"],
        keypoints=arrays["keypoints"],
        descriptors=arrays["descriptors"] if codes is None else unit_rows(codes),
        codes=codes,
        points=arrays["points"],
        xyz=arrays["xyz"],
    )
