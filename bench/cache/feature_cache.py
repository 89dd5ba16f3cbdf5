"""Features of images that are dear to read, and the words that descriptors quantise to, kept by the hash of what made them.

Both are the owner's secrets, as the photographs are. Only the runner keeps them, which measures; nothing that protects does.
"""

from __future__ import annotations

import hashlib
import itertools
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
import torch

from bench.api import Extractor
from bench.cache import provenance, store
from bench.codebook import dictionary
from bench.codebook.dictionary import Dictionary
from bench.core import environment, threads
from bench.core.progress import Progress
from bench.formats.tensor_file import Arrays
from bench.images.scene import Pixels
from bench.registry import spec
from bench.types import Bytes, Features, Floats, Indices

KIND = "features"
WORDS = "words"
FEW = 16  # images that are not worth processes of their own


def features(extractor: Extractor, pixels: Pixels) -> Features:
    """Extract, unless it was done before.

    Raises
    ------
    UnitError
        if the image cannot be read, or has no keypoint.
    """

    def make() -> store.Content:
        found = extractor.extract(pixels.read(), getattr(pixels, "path", None))
        return to_arrays(found), {"size": list(found.size)}

    arrays, meta = store.fetch(KIND, _key(extractor, pixels), make)
    return from_arrays(arrays, tuple(meta["size"]))


def all_features(extractor: Extractor, images: Sequence[Pixels]) -> Iterator[Features]:
    """The features of images; where many are not kept yet, as many processes extract them as this one may use threads.

    Raises
    ------
    UnitError
        if one of them cannot be read.
    """
    missing = [image for image in images if not store.path(KIND, _key(extractor, image)).is_file()]
    processes = torch.get_num_threads()
    if len(missing) > FEW and processes > 1:
        executor = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), threads.limit, (1,))
        with executor, Progress("features of reference images", len(missing)) as progress:
            for _ in executor.map(_keep, itertools.repeat(extractor), missing):
                progress.advance()
    return (features(extractor, image) for image in images)


def _keep(extractor: Extractor, pixels: Pixels) -> None:
    """As `features`, for a process that keeps them for others."""
    features(extractor, pixels)


def _key(extractor: Extractor, pixels: Pixels) -> dict[str, Any]:
    return {
        "image": pixels.content_hash(),
        "extractor": spec.written(extractor),
        "source": provenance.source(type(extractor).__module__),
        "libraries": environment.libraries(),
    }


def nearest_words(known: Dictionary, rows: Bytes | Floats) -> Indices:
    """The nearest word of each of (N, D) rows, unless they were found before. -> (N,) int64"""

    def make() -> store.Content:
        return {"words": known.index.nearest(rows)}, {}

    content = hashlib.sha256(np.ascontiguousarray(rows).data).hexdigest()
    key = {
        "dictionary": known.digest,
        "rows": [content, str(rows.dtype), list(rows.shape)],
        "source": provenance.source(dictionary.__name__),
        "environment": environment.computing(),
    }
    return store.fetch(WORDS, key, make)[0]["words"]


def to_arrays(found: Features) -> Arrays:
    """The features without what they do not have."""
    parts = {"keypoints": found.keypoints, "descriptors": found.descriptors, "codes": found.codes, "frames": found.frames}
    return {name: array for name, array in parts.items() if array is not None}


def from_arrays(arrays: Arrays, size: tuple[int, int]) -> Features:
    """The features that `to_arrays` took apart."""
    parts: dict[str, np.ndarray | None] = {name: arrays.get(name) for name in ("codes", "frames")}
    return Features(keypoints=arrays["keypoints"], descriptors=arrays["descriptors"], size=size, **parts)
