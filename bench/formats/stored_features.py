"""Coordinates of features from other programs: conversion between the stored photograph and the benchmark's square.

The name of a photograph in a file of features is its path below the other program's image folder.
"""

from __future__ import annotations

from collections.abc import Container
from pathlib import Path

import numpy as np
from PIL import Image

from bench.core.errors import SampleError

ORIENTATION = 0x0112  # the EXIF tag; 1 is upright


def map_into_square(xy: np.ndarray, size: tuple[int, int], side: int) -> np.ndarray:
    """Map points of an image of `size` (width, height) to its largest centred square, resized to `side`. (N, 2) -> (N, 2)"""
    return (xy - _find_corner(size)) * (side / min(size))


def map_out_of_square(xy: np.ndarray, size: tuple[int, int], side: int) -> np.ndarray:
    """Invert `map_into_square`. (N, 2) -> (N, 2)"""
    return xy * (min(size) / side) + _find_corner(size)


def match_name(source: Path, names: Container[str]) -> str | None:
    """Return the longest suffix of a photograph's path that is in `names`; None if there is none."""
    parts = source.resolve().parts[1:]
    ends = ("/".join(parts[start:]) for start in range(len(parts)))
    return next((end for end in ends if end in names), None)


def read_upright_size(source: Path, size: tuple[int, int] | None = None) -> tuple[int, int]:
    """Return the width and height of the stored photograph, and check that they equal `size`, if given.

    Raises
    ------
    SampleError
        if the photograph has another size, or an EXIF rotation, which features of other programs ignore.
    """
    try:
        with Image.open(source) as opened:
            if size is not None and opened.size != size:
                sizes = f"the features are of an image of {size} pixels, the photograph has {opened.size}"
                raise SampleError(f"{source.name}: {sizes}")
            if opened.getexif().get(ORIENTATION, 1) != 1:
                raise SampleError(f"{source.name}: it has an EXIF rotation, which features of other programs ignore")
            return opened.size
    except OSError as error:
        raise SampleError(f"{source.name}: cannot be read as an image: {error}") from error


def _find_corner(size: tuple[int, int]) -> np.ndarray:
    """Return the top left corner of the square that `photographs.crop_square` crops."""
    short = min(size)
    return np.array([(side - short) // 2 for side in size])
