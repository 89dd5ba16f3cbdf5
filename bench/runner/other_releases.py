"""Releases of other users of a service: the knowledge `OtherReleases`.

Random windows of the dataset's other photographs, half of them mirrored, stand for the photographs of other users. Their number
is unlimited. They repeat the same few motifs, but each window is lifted anew, and attacks search for common parts of liftings.
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

LARGEST = 640  # pixels: longest short side of the image that windows are cut from


class ReleasePool:
    """An endless sequence of releases of one defense. The k-th is a function of (randomness, k) alone, and is computed once.

    Parameters
    ----------
    derive : (name, k) -> generator
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
        """Return a function: count -> the first `count` releases that show no window of that photograph."""

        def first(count: int) -> Iterator[Release]:
            usable = [number for number, source in enumerate(self._sources) if source.name != photograph]
            numbers = (turn * len(self._sources) + number for turn in itertools.count() for number in usable)
            return itertools.islice(self._iterate(numbers, len(usable)), count)

        return first

    def _iterate(self, numbers: Iterator[int], usable: int) -> Iterator[Release]:
        """Yield releases. Stop after `usable` consecutive windows without a keypoint: as many as there are photographs."""
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
    """Return a random square of at least 256 pixels, or the largest one, mirrored or not, resized to 256. -> (256, 256, 3)

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
    image, _ = decode(source)
    scale = min(1.0, LARGEST / min(image.size))
    return image.resize((round(image.width * scale), round(image.height * scale)), Image.Resampling.BICUBIC)
