"""Training data: random crops of 256 x 256 pixels, and a new release of each.

A photograph is never quantised by a dictionary built from it. Its descriptors would be quantised to nearly themselves. The
network would then trust its input too much, and the defense would look safer than it is. So each photograph uses the first
dictionary that was not built from it: the defense's own, or else a cross-fit dictionary.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from bench.api import Defense
from bench.cache import feature_cache
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import Public
from bench.core.errors import SampleError, UserError
from bench.core.progress import Progress
from bench.geometry.nearest_words import unit_rows
from bench.geometry.row_keys import hash_rows
from bench.images.photographs import SIDE
from bench.images.views import PhotographView
from bench.inversion.encoding import encode_settings
from bench.inversion.symmetry import IDENTITY, Symmetry
from bench.registry.composed import configure
from bench.settings import Asset, Between, OneOf
from bench.types import Bytes, Features, Floats, Indices, Release

SupportedSettings = Mapping[str, Between | OneOf]
STORED_ROWS = 20_000  # descriptors whose nearest words are one entry of the cache; some 10 s of search in 256,000 words


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """Releases that a network is trained for: a defense with its fixed settings, and the settings that are drawn at random."""

    defense: Defense
    supported_settings: SupportedSettings


@dataclass(frozen=True, eq=False)
class Example:
    """A crop, its release, and the public settings of the defense."""

    pixels: Bytes  # (256, 256, 3)
    release: Release
    settings: Floats  # (C,)
    keypoints: Floats  # (N, 2) the true ones, which the release may hide
    defense: Defense  # with its settings, as the attacker knows it


@dataclass(frozen=True, eq=False)
class Examples:
    """A generator of training examples from a set of views."""

    views: Sequence[PhotographView]
    targets: Sequence[Target]  # drawn uniformly
    dictionaries: Mapping[str, Asset]  # photograph -> its dictionary; empty if nothing is quantised
    public: Public
    symmetries: Sequence[Symmetry] = (IDENTITY,)  # drawn uniformly

    def draw(self, rng: np.random.Generator) -> Example:
        """Return a random crop of a random view, for a random target with random supported settings, and a random symmetry.

        Raises
        ------
        UserError
            if no view out of 100 can be used.
        """
        for _ in range(100):
            with suppress(SampleError):  # a view that is read on demand may be unreadable
                view = self.views[int(rng.integers(len(self.views)))]
                break
        else:
            raise UserError("none of 100 randomly drawn photographs could be read; check --images")
        example = self._release(view.photograph, *draw_crop(view, rng), rng)
        symmetry = self.symmetries[int(rng.integers(len(self.symmetries)))]
        return dataclasses.replace(
            example,
            pixels=symmetry.transform_image(example.pixels),
            release=symmetry.transform_release(example.release),
            keypoints=symmetry.transform_points(example.keypoints, example.release.size),
        )

    def release_view(self, view: PhotographView, rng: np.random.Generator) -> Example:
        """Return a whole view of 256 x 256 pixels and its release, for a random target with random supported settings."""
        return self._release(view.photograph, view.pixels, view.features, rng)

    def _release(self, photograph: str, pixels: Bytes, secret: Features, rng: np.random.Generator) -> Example:
        number = int(rng.integers(len(self.targets))) if len(self.targets) > 1 else 0
        target = self.targets[number]
        settings: dict[str, object] = {field: setting.sample(rng) for field, setting in target.supported_settings.items()}
        known = defense = configure(target.defense, settings)
        if target.defense.dictionary_field is not None:
            defense = configure(target.defense, settings | {target.defense.dictionary_field: self.dictionaries[photograph]})
        condition = encode_settings(defense, number, [target.supported_settings for target in self.targets])
        return Example(pixels, defense.protect(secret, self.public, rng), condition, secret.keypoints, known)


def draw_crop(view: PhotographView, rng: np.random.Generator) -> tuple[Bytes, Features]:
    """Return a random window of 256 x 256 pixels with at least one keypoint, and its features."""
    room = len(view.pixels) - SIDE
    while True:
        left, top = rng.integers(room + 1, size=2)
        shifted = view.features.keypoints - np.array([left, top], dtype=np.float32)
        inside = np.all((shifted >= 0) & (shifted < SIDE), axis=1)
        if inside.any():
            break
        if room == 0:
            raise ValueError("a view of 256 x 256 pixels contains no keypoint")
    secret = dataclasses.replace(view.features, keypoints=shifted, size=(SIDE, SIDE)).take(inside)
    return view.pixels[top : top + SIDE, left : left + SIDE], secret


def assign_dictionaries(photographs: set[str], candidates: Sequence[Asset], public: Public) -> dict[str, Asset]:
    """Return for each photograph the first dictionary that was not built from it.

    Raises
    ------
    UserError
        if every dictionary was built from a photograph.
    """
    assigned = {}
    for photograph in photographs:
        unrelated = [asset for asset in candidates if photograph not in public.dictionary(asset).photographs]
        if not unrelated:
            raise UserError(
                "the dictionary was built from a training photograph, which it would quantise almost without error; "
                "train on other photographs, or pass with --crossfit a dictionary built without it"
            )
        assigned[photograph] = unrelated[0]
    return assigned


def check_dictionary_sizes(assets: set[Asset], sizes: Sequence[int], public: Public) -> None:
    """Check that all dictionaries have equal sizes.

    At the same epsilon, a set from fewer words contains the true word more often. A network that reads epsilon would learn a
    wrong trust in words.

    Raises
    ------
    UserError
        if at any of `sizes` one dictionary has fewer words than another.
    """
    for size in sizes:
        lengths = {asset: len(public.dictionary(asset, size)) for asset in assets}
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"{asset} {length:,}" for asset, length in sorted(lengths.items()))
            raise UserError(
                f"--crossfit: dictionaries have different sizes ({listed} words), and so different chances of the true word; "
                "pass equal sizes, or fix a number of words that all have"
            )


class Quantisation:
    """Nearest words of all rows of a training set, computed in advance: a `Quantiser` for `Public`."""

    def __init__(self, tables: dict[str, tuple[np.ndarray, Indices]]) -> None:
        self.tables = tables  # digest of a dictionary -> ascending keys of rows, words of these rows

    def __call__(self, dictionary: Dictionary, rows: Bytes | Floats) -> Indices:
        keys, words = self.tables[dictionary.digest]
        wanted_keys = hash_rows(rows)
        indices = np.searchsorted(keys, wanted_keys)
        if not np.array_equal(keys[np.minimum(indices, len(keys) - 1)], wanted_keys):
            raise KeyError("the row is not in the training set")
        return words[indices]


def quantise(
    views: Sequence[PhotographView], dictionaries: Mapping[str, Asset], sizes: Sequence[int], public: Public
) -> Quantisation:
    """Find the nearest words of all descriptors in the dictionary of their photograph, at each of `sizes`.

    `sizes` descend; 0, which stands for all words, comes first. The nearest of many words is also the nearest of fewer words that
    contain it. Words are stored in the cache as they are found, so an interrupted training does not search for them again.
    """
    tables = {}
    total = len(sizes) * sum(len(view.features) for view in views)
    with Progress("quantising", total) as progress:
        for asset in sorted(set(dictionaries.values())):
            rows = np.concatenate([view.features.exact for view in views if dictionaries[view.photograph] == asset])
            keys, first = _find_first_occurrences(hash_rows(rows))
            words = np.full(len(first), np.iinfo(np.int64).max)  # no word is known yet
            for size in sizes:
                dictionary = public.dictionary(asset, size)
                missing = words >= len(dictionary)
                words = words.copy()
                words[missing] = _find_nearest_words(dictionary, rows[first[missing]], progress)
                tables[dictionary.digest] = (keys, words)
                progress.advance(len(rows) - int(missing.sum()))
    return Quantisation(tables)


def _find_nearest_words(dictionary: Dictionary, rows: Bytes | Floats, progress: Progress) -> Indices:
    words = np.empty(len(rows), dtype=np.int64)
    for start in range(0, len(rows), STORED_ROWS):
        part = rows[start : start + STORED_ROWS]
        words[start : start + STORED_ROWS] = feature_cache.find_nearest_words(dictionary, part)
        progress.advance(len(part))
    return words


def _find_first_occurrences(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct keys, ascending, and the first index of each."""
    distinct, first = np.unique(keys, return_index=True)
    return distinct, first


def measure_quantisation_error(
    views: Sequence[PhotographView], dictionaries: Mapping[str, Asset], public: Public, words: int = 0
) -> float:
    """Return the mean distance of unit descriptors from their unit words, over views of 256 x 256 pixels.

    `words` limits each dictionary to its first words (0: all of them).
    """
    distances = []
    for view in views:
        if len(view.pixels) == SIDE:
            asset = dictionaries[view.photograph]
            nearest = public.dictionary(asset).words[public.nearest_words(asset, view.features, words)]
            distances.append(np.linalg.norm(unit_rows(nearest) - view.features.descriptors, axis=1))
    return float(np.concatenate(distances).mean())
