"""Dictionaries of descriptors: K of LDP-Feat, W of affine lifting, and Z of the attacker.

Rows are in random order, fixed when the dictionary is built. Affine lifting splits them into n sub-databases of equal length
(to within one): sub-database s holds rows floor(s K / n) up to floor((s + 1) K / n).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.core.errors import UserError
from bench.formats import tensor_file
from bench.geometry.nearest_words import WordIndex
from bench.geometry.neighbours import Neighbours
from bench.types import Bytes

KIND = "dictionary"


@dataclass(frozen=True, eq=False)
class Dictionary:
    """K distinct words and the metadata of their construction."""

    words: Bytes  # (K, D), no zero row, no duplicates
    meta: dict[str, Any]  # extractor, photographs (hashes), mean_cosine, seed, ...
    digest: str

    def __len__(self) -> int:
        return len(self.words)

    @property
    def photographs(self) -> frozenset[str]:
        """Content hashes of the photographs that the words were built from."""
        return frozenset(self.meta["photographs"])

    @cached_property
    def index(self) -> WordIndex:
        """Search index for the nearest words of descriptors."""
        return WordIndex(self.words)

    @cached_property
    def neighbours(self) -> Neighbours:
        """Search index for words near other words."""
        return Neighbours(self.words)

    @cached_property
    def mean(self) -> NDArray[np.float64]:
        """Direction of the mean of the unit words. -> (D,)"""
        lengths = np.linalg.norm(self.words.astype(np.float32), axis=1).astype(np.float64)
        total = (1 / lengths) @ self.words  # 8-bit numbers, weighted in float64
        return total / np.linalg.norm(total)

    def first(self, count: int) -> Dictionary:
        """Return the dictionary of the first `count` words, at most of all: a random sample, since rows are in random order."""
        if count >= len(self):
            return self
        return Dictionary(self.words[:count], self.meta, f"{self.digest}, first {count}")

    def sub_database(self, index: int, count: int) -> Bytes:
        """Return the rows of sub-database `index` of `count`, by the rule at the top of this file."""
        return self.words[self.start(index, count) : self.start(index + 1, count)]

    def start(self, index: int, count: int) -> int:
        """Return the first row of sub-database `index` of `count`."""
        return index * len(self.words) // count


def save(path: Path, words: Bytes, meta: dict[str, Any]) -> Dictionary:
    """Write words (K, D) and their metadata to a file, and return the dictionary."""
    return Dictionary(words, meta, tensor_file.save(path, KIND, {"words": words}, meta))


def load(path: Path) -> Dictionary:
    """Read a dictionary and verify it.

    Raises
    ------
    UserError
        if the file is damaged, its words are not (K, 128) uint8 or one is zero, or its metadata name no photographs.
    """
    arrays, meta, digest = tensor_file.load(path, KIND)
    words = arrays.get("words", np.empty(0))
    if words.dtype != np.uint8:
        raise UserError(f"{path}: words are {words.dtype}, expected uint8")
    if words.ndim != 2 or words.shape[1] != 128 or len(words) < 2:
        raise UserError(f"{path}: words have shape {words.shape}, expected (K, 128) with K at least 2")
    if not words.any(axis=1).all():
        raise UserError(f"{path}: word {int(np.argmin(words.any(axis=1)))} is zero, which has no direction")
    photographs = meta.get("photographs")
    if not isinstance(photographs, list) or not all(isinstance(content, str) for content in photographs):
        raise UserError(f"{path}: its metadata lack the photographs; build it with `bench dictionary build`")
    return Dictionary(words, meta, digest)
