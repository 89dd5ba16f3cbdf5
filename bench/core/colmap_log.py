"""COLMAP without its log, which tells of every image."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pycolmap

ERRORS = 2  # glog's level


@contextmanager
def quietly() -> Iterator[None]:
    """Only errors are told."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = ERRORS
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
