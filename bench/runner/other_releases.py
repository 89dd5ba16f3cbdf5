"""Releases that other users of a service would send: the knowledge `OtherReleases`.

Other users' photographs are imitated by random windows, half of them mirrored, of the dataset's other photographs. So there is no
limit to their number. They show the same few motifs again and again, but each is lifted anew, and attacks look for what liftings
have in common.
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

LARGEST = 640  # pixels of the short side of the image that windows are cut from


class ReleasePool:
    """An endless list of releases of one defense. The k-th is a function of (randomness, k) alone and computed once.

    Parameters
    ----------
    derive : from a name and k to a generator
    """

    def __init__(
        self,
        sources: Sequence[Source],
        extractor: Extractor,
        defense: Defense,
        public: Public,
        derive: Callable[..., np.random.Generator],
    ) -> None:
        self._sources, self._extractor, self._defense, self._public = sources, extractor, defense, public
        self._derive = derive
        self._releases: dict[int, Release | None] = {}

    def without(self, photograph: str) -> Callable[[int], Iterator[Release]]:
        """Return a function from a number to the first so many releases that show no window of that photograph."""

        def first(count: int) -> Iterator[Release]:
            usable = [number for number, source in enumerate(self._sources) if source.name != photograph]
            numbers = (turn * len(self._sources) + number for turn in itertools.count() for number in usable)
            return itertools.islice(self._iterate(numbers, len(usable)), count)

        return first

    def _iterate(self, numbers: Iterator[int], usable: int) -> Iterator[Release]:
        """Yield releases, until as many windows in a row as there are photographs have no keypoint."""
        missing = 0
        while missing < usable:
            k = next(numbers)
            if k not in self._releases:
                self._releases[k] = self._protect(k)
            release = self._releases[k]
            missing = missing + 1 if release is None else 0
            if release is not None:
                yield release

    def _protect(self, k: int) -> Release | None:
        try:
            pixels = random_window(self._sources[k % len(self._sources)], self._derive("window", k))
            secret = self._extractor.extract(pixels)
        except SampleError:
            return None
        return self._defense.protect(secret, self._public, self._derive("release", k))


def random_window(source: Source, rng: np.random.Generator) -> Bytes:
    """A random square of at least 256 pixels, or the largest there is, mirrored or not, resized to 256. -> (256, 256, 3)

    Raises
    ------
    SampleError
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
