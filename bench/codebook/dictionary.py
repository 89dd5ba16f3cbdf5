"""Dictionaries of descriptors: K of LDP-Feat, W of affine lifting, and Z of the attacker.

Words are vectors of 8-bit integers, of which only the directions count. For SIFT they are unsigned, like its descriptors. For
other descriptors they have a sign, and a norm of about `SIGNED_NORM`. So dot products of words are integers below 2^24, which
float32 represents exactly: comparisons of words are the same on every machine, as the defenses require.

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
from bench.geometry.nearest_words import WordIndex, unit_rows
from bench.geometry.neighbours import Neighbours
from bench.types import Bytes, Features, Floats, Words

KIND = "dictionary"
SIFT = 128  # length of unsigned words
NORM = 512.0  # of SIFT's 8-bit vectors
SIGNED_NORM = 127.0  # of signed words; rounding turns them by about 0.02 radian, a word is about 0.5 radian from its descriptors
MAX_NEGATIVE = 0.01  # greatest fraction of the squared norm in negative components of descriptors with unsigned words: noise
EXACT = 2**24  # squared norms below this give exact dot products in float32


@dataclass(frozen=True, eq=False)
class Dictionary:
    """K distinct words and the metadata of their construction."""

    words: Words  # (K, D), no zero row, no duplicates
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
        total = (1 / lengths) @ self.words  # integers, weighted in float64
        return total / np.linalg.norm(total)

    def first(self, count: int) -> Dictionary:
        """Return the dictionary of the first `count` words, at most of all: a random sample, since rows are in random order."""
        if count >= len(self):
            return self
        return Dictionary(self.words[:count], self.meta, f"{self.digest}, first {count}")

    def check_suits(self, rows: Bytes | Floats, asset: str) -> None:
        """Check that the words can stand for descriptors (N, D); `asset` is the dictionary's name in the message.

        Raises
        ------
        UserError
            if the lengths differ, or one of the two has signs and the other the 8 bits of SIFT.
        """
        hint = (
            "pass one for these features: shipped is for sift, shipped-xfeat for xfeat, shipped-aliked for aliked, and "
            "`bench dictionary build` makes others"
        )
        if rows.shape[1] != self.words.shape[1]:
            raise UserError(f"the descriptors have length {rows.shape[1]}, the words of {asset} {self.words.shape[1]}; {hint}")
        negative = np.square(np.minimum(rows, 0, dtype=np.float64)).sum()  # of learned features about half of the total
        if self.words.dtype == np.uint8 and negative > MAX_NEGATIVE * np.square(rows, dtype=np.float64).sum():
            raise UserError(f"the descriptors have negative components, the words of {asset} are 8-bit vectors of SIFT; {hint}")
        if rows.dtype == np.uint8 and self.words.dtype == np.int8:
            raise UserError(f"the descriptors are 8-bit vectors of SIFT, the words of {asset} have signs; {hint}")

    def sub_database(self, index: int, count: int) -> Words:
        """Return the rows of sub-database `index` of `count`, by the rule at the top of this file."""
        return self.words[self.start(index, count) : self.start(index + 1, count)]

    def start(self, index: int, count: int) -> int:
        """Return the first row of sub-database `index` of `count`."""
        return index * len(self.words) // count


def encode(features: Features) -> Words:
    """Return descriptors as words: the 8-bit vectors if there are any, else signed ones. (N, D)"""
    return round_rows(features.descriptors, np.dtype(np.int8)) if features.codes is None else features.codes


def round_rows(rows: Floats, dtype: np.dtype[Any]) -> Words:
    """Return unit rows as words of type `dtype`, uint8 or int8. (N, D) float32 -> (N, D)"""
    if dtype == np.uint8:
        return np.clip(np.rint(rows * NORM), 0, 255).astype(np.uint8)
    return np.rint(unit_rows(rows) * SIGNED_NORM).astype(np.int8)


def save(path: Path, words: Words, meta: dict[str, Any]) -> Dictionary:
    """Write words (K, D) and their metadata to a file, and return the dictionary."""
    return Dictionary(words, meta, tensor_file.save(path, KIND, {"words": words}, meta))


def load(path: Path) -> Dictionary:
    """Read a dictionary and verify it.

    Raises
    ------
    UserError
        if the file is damaged, its words are not (K, 128) uint8 or (K, D) int8, one is zero or too long, or its metadata name no
        photographs.
    """
    arrays, meta, digest = tensor_file.load(path, KIND)
    words = arrays.get("words", np.empty(0))
    if words.dtype not in (np.uint8, np.int8):
        raise UserError(f"{path}: words are {words.dtype}, expected uint8 or int8")
    length = SIFT if words.dtype == np.uint8 else "D"
    if words.ndim != 2 or len(words) < 2 or words.shape[1] == 0 or length not in ("D", words.shape[1]):
        raise UserError(f"{path}: words have shape {words.shape}, expected (K, {length}) with K at least 2")
    if not words.any(axis=1).all():
        raise UserError(f"{path}: word {int(np.argmin(words.any(axis=1)))} is zero, which has no direction")
    if words.dtype == np.int8 and (longest := int(np.square(words, dtype=np.int64).sum(axis=1).max())) >= EXACT:
        raise UserError(f"{path}: a word has norm {longest**0.5:.0f}, expected about {SIGNED_NORM:.0f}; build the file anew")
    photographs = meta.get("photographs")
    if not isinstance(photographs, list) or not all(isinstance(content, str) for content in photographs):
        raise UserError(f"{path}: its metadata lack the photographs; build it with `bench dictionary build`")
    return Dictionary(words, meta, digest)
