"""SIFT features that COLMAP extracted, read from its database (versions 3 and 4).

COLMAP puts the centre of the first pixel at (0.5, 0.5), as we do. Its descriptors have 8 bits. The name of an image in the
database is its path below COLMAP's image folder, and must be the path below ours.

The file is opened by SQLite itself, read-only. pycolmap would migrate a database of COLMAP 3 in place, and needs a folder that
can be written. Tables: https://colmap.github.io/database.html; COLMAP 4 has added the column `type` of `descriptors`.
"""

from __future__ import annotations

import itertools
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from bench.api import Extractor
from bench.core.errors import SampleError, UserError
from bench.formats.stored_features import NAMES_HINT, check_name, map_into_pixels, read_upright_size
from bench.geometry.nearest_words import unit_rows
from bench.images.photographs import Source
from bench.types import Bytes, Features

MAGIC = b"SQLite format 3\0"
SIFT = 128  # bytes of a descriptor
SIFT_TYPE = 0  # pycolmap.FeatureExtractorType.SIFT
FIND_IMAGE = """SELECT images.image_id, cameras.width, cameras.height FROM images
    LEFT JOIN cameras ON cameras.camera_id = images.camera_id WHERE images.name = ?"""
STEPS = 100_000  # of SQLite's virtual machine between two checks of the limit
MAX_CHECKS = 1_000  # for one photograph: seconds. A hostile database can define endless views


@dataclass(frozen=True, kw_only=True)
class ColmapDatabase(Extractor):
    """Reads SIFT features from a COLMAP database, and moves those of photographs into the benchmark's square."""

    eight_bit = True
    reads_stored: ClassVar[bool] = True

    path: Path
    exact_zeros: bool = False  # whether many components are exactly zero, as in SIFT

    def __post_init__(self) -> None:
        if not self.path.is_file():
            raise UserError(f"colmap-database: {self.path}: no such file")
        with self.path.open("rb") as opened:
            if opened.read(len(MAGIC)) != MAGIC:
                raise UserError(f"colmap-database: {self.path}: not a COLMAP database")

    def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
        if source is None:
            raise UserError(
                "colmap-database: features are found by the photograph's name, but this image has none. Training and "
                "dictionaries use mirrored views: choose an extractor that computes features"
            )
        keypoints, codes, size = self._read(source)
        read_upright_size(source, size)
        xy, inside = map_into_pixels(keypoints.astype(np.float64), size, image)
        keep = inside & codes.any(axis=1)
        if not keep.any():
            raise SampleError(f"{source.name}: no keypoint of {self.path} lies in the photograph's central square")
        rows = np.ascontiguousarray(codes[keep])
        points, (height, width) = xy[keep].astype(np.float32), image.shape[:2]
        features = Features(keypoints=points, descriptors=unit_rows(rows), codes=rows, size=(width, height))
        return features.by_position()

    def _read(self, source: Source) -> tuple[np.ndarray, Bytes, tuple[int, int]]:
        """Read the features of a photograph. -> keypoints (N, 2), codes (N, 128), and the (width, height) of the image"""
        check_name(source.name)
        where = f"{source.name}: {self.path}"
        try:
            with _open(self.path) as database:
                found = database.execute(FIND_IMAGE, (source.name,)).fetchone()
                if found is None:
                    raise SampleError(f"{where} has no image of that name; {NAMES_HINT}")
                number, *size = found
                keypoints = _read_matrix(database, "keypoints", number, np.dtype("<f4"), where)
                _check_type(database, number, where)
                codes = _read_matrix(database, "descriptors", number, np.dtype("u1"), where)
        except (sqlite3.Error, UnicodeError) as error:  # a message with a damaged name is not UTF-8
            raise SampleError(f"{where} is damaged, or no database of COLMAP: {error}") from error
        if keypoints.shape[1] < 2 or codes.shape[1] != SIFT or len(keypoints) != len(codes):
            raise SampleError(
                f"{where}: keypoints have shape {keypoints.shape} and descriptors {codes.shape}, expected (N, 2) and (N, {SIFT})"
            )
        if not all(isinstance(extent, int) and 0 < extent < 2**31 for extent in size):
            raise SampleError(f"{where}: the image has no camera with a width and a height")
        return keypoints[:, :2], codes, (size[0], size[1])


@contextmanager
def _open(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database without any change to it or its folder.

    Raises
    ------
    UserError
        if a part of its content is still in a second file. Records name the digest of the first file only.
    """
    for end in ("-wal", "-journal"):
        beside = path.with_name(path.name + end)
        if beside.is_file() and beside.stat().st_size:
            raise UserError(
                f"colmap-database: {beside} holds changes that are not in {path.name} yet: close the program that writes it, or "
                "open and close the database once in COLMAP"
            )
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as opened:
        checks = itertools.count()
        opened.set_progress_handler(lambda: next(checks) > MAX_CHECKS, STEPS)
        yield opened


def _check_type(database: sqlite3.Connection, number: int, where: str) -> None:
    """Raise SampleError unless the descriptors are SIFT. Those of COLMAP 3 have no type, and are."""
    if "type" not in {row[1] for row in database.execute("PRAGMA table_info(descriptors)")}:
        return
    found = database.execute("SELECT type FROM descriptors WHERE image_id = ?", (number,)).fetchone()
    if found is not None and found[0] != SIFT_TYPE:
        raise SampleError(
            f"{where}: its descriptors are {_name_type(found[0])}, and only SIFT is read; the extractor hloc reads others"
        )


def _name_type(number: Any) -> str:
    import pycolmap

    names = {int(kind): name for name, kind in pycolmap.FeatureExtractorType.__members__.items()}
    return names.get(number, f"of type {number!r}")


def _read_matrix(database: sqlite3.Connection, table: str, number: int, dtype: np.dtype[Any], where: str) -> np.ndarray:
    """Return the matrix of an image, (rows, cols); raise SampleError if there is none, or its parts disagree."""
    found = database.execute(f"SELECT rows, cols, data FROM {table} WHERE image_id = ?", (number,)).fetchone()
    if found is None:
        raise SampleError(f"{where} has no {table} of it")
    rows, cols, data = found
    shape_is_valid = isinstance(rows, int) and isinstance(cols, int) and rows >= 0 and cols > 0
    if not shape_is_valid or not isinstance(data or b"", bytes) or len(data or b"") != rows * cols * dtype.itemsize:
        raise SampleError(f"{where}: the {table} of it are damaged: {rows!r} x {cols!r} do not match their data")
    return np.frombuffer(data or b"", dtype).reshape(rows, cols)


PLUGIN = ColmapDatabase
