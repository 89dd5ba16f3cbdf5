"""Features of images that are dear to read, and the words that descriptors quantise to, kept by the hash of what made them.

Both are the owner's secrets, as the photographs are. Only the runner keeps them, which measures; nothing that protects does.
"""

from __future__ import annotations

import hashlib

import numpy as np

from bench import cache, environment, provenance, spec
from bench.datasets.scene import Pixels
from bench.features import dictionary
from bench.features.dictionary import Dictionary
from bench.plugin import Extractor
from bench.tensorfile import Arrays
from bench.types import Bytes, Features, Floats, Indices

KIND = "features"
WORDS = "words"


def features(extractor: Extractor, pixels: Pixels) -> Features:
    """Extract, unless it was done before.

    Raises
    ------
    UnitError
        if the image cannot be read, or has no keypoint.
    """

    def make() -> cache.Made:
        found = extractor.extract(pixels.read(), getattr(pixels, "path", None))
        return to_arrays(found), {"size": list(found.size)}

    key = {
        "image": pixels.content_hash(),
        "extractor": spec.written(extractor),
        "source": provenance.source(type(extractor).__module__),
        "libraries": environment.libraries(),
    }
    arrays, meta = cache.fetch(KIND, key, make)
    return from_arrays(arrays, tuple(meta["size"]))


def nearest_words(known: Dictionary, rows: Bytes | Floats) -> Indices:
    """The nearest word of each of (N, D) rows, unless they were found before. -> (N,) int64"""

    def make() -> cache.Made:
        return {"words": known.index.nearest(rows)}, {}

    content = hashlib.sha256(np.ascontiguousarray(rows).data).hexdigest()
    key = {
        "dictionary": known.digest,
        "rows": [content, str(rows.dtype), list(rows.shape)],
        "source": provenance.source(dictionary.__name__),
        "environment": environment.computing(),
    }
    return cache.fetch(WORDS, key, make)[0]["words"]


def to_arrays(found: Features) -> Arrays:
    """The features without what they do not have."""
    parts = {"keypoints": found.keypoints, "descriptors": found.descriptors, "codes": found.codes, "frames": found.frames}
    return {name: array for name, array in parts.items() if array is not None}


def from_arrays(arrays: Arrays, size: tuple[int, int]) -> Features:
    """The features that `to_arrays` took apart."""
    parts: dict[str, np.ndarray | None] = {name: arrays.get(name) for name in ("codes", "frames")}
    return Features(keypoints=arrays["keypoints"], descriptors=arrays["descriptors"], size=size, **parts)
