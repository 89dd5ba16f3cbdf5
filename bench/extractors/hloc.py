"""Features that hloc extracted (Sarlin et al., CVPR 2019), read from an HDF5 file with a group for each image.

The name of a group is the image's path below hloc's image folder. A group holds `keypoints` (N, 2), `descriptors` (D, N) and
`image_size` (width, height). hloc puts the centre of the first pixel at (0, 0), so half a pixel is added. hloc ignores EXIF
rotation, so a photograph with an EXIF rotation is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.api import Extractor
from bench.core.errors import SampleError, UserError
from bench.formats.stored_features import map_into_square, match_name, read_upright_size
from bench.geometry.nearest_words import unit_rows
from bench.types import Features, Floats


@dataclass(frozen=True, kw_only=True)
class Hloc(Extractor):
    """Reads features from an HDF5 file in hloc's layout, and moves the keypoints into the benchmark's square."""

    path: Path
    dimension: int = 128  # of a descriptor
    exact_zeros: bool = False  # whether no component is negative and many are exactly zero, as in SIFT and RootSIFT
    eight_bit: bool = False  # whether each descriptor is an 8-bit integer vector, scaled

    def __post_init__(self) -> None:
        import h5py

        if not self.path.is_file():
            raise UserError(f"hloc: {self.path}: no such file")
        if not h5py.is_hdf5(self.path):
            raise UserError(f"hloc: {self.path}: not an HDF5 file")

    def extract(self, image: np.ndarray, source: Path | None = None) -> Features:
        if source is None:
            raise UserError(
                "hloc: features are found by the photograph's file, but this image has none. Training and dictionaries use "
                "mirrored views: choose an extractor that computes features"
            )
        keypoints, stored, size = self._read(source)
        _check(source, stored, len(keypoints), self.dimension, size)
        descriptors = stored.T  # (N, D)
        side = image.shape[0]
        xy = map_into_square(keypoints + 0.5, size, side)  # (N, 2)
        keep = ((xy >= 0) & (xy < side)).all(axis=1)
        if not keep.any():
            raise SampleError(f"{source.name}: no keypoint of {self.path} lies in the photograph's central square")
        codes = np.ascontiguousarray(descriptors[keep]) if descriptors.dtype == np.uint8 else None
        rows = unit_rows(descriptors[keep].astype(np.float32))
        features = Features(keypoints=xy[keep].astype(np.float32), descriptors=rows, codes=codes, size=(side, side))
        return features.by_position()

    def _read(self, source: Path) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
        """Read the group. -> keypoints (N, 2), descriptors (D, N), and the (width, height) of the image"""
        import h5py

        with h5py.File(self.path) as opened:
            name = match_name(source, opened)
            group = None if name is None else opened[name]
            if group is None:
                raise SampleError(f"{source.name}: {self.path} has no features of it")
            missing = [name for name in ("keypoints", "descriptors", "image_size") if name not in group]
            if missing:
                raise SampleError(f"{source.name}: {self.path}, group {group.name}: no dataset {missing[0]!r}")
            keypoints, descriptors = group["keypoints"][()], group["descriptors"][()]
            width, height = (int(side) for side in group["image_size"][()])
        if keypoints.ndim != 2 or keypoints.shape[1] != 2:
            raise SampleError(f"{source.name}: keypoints have shape {keypoints.shape}, expected (N, 2)")
        return keypoints.astype(np.float64), descriptors, (width, height)


def _check(source: Path, descriptors: Floats, count: int, dimension: int, size: tuple[int, int]) -> None:
    if count == 0:
        raise SampleError(f"{source.name}: no keypoint")
    if descriptors.shape != (dimension, count):
        raise SampleError(f"{source.name}: descriptors have shape {descriptors.shape}, expected ({dimension}, {count})")
    if not np.isfinite(descriptors).all():
        raise SampleError(f"{source.name}: descriptors hold values that are not finite")
    if not descriptors.any(axis=0).all():
        raise SampleError(f"{source.name}: a descriptor is zero")
    read_upright_size(source, size)


PLUGIN = Hloc
