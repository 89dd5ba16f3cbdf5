"""Suppression of COLMAP's log, which has lines for every image."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

ERRORS = 2  # level of glog


@contextmanager
def silence_colmap() -> Iterator[None]:
    """Suppress all messages of COLMAP except errors, inside a `with` statement."""
    import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = ERRORS
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
