"""Dictionaries clustered from the words of a larger one, against its first words."""

from pathlib import Path

import numpy as np
import pytest

from bench.cache import dictionary_cache, store
from bench.codebook import build
from bench.codebook.clustered import cluster_words
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import Public

KINDS, WORDS = 40, 1200


@pytest.fixture
def source() -> Dictionary:
    """Words around 40 centres, in random order; most centres have few words."""
    rng = np.random.default_rng(0)
    centres = rng.integers(0, 120, (KINDS, 128))
    kinds = np.minimum(rng.geometric(0.08, WORDS), KINDS) - 1
    words = np.clip(centres[kinds] + rng.integers(-8, 9, (WORDS, 128)), 1, 255).astype(np.uint8)
    return Dictionary(words, {"photographs": ["a"]}, "sha256:00")


def test_a_clustering_is_closer_to_the_words_than_the_first_words_are(source: Dictionary) -> None:
    clustered = cluster_words(source, KINDS)
    assert len(np.unique(clustered.words, axis=0)) == len(clustered) == KINDS
    assert clustered.photographs == source.photographs
    distances = [1 - build.mean_cosine(source.words, words) for words in (clustered.words, source.first(KINDS).words)]
    assert distances[0] < 0.6 * distances[1]
    assert cluster_words(source, WORDS) is source  # nothing to cluster


def test_the_shipped_words_are_clustered_by_name(source: Dictionary) -> None:
    """The name of a size is part of the digest. The other names keep the first words."""
    public = Public(dictionaries={"shipped": source})
    clustered = public.dictionary("shipped-clustered", KINDS)
    np.testing.assert_array_equal(clustered.words, cluster_words(source, KINDS).words)
    np.testing.assert_array_equal(public.dictionary("shipped", KINDS).words, source.words[:KINDS])
    assert public.dictionary("shipped-clustered") is source
    assert public.digest("shipped-clustered") == "sha256:00, clustered"
    digests = {public.dictionary(asset, size).digest for asset in ("shipped", "shipped-clustered") for size in (KINDS, KINDS + 1)}
    assert len(digests) == 4


def test_a_clustering_is_cached(source: Dictionary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(store.VARIABLE, str(tmp_path))
    first = dictionary_cache.cluster_words(source, KINDS)
    monkeypatch.setattr(build, "cluster", None)  # would raise
    again = dictionary_cache.cluster_words(source, KINDS)
    np.testing.assert_array_equal(again.words, first.words)
    assert (again.digest, again.meta) == (first.digest, source.meta)
