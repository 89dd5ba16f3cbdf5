"""Features that hloc extracted (Sarlin et al., CVPR 2019), read from an HDF5 file with a group for each image.

The name of a group is the image's path below hloc's image folder, and must be the path below ours. A group holds `keypoints`
(N, 2), `descriptors` (D, N) and `image_size` (width, height). hloc puts the centre of the first pixel at (0, 0), so half a pixel
is added. hloc ignores EXIF rotation, so a photograph with an EXIF rotation is refused.

By default hloc stores keypoints and descriptors as 16-bit floats. Records state the precision that this loses.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from bench.api import Extractor
from bench.core.errors import SampleError, UserError
from bench.formats.stored_features import NAMES_HINT, check_name, map_into_pixels, read_upright_size
from bench.geometry.nearest_words import unit_rows
from bench.images.photographs import Source
from bench.types import Features

if TYPE_CHECKING:
    import h5py

MAX_BYTES = 2**30  # of one array; a greater one is taken for damage


@dataclass(frozen=True, kw_only=True)
class Hloc(Extractor):
    """Reads features from an HDF5 file in hloc's layout, and moves those of photographs into the benchmark's square."""

    reads_stored: ClassVar[bool] = True

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

    def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
        if source is None:
            raise UserError(
                "hloc: features are found by the photograph's name, but this image has none. Training and dictionaries use "
                "mirrored views: choose an extractor that computes features"
            )
        keypoints, descriptors, size = self._read(source)
        read_upright_size(source, size)
        xy, keep = map_into_pixels(keypoints.astype(np.float64) + 0.5, size, image)
        if not keep.any():
            raise SampleError(f"{source.name}: no keypoint of {self.path} lies in the photograph's central square")
        codes = np.ascontiguousarray(descriptors[keep]) if descriptors.dtype == np.uint8 else None
        rows = unit_rows(descriptors[keep] if codes is not None else descriptors[keep].astype(np.float32))
        height, width = image.shape[:2]
        features = Features(keypoints=xy[keep].astype(np.float32), descriptors=rows, codes=codes, size=(width, height))
        return features.by_position()

    def list_notes(self, source: Source | None) -> tuple[str, ...]:
        """Return a note on the greatest rounding errors of keypoints and descriptors that are stored as 16-bit floats."""
        if source is None:
            return ()
        keypoints, descriptors, _ = self._read(source)
        parts = []
        if keypoints.dtype == np.float16:
            parts.append(f"keypoints by up to {_bound_rounding(keypoints).max():.3g} pixels")
        if descriptors.dtype == np.float16:
            norms = np.linalg.norm(descriptors.astype(np.float64), axis=1)  # (N,)
            errors = np.linalg.norm(_bound_rounding(descriptors), axis=1) / norms
            parts.append(f"descriptors by up to {errors.max():.2g} of their norm")
        return (f"{source.name}: hloc stored 16-bit floats, which changed {' and '.join(parts)}",) if parts else ()

    def _read(self, source: Source) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
        """Read and check the group. -> keypoints (N, 2), descriptors (N, D), both as stored, and the image's (width, height)"""
        import h5py

        check_name(source.name)
        where = f"{source.name}: {self.path}"
        try:
            with h5py.File(self.path) as opened:
                group = opened.get(source.name)
                if not isinstance(group, h5py.Group):
                    raise SampleError(f"{where} has no features of that name; {NAMES_HINT}")
                keypoints = _read_array(group, "keypoints", 2, where)
                descriptors = _read_array(group, "descriptors", 2, where)
                size = _read_array(group, "image_size", 1, where)
        except (SampleError, MemoryError):
            raise
        except Exception as error:  # h5py raises errors of any class for damaged files: OSError, KeyError, TypeError, ...
            raise SampleError(f"{where} is damaged, or not in hloc's layout: {error}") from error
        with np.errstate(over="ignore"):
            _check(keypoints, descriptors.astype(np.float32), self.dimension, where)
        if len(size) != 2 or not ((size >= 1) & (size < 2**31)).all() or not (size == np.floor(size)).all():
            raise SampleError(f"{where}: image_size is {size.tolist()}, expected a width and a height")
        return keypoints, descriptors.T, (int(size[0]), int(size[1]))


def _read_array(group: h5py.Group, name: str, dimensions: int, where: str) -> np.ndarray:
    """Return a dataset of numbers. Its shape is checked before it is read, since a small file can state a vast one."""
    import h5py

    dataset = group.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise SampleError(f"{where}: no dataset {name!r}")
    if dataset.dtype.kind not in "fiu" or dataset.shape is None:
        raise SampleError(f"{where}: {name} is of type {dataset.dtype}, expected numbers")
    if len(dataset.shape) != dimensions or dataset.size * dataset.dtype.itemsize > MAX_BYTES:
        raise SampleError(f"{where}: {name} has shape {dataset.shape}")
    return np.asarray(dataset[()])


def _check(keypoints: np.ndarray, descriptors: np.ndarray, dimension: int, where: str) -> None:
    count = len(keypoints)
    if keypoints.shape[1] != 2:
        raise SampleError(f"{where}: keypoints have shape {keypoints.shape}, expected (N, 2)")
    if count == 0:
        raise SampleError(f"{where}: no keypoint")
    if descriptors.shape != (dimension, count):
        raise SampleError(f"{where}: descriptors have shape {descriptors.shape}, expected ({dimension}, {count})")
    if not np.isfinite(keypoints).all():
        raise SampleError(f"{where}: keypoints hold values that are not finite")
    if not np.isfinite(descriptors).all():
        raise SampleError(f"{where}: descriptors hold values that are not finite")
    if not descriptors.any(axis=0).all():
        raise SampleError(f"{where}: a descriptor is zero")


def _bound_rounding(array: np.ndarray) -> np.ndarray:
    """Return half the distance to the next 16-bit float, the greatest change by rounding. -> float64"""
    return np.spacing(np.abs(array)).astype(np.float64) / 2


PLUGIN = Hloc
