"""Smaller dictionaries, clustered from the words of a larger one.

The first words of a dictionary are a random sample of its words. A clustering into as many words is closer to descriptors.
"""

from __future__ import annotations

import numpy as np

from bench.codebook import build
from bench.codebook.dictionary import Dictionary

SEED = 0  # of the clustering


def cluster_words(source: Dictionary, size: int) -> Dictionary:
    """Return a dictionary of `size` words, clustered from the words of `source`; `source` itself if it has no more than that.

    Every word counts once, however many descriptors it stands for.
    """
    if size >= len(source):
        return source
    words = build.cluster(source.words, size, np.random.default_rng(SEED))
    return Dictionary(words, source.meta, name_digest(source.digest, size))


def name_digest(source: str, size: int = 0) -> str:
    """Return the digest of the dictionary of `size` words clustered from that of digest `source`; of any size for 0.

    >>> name_digest("sha256:01", 8000)
    'sha256:01, clustered to 8000'
    """
    return f"{source}, clustered to {size}" if size else f"{source}, clustered"
