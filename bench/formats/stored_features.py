"""Coordinates of features from other programs: conversion between the stored photograph and the pixels that the benchmark reads.

Of a photograph the benchmark reads the central square, resized, and of an image of a scene all pixels.

The name of a photograph in a file of features is its path below the other program's image folder. It is compared with the path
below ours as given: no link is resolved, and no part of the path is left out.
"""

from __future__ import annotations

import numpy as np

from bench.core.errors import SampleError
from bench.formats import lists
from bench.images.photographs import Source, read_orientation

NAMES_HINT = "names are paths below the image folder: give the folder that the features were extracted from"


def map_into_square(xy: np.ndarray, size: tuple[int, int], side: int) -> np.ndarray:
    """Map points of an image of `size` (width, height) to its largest centred square, resized to `side`. (N, 2) -> (N, 2)"""
    with np.errstate(over="ignore"):  # damaged files hold points at infinity, which are outside
        return (xy - _find_corner(size)) * (side / min(size))


def map_out_of_square(xy: np.ndarray, size: tuple[int, int], side: int) -> np.ndarray:
    """Invert `map_into_square`. (N, 2) -> (N, 2)"""
    return xy * (min(size) / side) + _find_corner(size)


def map_into_pixels(xy: np.ndarray, size: tuple[int, int], image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Map points of a stored image of `size` (width, height) to the pixels that were read: all, or its square, resized.

    Parameters
    ----------
    xy : (N, 2)
    image : (H, W, 3)

    Returns
    -------
    (N, 2) points, and (N,) whether a point lies in these pixels
    """
    height, width = image.shape[:2]
    mapped = xy if (width, height) == size else map_into_square(xy, size, height)
    return mapped, np.all((mapped >= 0) & (mapped < (width, height)), axis=1)


def check_name(name: str) -> None:
    """Raise SampleError if a photograph's name is not UTF-8, in which other programs store names."""
    if not lists.is_utf8(name):
        raise SampleError(f"{name!a}: this name is not UTF-8; rename the file")


def read_upright_size(source: Source, size: tuple[int, int] | None = None) -> tuple[int, int]:
    """Return the width and height of the stored photograph, and check that they equal `size`, if given.

    Raises
    ------
    SampleError
        if the photograph has another size, or an EXIF rotation, which features of other programs ignore.
    """
    try:
        with source.open() as opened:
            found = opened.size
            orientation = read_orientation(opened)
    except MemoryError:
        raise
    except Exception as error:  # Pillow raises errors of any class for damaged files
        raise SampleError(f"{source.name}: cannot be read as an image: {error}") from error
    if orientation != 1:
        raise SampleError(f"{source.name}: it has an EXIF rotation, which features of other programs ignore")
    if size is not None and found != size:
        raise SampleError(f"{source.name}: the features are of an image of {size} pixels, the photograph has {found}")
    return found


def _find_corner(size: tuple[int, int]) -> np.ndarray:
    """Return the top left corner of the square that `photographs.crop_square` crops."""
    short = min(size)
    return np.array([(side - short) // 2 for side in size])
