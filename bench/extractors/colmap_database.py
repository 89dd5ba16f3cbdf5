"""Features that COLMAP extracted, read from its database by pycolmap.

COLMAP puts the centre of the first pixel at (0.5, 0.5), as we do. Its descriptors have 8 bits. The name of an image in the
database is its path below COLMAP's image folder.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.api import Extractor
from bench.core.errors import SampleError, UserError
from bench.formats.stored_features import map_into_square, match_name, read_upright_size
from bench.geometry.nearest_words import unit_rows
from bench.types import Features


@dataclass(frozen=True, kw_only=True)
class ColmapDatabase(Extractor):
    """Reads features from a COLMAP database, and moves the keypoints into the benchmark's square."""

    eight_bit = True

    path: Path
    exact_zeros: bool = False  # whether many components are exactly zero, as in SIFT

    def __post_init__(self) -> None:
        if not self.path.is_file():
            raise UserError(f"colmap-database: {self.path}: no such file")
        if self.path.read_bytes()[:16] != b"SQLite format 3\0":
            raise UserError(f"colmap-database: {self.path}: not a COLMAP database")

    def extract(self, image: np.ndarray, source: Path | None = None) -> Features:
        import pycolmap

        if source is None:
            raise UserError(
                "colmap-database: features are found by the photograph's file, but this image has none. Training and "
                "dictionaries use mirrored views: choose an extractor that computes features"
            )
        numbers = _list_images(self.path, self.path.stat().st_mtime_ns)
        name = match_name(source, numbers)
        if name is None:
            raise SampleError(f"{source.name}: {self.path} has no image of that name")
        number, size = numbers[name]
        with pycolmap.Database.open(self.path) as database:
            if not database.exists_keypoints(number) or not database.exists_descriptors(number):
                raise SampleError(f"{source.name}: {self.path} has no features of it")
            keypoints, codes = database.read_keypoints(number)[:, :2], database.read_descriptors(number).data
        if len(keypoints) != len(codes):
            raise SampleError(f"{source.name}: {len(keypoints)} keypoints and {len(codes)} descriptors in {self.path}")
        read_upright_size(source, size)
        side = image.shape[0]
        xy = map_into_square(keypoints.astype(np.float64), size, side)  # (N, 2)
        keep = ((xy >= 0) & (xy < side)).all(axis=1) & codes.any(axis=1)
        if not keep.any():
            raise SampleError(f"{source.name}: no keypoint of {self.path} lies in the photograph's central square")
        rows = np.ascontiguousarray(codes[keep])
        features = Features(keypoints=xy[keep].astype(np.float32), descriptors=unit_rows(rows), codes=rows, size=(side, side))
        return features.by_position()


@lru_cache(maxsize=4)
def _list_images(path: Path, changed: int) -> dict[str, tuple[int, tuple[int, int]]]:
    """List the images of a database. -> by name: number, (width, height); `changed`, the file's time, is part of the cache key"""
    import pycolmap

    with pycolmap.Database.open(path) as database:
        cameras = {camera.camera_id: (camera.width, camera.height) for camera in database.read_all_cameras()}
        return {image.name: (image.image_id, cameras[image.camera_id]) for image in database.read_all_images()}


PLUGIN = ColmapDatabase
