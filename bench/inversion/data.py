"""Training data: crops of 256 x 256 out of views that are kept in memory, and a release of each, drawn afresh every time.

A photograph is never quantised by a dictionary that was made from it: at so few descriptors a word it would quantise to nearly
itself, a network so trained would trust its input too much, and the defense would look safer than it is. Each photograph takes
the defense's own dictionary if it had no part in that, else the first of the cross-fit dictionaries that it had no part in.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from bench.api import Asset, Between, Defense, OneOf
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import Public
from bench.core.errors import SampleError, UserError
from bench.core.progress import Progress
from bench.geometry.nearest_words import unit_rows
from bench.geometry.row_keys import row_keys
from bench.images.photographs import SIDE
from bench.images.views import PhotographView
from bench.inversion.encoding import condition
from bench.inversion.symmetry import IDENTITY, Symmetry
from bench.types import Bytes, Features, Floats, Indices, Release

Served = Mapping[str, Between | OneOf]


@dataclass(frozen=True, eq=False)
class Example:
    """A crop, what was released of it, and the settings that the attacker knows."""

    pixels: Bytes  # (256, 256, 3)
    release: Release
    condition: Floats  # (C,)


@dataclass(frozen=True, eq=False)
class Examples:
    """Draws examples of one defense from a set of views."""

    views: Sequence[PhotographView]
    defense: Defense
    served: Served
    dictionaries: Mapping[str, Asset]  # photograph -> the dictionary that may quantise it; empty if nothing is quantised
    public: Public
    symmetries: Sequence[Symmetry] = (IDENTITY,)  # under which they are drawn, each as often

    def draw(self, rng: np.random.Generator) -> Example:
        """A random crop of a random view under random served settings, and a random symmetry.

        Raises
        ------
        UserError
            if no view out of 100 can be used.
        """
        for _ in range(100):
            with suppress(SampleError):  # of photographs that are read on demand, for others have been read already
                view = self.views[int(rng.integers(len(self.views)))]
                break
        else:
            raise UserError("none of 100 photographs could be used")
        example = self._release(view.photograph, *random_crop(view, rng), rng)
        symmetry = self.symmetries[int(rng.integers(len(self.symmetries)))]
        pixels, release = symmetry.of_image(example.pixels), symmetry.of_release(example.release)
        return dataclasses.replace(example, pixels=pixels, release=release)

    def whole(self, view: PhotographView, rng: np.random.Generator) -> Example:
        """A whole view of 256 x 256, under random served settings."""
        return self._release(view.photograph, view.pixels, view.features, rng)

    def _release(self, photograph: str, pixels: Bytes, secret: Features, rng: np.random.Generator) -> Example:
        settings: dict[str, object] = {field: setting.sample(rng) for field, setting in self.served.items()}
        if self.defense.dictionary_field is not None:
            settings[self.defense.dictionary_field] = self.dictionaries[photograph]
        defense = dataclasses.replace(self.defense, **settings)  # type: ignore[type-var]  # plugins are dataclasses
        return Example(pixels, defense.protect(secret, self.public, rng), condition(defense, self.served))


def random_crop(view: PhotographView, rng: np.random.Generator) -> tuple[Bytes, Features]:
    """A 256 x 256 window that holds at least one keypoint."""
    room = len(view.pixels) - SIDE
    while True:
        left, top = rng.integers(room + 1, size=2)
        moved = view.features.keypoints - np.array([left, top], dtype=np.float32)
        inside = np.all((moved >= 0) & (moved < SIDE), axis=1)
        if inside.any():
            break
        if room == 0:
            raise ValueError("a view of 256 x 256 pixels has no keypoint within it")
    secret = dataclasses.replace(view.features, keypoints=moved, size=(SIDE, SIDE)).take(inside)
    return view.pixels[top : top + SIDE, left : left + SIDE], secret


def fitting_dictionaries(photographs: set[str], candidates: Sequence[Asset], public: Public) -> dict[str, Asset]:
    """For each photograph the first dictionary that was not made from it.

    Raises
    ------
    UserError
        if a photograph had a part in every one.
    """
    chosen = {}
    for photograph in photographs:
        strangers = [asset for asset in candidates if photograph not in public.dictionary(asset).photographs]
        if not strangers:
            raise UserError(
                "a training photograph helped to make the dictionary, and would quantise to nearly itself; "
                "train on other photographs, or name with --crossfit a dictionary that was made without it"
            )
        chosen[photograph] = strangers[0]
    return chosen


def check_lengths(assets: set[Asset], sizes: Sequence[int], public: Public) -> None:
    """Refuse dictionaries of other sizes than one another: at one epsilon the fewer words tell the true one more often, so a
    network that is told epsilon would learn to trust words as it must not, or to distrust them.

    Raises
    ------
    UserError
        if at any of `sizes` one dictionary has fewer words than another.
    """
    for size in sizes:
        lengths = {asset: len(public.dictionary(asset, size)) for asset in assets}
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{asset} {length:,}" for asset, length in sorted(lengths.items()))
            raise UserError(
                f"--crossfit: photographs would be quantised by dictionaries of other sizes ({told} words), which tell the true "
                "word more or less often at one epsilon; name dictionaries of as many words, or fix a number that all have"
            )


class Quantisation:
    """The nearest words of all rows of a training set, found once. A `Quantiser` for `Public`."""

    def __init__(self, tables: dict[str, tuple[np.ndarray, Indices]]) -> None:
        self.tables = tables  # dictionary's digest -> ascending keys of rows, their words

    def __call__(self, known: Dictionary, rows: Bytes | Floats) -> Indices:
        keys, words = self.tables[known.digest]
        wanted = row_keys(rows)
        places = np.searchsorted(keys, wanted)
        if not np.array_equal(keys[np.minimum(places, len(keys) - 1)], wanted):
            raise KeyError("a row that is not in the training set")
        return words[places]


def quantise(
    views: Sequence[PhotographView], dictionaries: Mapping[str, Asset], sizes: Sequence[int], public: Public
) -> Quantisation:
    """Find the nearest words of all views' descriptors, each in its own photograph's dictionary at each of `sizes`.

    Sizes descend, all words (0) first: a word that is nearest among more words is nearest among fewer, if it is one of them.
    """
    tables = {}
    total = len(sizes) * sum(len(view.features) for view in views)
    with Progress("quantising", total) as progress:
        for asset in sorted(set(dictionaries.values())):
            rows = np.concatenate([queries(view.features) for view in views if dictionaries[view.photograph] == asset])
            keys, first = _first_of_each(row_keys(rows))
            words = np.full(len(first), np.iinfo(np.int64).max)  # none is known yet
            for size in sizes:
                known = public.dictionary(asset, size)
                lost = words >= len(known)
                words = words.copy()
                words[lost] = known.index.nearest(rows[first[lost]], progress.advance)
                tables[known.digest] = (keys, words)
                progress.advance(len(rows) - int(lost.sum()))
    return Quantisation(tables)


def _first_of_each(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct keys, ascending, and where each first stands."""
    distinct, first = np.unique(keys, return_index=True)
    return distinct, first


def queries(features: Features) -> Bytes | Floats:
    """The rows that are quantised: the 8-bit vectors where there are any."""
    return features.descriptors if features.codes is None else features.codes


def quantisation_error(
    views: Sequence[PhotographView], dictionaries: Mapping[str, Asset], public: Public, words: int = 0
) -> float:
    """Mean distance between unit descriptors and their unit words, the first `words` of each dictionary (0: all of them).

    Views of 256 x 256 pixels count.
    """
    distances = []
    for view in views:
        if len(view.pixels) == SIDE:
            known = dictionaries[view.photograph]
            nearest = public.dictionary(known).words[public.nearest_words(known, view.features, words)]
            distances.append(np.linalg.norm(unit_rows(nearest) - view.features.descriptors, axis=1))
    return float(np.concatenate(distances).mean())
