"""Cache of features of images, and of the nearest words of their descriptors.

Both are secrets of the owner, like the photographs. Only the benchmark stores them; code that protects photographs does not.
"""

from __future__ import annotations

import hashlib
import itertools
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from bench.api import Extractor
from bench.cache import provenance, store
from bench.codebook import dictionary
from bench.codebook.dictionary import Dictionary
from bench.core import environment, threads
from bench.core.child_process import end_with_parent
from bench.core.progress import Progress
from bench.formats.tensor_file import Arrays
from bench.images.scene import Pixels
from bench.registry import spec
from bench.types import Bytes, Features, Floats, Indices

KIND = "features"
WORDS = "words"
MAX_SEQUENTIAL = 16  # images; more are extracted in parallel


def extract(extractor: Extractor, pixels: Pixels) -> Features:
    """Return the features of an image, from the cache or by extraction.

    Raises
    ------
    SampleError
        if the image cannot be read, or has no keypoint.
    """

    def compute() -> store.Content:
        features = extractor.extract(pixels.read(), pixels.file())
        return to_arrays(features), {"size": list(features.size)}

    arrays, meta = store.fetch(KIND, _key(extractor, pixels), compute)
    return from_arrays(arrays, tuple(meta["size"]))


def extract_all(extractor: Extractor, images: Sequence[Pixels]) -> Iterator[Features]:
    """Yield the features of images. If more than 16 are missing in the cache, one process per available thread extracts them.

    Raises
    ------
    SampleError
        if one of them cannot be read.
    """
    import torch

    missing = [image for image in images if not store.entry_path(KIND, _key(extractor, image)).is_file()]
    processes = torch.get_num_threads()
    if len(missing) > MAX_SEQUENTIAL and processes > 1:
        executor = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _start_worker)
        with executor, Progress("features of reference images", len(missing)) as progress:
            for _ in executor.map(_extract_to_cache, itertools.repeat(extractor), missing):
                progress.advance()
    return (extract(extractor, image) for image in images)


def _start_worker() -> None:
    end_with_parent()
    threads.limit_threads(1)


def _extract_to_cache(extractor: Extractor, pixels: Pixels) -> None:
    """Extract the features in a worker process, and store them in the cache."""
    extract(extractor, pixels)


def _key(extractor: Extractor, pixels: Pixels) -> dict[str, Any]:
    file = pixels.file() if extractor.reads_stored else None
    return {
        "image": pixels.content_hash(),
        **({} if file is None else {"name": file.name}),
        "extractor": spec.to_json(extractor),
        "source": provenance.hash_modules(type(extractor).__module__),
        "libraries": environment.list_extractor_library_versions(),
    }


def find_nearest_words(words: Dictionary, rows: Bytes | Floats) -> Indices:
    """Return the nearest word of each of (N, D) rows, from the cache or by search. -> (N,) int64"""

    def compute() -> store.Content:
        return {"words": words.index.find_nearest(rows)}, {}

    content = hashlib.sha256(np.ascontiguousarray(rows).data).hexdigest()
    key = {
        "dictionary": words.digest,
        "rows": [content, str(rows.dtype), list(rows.shape)],
        "source": provenance.hash_modules(dictionary.__name__),
        "environment": environment.describe_platform(),
    }
    return store.fetch(WORDS, key, compute)[0]["words"]


def to_arrays(features: Features) -> Arrays:
    """Return the arrays of features that are not None."""
    parts = {
        "keypoints": features.keypoints,
        "descriptors": features.descriptors,
        "codes": features.codes,
        "frames": features.frames,
    }
    return {name: array for name, array in parts.items() if array is not None}


def from_arrays(arrays: Arrays, size: tuple[int, int]) -> Features:
    """Invert `to_arrays`."""
    parts: dict[str, np.ndarray | None] = {name: arrays.get(name) for name in ("codes", "frames")}
    return Features(keypoints=arrays["keypoints"], descriptors=arrays["descriptors"], size=size, **parts)
