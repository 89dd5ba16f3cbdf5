"""Cache of dictionaries that are clustered from the words of other dictionaries."""

from __future__ import annotations

from bench.cache import provenance, store
from bench.codebook import clustered, dictionary
from bench.codebook.dictionary import Dictionary


def cluster_words(source: Dictionary, size: int) -> Dictionary:
    """Return `bench.codebook.clustered.cluster_words(source, size)`, from the cache or by clustering."""
    if size >= len(source):
        return source
    key = [source.digest, size, clustered.SEED, provenance.hash_modules(clustered.__name__)]
    arrays, _ = store.fetch(dictionary.KIND, key, lambda: ({"words": clustered.cluster_words(source, size).words}, {}))
    return Dictionary(arrays["words"], source.meta, clustered.name_digest(source.digest, size))
