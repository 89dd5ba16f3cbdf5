"""Releases that other users of a service would send: what an attacker with OTHER_RELEASES has.

Their photographs are imitated by random windows, half of them mirrored, of the dataset's other photographs. So there are as many
as wanted; they come back to the same few motifs, but each is lifted afresh, and an attack looks for what liftings share.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from PIL import Image

from bench.api import Defense, Extractor
from bench.codebook.public import Public
from bench.core.errors import SampleError
from bench.images.photographs import SIDE, Source, decode
from bench.types import Bytes, Release

LARGEST = 640  # pixels of the short side that windows are cut from


class OtherReleases:
    """An endless list of releases of one defense, the k-th a function of (randomness, k) alone, each made once.

    Parameters
    ----------
    randomness : from a name and k to a generator
    """

    def __init__(
        self,
        sources: Sequence[Source],
        extractor: Extractor,
        defense: Defense,
        public: Public,
        randomness: Callable[..., np.random.Generator],
    ) -> None:
        self._sources, self._extractor, self._defense, self._public = sources, extractor, defense, public
        self._randomness = randomness
        self._made: dict[int, Release | None] = {}

    def without(self, photograph: str) -> Callable[[int], Iterator[Release]]:
        """The list as the attacker of one photograph has it: with no window of that photograph."""

        def first(count: int) -> Iterator[Release]:
            usable = [place for place, source in enumerate(self._sources) if source.name != photograph]
            turns = (turn * len(self._sources) + place for turn in itertools.count() for place in usable)
            return itertools.islice(self._releases(turns, len(usable)), count)

        return first

    def _releases(self, turns: Iterator[int], usable: int) -> Iterator[Release]:
        """What can be made, until as many in a row as there are photographs cannot."""
        missing = 0
        while missing < usable:
            k = next(turns)
            if k not in self._made:
                self._made[k] = self._make(k)
            release = self._made[k]
            missing = missing + 1 if release is None else 0
            if release is not None:
                yield release

    def _make(self, k: int) -> Release | None:
        try:
            pixels = random_window(self._sources[k % len(self._sources)], self._randomness("window", k))
            secret = self._extractor.extract(pixels)
        except SampleError:
            return None
        return self._defense.protect(secret, self._public, self._randomness("release", k))


def random_window(source: Source, rng: np.random.Generator) -> Bytes:
    """A random square of at least 256 pixels, or the largest there is, mirrored or not, resized to 256. -> (256, 256, 3)

    Raises
    ------
    UnitError
        if the photograph cannot be read.
    """
    image = _shrunk(source)
    short = min(image.size)
    side = int(rng.integers(min(SIDE, short), short, endpoint=True))
    left, top = (int(rng.integers(room - side, endpoint=True)) for room in image.size)
    cut = image.crop((left, top, left + side, top + side)).resize((SIDE, SIDE), Image.Resampling.BICUBIC)
    pixels = np.array(cut)
    return np.ascontiguousarray(pixels[:, ::-1]) if rng.integers(2) else pixels


@functools.lru_cache(maxsize=128)
def _shrunk(source: Source) -> Any:
    image, _ = decode(source.path)
    scale = min(1.0, LARGEST / min(image.size))
    return image.resize((round(image.width * scale), round(image.height * scale)), Image.Resampling.BICUBIC)
