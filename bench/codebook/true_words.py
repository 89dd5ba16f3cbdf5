"""True words: the words that a defense quantises descriptors to, and their index in the released sets."""

from __future__ import annotations

import numpy as np

from bench.api import Defense
from bench.codebook.public import Public
from bench.types import Features, Indices, Release, WordSets


def find_true_words(defense: Defense, secret: Features, public: Public) -> Indices:
    """Return the words that a defense quantises descriptors to. -> (N,)

    Raises
    ------
    TypeError
        if the defense does not quantise.
    """
    if defense.dictionary_field is None:
        raise TypeError(f"{defense.name()} does not quantise")
    words = 0 if defense.word_count_field is None else getattr(defense, defense.word_count_field)
    return public.nearest_words(getattr(defense, defense.dictionary_field), secret, words)


def find_true_candidates(release: Release, true: Indices) -> Indices:
    """Return the index of the true word among the candidates of each keypoint; m if it is none of them. -> (N,)

    Raises
    ------
    TypeError
        if the release holds no words of a dictionary.
    """
    if not isinstance(release, WordSets) or release.words is None:
        raise TypeError(f"{type(release).__name__} without words of a dictionary")
    found = release.words == true[:, None]  # (N, m)
    return np.where(found.any(axis=1), found.argmax(axis=1), release.subset_size)
