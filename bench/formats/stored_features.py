"""Features that other programs keep in files, of photographs as they are stored: where they lie in the benchmark's square.

A photograph's name in such a file is the path below the other program's image folder.
"""

from __future__ import annotations

from collections.abc import Container
from pathlib import Path

import numpy as np
from PIL import Image

from bench.core.errors import SampleError

ORIENTATION = 0x0112  # the EXIF tag; 1 is upright


def in_square(xy: np.ndarray, size: tuple[int, int], side: int) -> np.ndarray:
    """Move points of an image of `size` (width, height) into its largest centred square, resized to `side`. (N, 2) -> (N, 2)"""
    return (xy - _corner(size)) * (side / min(size))


def out_of_square(xy: np.ndarray, size: tuple[int, int], side: int) -> np.ndarray:
    """Undo `in_square`. (N, 2) -> (N, 2)"""
    return xy * (min(size) / side) + _corner(size)


def named(source: Path, known: Container[str]) -> str | None:
    """Of the ends of a photograph's path the longest that is known."""
    parts = source.resolve().parts[1:]
    names = ("/".join(parts[start:]) for start in range(len(parts)))
    return next((name for name in names if name in known), None)


def upright(source: Path, size: tuple[int, int] | None = None) -> tuple[int, int]:
    """The width and height of a photograph as it is stored, which must be `size`, if that is given.

    Raises
    ------
    UnitError
        if it is of another size, or has an EXIF rotation, which features of other programs do not follow.
    """
    try:
        with Image.open(source) as opened:
            if size is not None and opened.size != size:
                told = f"the features are of an image of {size} pixels, the photograph has {opened.size}"
                raise SampleError(f"{source.name}: {told}")
            if opened.getexif().get(ORIENTATION, 1) != 1:
                raise SampleError(f"{source.name}: it has an EXIF rotation, which such features do not follow")
            return opened.size
    except OSError as error:
        raise SampleError(f"{source.name}: cannot be read as an image: {error}") from error


def _corner(size: tuple[int, int]) -> np.ndarray:
    """The top left of the square that `photographs.square` cuts out."""
    short = min(size)
    return np.array([(side - short) // 2 for side in size])
