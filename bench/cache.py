"""What was made once and can be made again, kept on disk by the hash of what it was made from, never by name.

A key says everything that the content depends on: configuration, hashes of inputs, and of the source that makes it. What is
damaged is made again; where nothing can be written, nothing is kept.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from bench import tensorfile
from bench.errors import UserError
from bench.records import canonical
from bench.tensorfile import Arrays

VARIABLE = "FEATURE_PRIVACY_CACHE"  # of the environment: the folder
Made = tuple[Arrays, dict[str, Any]]


def root() -> Path:
    """The folder that everything is kept in."""
    return Path(os.environ.get(VARIABLE, "runs/cache"))


def fetch(kind: str, key: Any, make: Callable[[], Made]) -> Made:
    """Arrays and metadata that `make` makes, unless they are kept already.

    Parameters
    ----------
    kind : what it is, in a word
    key : JSON: all that the content depends on
    """
    file = path(kind, key)
    if file.is_file():
        try:
            arrays, meta, _ = tensorfile.load(file, kind)
        except UserError as error:
            logging.getLogger(__name__).warning("%s; it is made again", error)
        else:
            return arrays, meta
    arrays, meta = make()
    try:
        tensorfile.save(file, kind, arrays, meta)
    except OSError as error:
        logging.getLogger(__name__).warning("%s: %s; it is not kept", file, error.strerror)
    return arrays, meta


def path(kind: str, key: Any) -> Path:
    """Where that is kept."""
    return root() / kind / f"{hashlib.sha256(canonical(key).encode()).hexdigest()[:32]}.safetensors"


def source(*modules: ModuleType) -> str:
    """A digest of these modules' files, for keys."""
    hashed = hashlib.sha256()
    for module in modules:
        assert module.__file__ is not None
        hashed.update(Path(module.__file__).read_bytes())
    return hashed.hexdigest()
